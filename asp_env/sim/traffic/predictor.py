"""The driver `predictor`: vehicles follow the forecasts of a predictor."""

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.predictor import (
    Forecast,
    Predictor,
    fill_missing,
    load_predictor,
    needs_simulation,
)
from asp_env.data.recording import ticks
from asp_env.dynamics import clip_actions, inverse, rollout
from asp_env.dynamics.bicycle import Integrator
from asp_env.errors import AspEnvError
from asp_env.sim.traffic.driver import (
    Control,
    Shared,
    controllable_agents,
    exit_bounds,
    outside_bounds,
    resized,
)
from asp_env.sim.world import World, recorded_future

EVERY_TICKS = 5
"""Default interval between forecasts, 1 s at the default time step. Chosen by hand."""

MODES = ("most-probable", "sampled")
"""Which mode of its forecast a vehicle follows."""

HORIZON_S = 3.0
"""Horizon of predictors that can forecast any number of ticks, if the interval is not longer."""

INTEGRATORS: tuple[Integrator, Integrator] = ("heun", "euler")
"""Methods by which the actions of forecasts may lead to their states."""

SAME_M = 0.01
"""Forecast states and the rollout of their actions are the same up to this distance. Chosen by
hand: above the rounding of networks, below the difference of both methods after a second at 0.5
m/s²."""

NO_FORECAST = -1
"""Tick of the latest forecast of an agent without a forecast."""

_USAGE = "expected predictor:[every=TICKS:][mode=sampled:]NAME[:RUN]"


class PredictorDriver:
    """Vehicles follow a mode of their forecast, which is renewed every few ticks.

    A forecast is due for an agent when it appears, and every `every` ticks of its episode. One call
    of the predictor covers all agents of all episodes that are due. In between, agents execute the
    forecast actions, or the actions that lead from one forecast state to the next if the predictor
    forecasts no actions; both are clipped to ±5 m/s² and ±π/4. Forecast actions are integrated by
    the method that leads to the forecast states, Heun's or Euler's, so that agents follow these
    states: at 1 m/s² Heun's positions are 0.1 m/s ahead of Euler's. Agents with too short a history
    continue at constant velocity (`fill_missing`). Agents appear where and when they were recorded,
    and leave 10 m outside the area of all recorded positions.

    With `sampled`, each forecast draws a mode by its probability from the episode's own generator.
    Episodes are independent of each other, except that the last bits of a network's output may
    depend on the number of targets in its batch.
    """

    def __init__(
        self, predictor: Predictor, *, every: int = EVERY_TICKS, sampled: bool = False
    ) -> None:
        """Creates a driver without agents; `reset` assigns them.

        Args:
            predictor: forecasts the agents.
            every: ticks from one forecast to the next.
            sampled: whether to draw a mode instead of taking the most probable one.

        Raises:
            AspEnvError: `every` is not between 1 and the predictor's horizon, or the predictor
                needs a simulated future.
        """
        if needs_simulation(predictor):
            raise AspEnvError(
                f"driver predictor:{predictor.name}: simulates the ego's plan, which drivers do "
                "not know: use predictor:oracle, or a predictor that needs no future"
            )
        if not 1 <= every <= predictor.horizon:
            raise AspEnvError(
                f"every={every}: expected 1 to {predictor.horizon} ticks, the horizon of "
                f"{predictor.name}"
            )
        self.every, self.sampled = every, sampled
        self._predictor = Shared(predictor)
        self._agent_mask = np.zeros((0, 0), dtype=bool)
        self._bounds = np.zeros((0, 4))
        self._forecast_tick = np.zeros((0, 0), dtype=np.int64)
        """Elapsed ticks at each agent's latest forecast, or `NO_FORECAST`: (B, A)."""
        self._actions = np.zeros((0, 0, every, 2), dtype=np.float32)
        """[acceleration m/s², steering rad] from that tick on: (B, A, every, 2)."""
        self._euler = np.zeros((0, 0), dtype=bool)
        """Whether these actions are integrated by Euler's method: (B, A)."""

    @classmethod
    def from_name(cls, argument: str, *, dt_s: float) -> "PredictorDriver":
        """The driver of `NAME[:RUN]`, which options such as `every=3:mode=sampled:` may precede.

        Args:
            argument: options, then the name of the predictor.
            dt_s: length of a tick.

        Raises:
            AspEnvError: an option is invalid, or the predictor cannot be loaded.
        """
        every, sampled, name = EVERY_TICKS, False, argument
        while "=" in name.partition(":")[0]:
            option, _, name = name.partition(":")
            key, _, value = option.partition("=")
            if key == "every" and value.isascii() and value.isdigit() and int(value) > 0:
                every = int(value)
            elif key == "mode" and value in MODES:
                sampled = value == "sampled"
            else:
                raise AspEnvError(f"driver predictor:{argument}: {option!r} is no option; {_USAGE}")
        if not name:
            raise AspEnvError(f"driver predictor:{argument} names no predictor; {_USAGE}")
        horizon = max(every, ticks(HORIZON_S, dt_s))
        return cls(load_predictor(name, horizon=horizon, dt_s=dt_s), every=every, sampled=sampled)

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Discards the forecasts of the previous episodes.

        Raises:
            AspEnvError: the world has another time step than the predictor.
        """
        predictor = self._predictor.value
        if abs(world.dt_s - predictor.dt_s) > 1e-6:
            raise AspEnvError(
                f"traffic: {predictor.name} was made for a time step of {predictor.dt_s:g} s, the "
                f"world has {world.dt_s:g} s"
            )
        self._agent_mask = controllable_agents(world) if agent_mask is None else agent_mask
        shape = self._agent_mask.shape
        self._bounds = resized(self._bounds, (len(world), 4))
        self._forecast_tick = resized(self._forecast_tick, shape)
        self._actions = resized(self._actions, (*shape, self.every, 2))
        self._euler = resized(self._euler, shape)
        self._bounds[reset_mask] = exit_bounds(world)[reset_mask]
        self._forecast_tick[reset_mask] = NO_FORECAST

    def control(self, world: World) -> Control:
        """The next action of the latest forecast, which is renewed where due."""
        episodes, rows, now = world.episodes, np.arange(len(world)), world.now
        elapsed = episodes.elapsed[:, None]
        present = self._agent_mask & episodes.valid[rows, now]
        leaving = present & outside_bounds(episodes.states[rows, now], self._bounds)
        controlled = present & ~leaving & (elapsed < episodes.length[:, None])
        due = (self._forecast_tick == NO_FORECAST) | (elapsed % self.every == 0)
        due &= controlled & (self._forecast_tick != elapsed)
        if due.any():
            self._forecast(world, np.argwhere(due))
            self._forecast_tick = np.where(due, elapsed, self._forecast_tick)
        step = np.where(controlled, elapsed - self._forecast_tick, 0)[..., None, None]
        actions = np.take_along_axis(self._actions, step, axis=2)[:, :, 0]
        return Control(
            actions=np.where(controlled[..., None], actions, 0),
            controlled=controlled,
            leaving=leaving,
            euler=self._euler & controlled,
        )

    def _forecast(self, world: World, targets: Int[np.ndarray, "t 2"]) -> None:
        predictor = self._predictor.value
        scene = world.scene().with_targets(targets)
        future = recorded_future(world, scene, predictor.horizon) if predictor.privileged else None
        forecast = fill_missing(predictor.predict(scene, future), scene)
        rows, mode = np.arange(len(targets)), self._choose_modes(world, forecast)
        states = forecast.states[rows, mode, : self.every]
        before = np.concatenate([scene.target_states[:, None], states[:, :-1]], axis=1)
        lengths = np.maximum(scene.sizes[targets[:, 0], targets[:, 1], 0], 0.1)[:, None]
        actions = np.where(
            forecast.actions_valid[:, None, None],
            forecast.actions[rows, mode, : self.every],
            inverse(before, states, lengths, scene.dt_s),
        )
        actions = clip_actions(actions)
        self._actions[targets[:, 0], targets[:, 1]] = actions
        by_euler = _is_euler(scene.target_states, actions, states, lengths[:, 0], scene.dt_s)
        self._euler[targets[:, 0], targets[:, 1]] = by_euler & forecast.actions_valid

    def _choose_modes(self, world: World, forecast: Forecast) -> Int[np.ndarray, " t"]:
        if not self.sampled:
            return forecast.most_probable
        episode = forecast.targets[:, 0]
        uniform = np.zeros(len(episode))
        for b in np.unique(episode).tolist():
            uniform[episode == b] = world.rngs[b].random(np.count_nonzero(episode == b))
        cumulative = forecast.probabilities.cumsum(axis=1, dtype=np.float64)
        return np.asarray((cumulative < uniform[:, None] * cumulative[:, -1:]).sum(axis=1))


def _is_euler(
    now: Float[np.ndarray, "t 4"],
    actions: Float[np.ndarray, "t steps 2"],
    states: Float[np.ndarray, "t steps 4"],
    lengths_m: Float[np.ndarray, " t"],
    dt_s: float,
) -> Bool[np.ndarray, " t"]:
    """Mask of the targets whose actions lead to their states by Euler's method, not by Heun's.

    Args:
        now: present states.
        actions: [acceleration m/s², steering rad] of each tick.
        states: the states that the actions belong to.
        lengths_m: lengths of the targets.
        dt_s: seconds per tick.
    """
    heun, euler = (
        np.linalg.vector_norm(
            rollout(now, actions, lengths_m, dt_s, integrator=integrator)[..., :2]
            - states[..., :2],
            axis=-1,
        ).max(axis=-1)
        for integrator in INTEGRATORS
    )
    return (euler < heun) & (euler < SAME_M)

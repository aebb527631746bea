"""Agents that do what a predictor says of them."""

import numpy as np
from jaxtyping import Bool, Int

from asp_env.data.predictor import Forecast, Predictor, fill_missing, load_predictor
from asp_env.data.recording import ticks
from asp_env.dynamics import clip_actions, inverse
from asp_env.errors import AspEnvError
from asp_env.sim.traffic.driver import Control, Shared, areas, outside, resized, vehicles
from asp_env.sim.world import World, recorded_future

EVERY_TICKS = 5
MODES = ("most-probable", "sampled")
HORIZON_S = 3.0
"""A predictor that can forecast any number of ticks is asked for so many, or for `every`."""

NEVER = -1
"""In place of the tick of a forecast."""

_USAGE = "expected predictor:[every=TICKS:][mode=sampled:]NAME[:RUN]"


class PredictorDriver:
    """Vehicles follow their forecast, which is made anew every few ticks.

    One call of the predictor speaks of all agents of all episodes that need a forecast: every
    `every` ticks of their own episode, and when they appear. In between they carry out the
    forecast's actions through the bicycle model, or those that lead from one forecast state to the
    next where the predictor says no actions; both are kept within ±5 m/s² and ±π/4. Agents without
    enough history go straight on at their speed, as everywhere (`fill_missing`). An agent comes
    where and when its log says, and leaves 10 m beyond all recorded positions.

    In mode `sampled` each forecast's mode is drawn with its probability from the episode's own
    generator. Episodes do not know of each other, except that a network's numbers may differ in
    their last bits with the number of agents that it is asked about at once.
    """

    def __init__(
        self, predictor: Predictor, *, every: int = EVERY_TICKS, sampled: bool = False
    ) -> None:
        """A driver without agents; `reset` gives it some.

        Args:
            predictor: says what the agents will do.
            every: ticks from one forecast to the next.
            sampled: draw a mode by its probability instead of taking the most probable one.

        Raises:
            AspEnvError: `every` is not between 1 and the predictor's horizon.
        """
        if not 1 <= every <= predictor.horizon:
            raise AspEnvError(
                f"every={every}: expected 1 to {predictor.horizon} ticks, the horizon of "
                f"{predictor.name}"
            )
        self.every, self.sampled = every, sampled
        self._predictor = Shared(predictor)
        self._agent_mask = np.zeros((0, 0), dtype=bool)
        self._areas = np.zeros((0, 4))
        self._made = np.zeros((0, 0), dtype=np.int64)
        """The tick of each agent's latest forecast."""
        self._actions = np.zeros((0, 0, every, 2), dtype=np.float32)

    @classmethod
    def from_name(cls, argument: str, *, dt_s: float) -> "PredictorDriver":
        """The driver of `NAME[:RUN]`, behind options such as `every=3:mode=sampled:`.

        Raises:
            AspEnvError: an option is not understood, or the predictor cannot be loaded.
        """
        every, sampled, rest = EVERY_TICKS, False, argument
        while "=" in rest.partition(":")[0]:
            option, _, rest = rest.partition(":")
            key, _, value = option.partition("=")
            if key == "every" and value.isascii() and value.isdigit() and int(value) > 0:
                every = int(value)
            elif key == "mode" and value in MODES:
                sampled = value == "sampled"
            else:
                raise AspEnvError(f"driver predictor:{argument}: {option!r} is no option; {_USAGE}")
        if not rest:
            raise AspEnvError(f"driver predictor:{argument} names no predictor; {_USAGE}")
        horizon = max(every, ticks(HORIZON_S, dt_s))
        return cls(load_predictor(rest, horizon=horizon, dt_s=dt_s), every=every, sampled=sampled)

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Forgets what was forecast in the episodes before.

        Raises:
            AspEnvError: the world has another time step than the predictor.
        """
        predictor = self._predictor.value
        if abs(world.dt_s - predictor.dt_s) > 1e-6:
            raise AspEnvError(
                f"traffic: {predictor.name} was made for a time step of {predictor.dt_s:g} s, the "
                f"world has {world.dt_s:g} s"
            )
        self._agent_mask = vehicles(world) if agent_mask is None else agent_mask
        shape = self._agent_mask.shape
        self._areas = resized(self._areas, (len(world), 4))
        self._made = resized(self._made, shape)
        self._actions = resized(self._actions, (*shape, self.every, 2))
        self._areas[reset_mask] = areas(world)[reset_mask]
        self._made[reset_mask] = NEVER

    def control(self, world: World) -> Control:
        """The next action of the latest forecast, which is made now where it is due."""
        episodes, rows, now = world.episodes, np.arange(len(world)), world.now
        elapsed = episodes.elapsed[:, None]
        present = self._agent_mask & episodes.valid[rows, now]
        leaving = present & outside(episodes.states[rows, now], self._areas)
        driven = present & ~leaving & (elapsed < episodes.length[:, None])
        due = driven & ((self._made == NEVER) | (elapsed % self.every == 0))
        due &= self._made != elapsed
        if due.any():
            self._forecast(world, np.argwhere(due))
            self._made = np.where(due, elapsed, self._made)
        step = np.where(driven, elapsed - self._made, 0)[..., None, None]
        actions = np.take_along_axis(self._actions, step, axis=2)[:, :, 0]
        return Control(
            actions=np.where(driven[..., None], actions, 0), driven=driven, leaving=leaving
        )

    def _forecast(self, world: World, targets: Int[np.ndarray, "t 2"]) -> None:
        predictor = self._predictor.value
        scene = world.scene().with_targets(targets)
        future = recorded_future(world, scene, predictor.horizon) if predictor.privileged else None
        forecast = fill_missing(predictor.predict(scene, future), scene)
        rows, mode = np.arange(len(targets)), self._modes(world, forecast)
        states = forecast.states[rows, mode, : self.every]
        before = np.concatenate([scene.target_states[:, None], states[:, :-1]], axis=1)
        lengths = np.maximum(scene.sizes[targets[:, 0], targets[:, 1], 0], 0.1)[:, None]
        actions = np.where(
            forecast.actions_valid[:, None, None],
            forecast.actions[rows, mode, : self.every],
            inverse(before, states, lengths, scene.dt_s),
        )
        self._actions[targets[:, 0], targets[:, 1]] = clip_actions(actions)

    def _modes(self, world: World, forecast: Forecast) -> Int[np.ndarray, " t"]:
        if not self.sampled:
            return forecast.most_probable
        episode = forecast.targets[:, 0]
        drawn = np.zeros(len(episode))
        for b in np.unique(episode).tolist():
            drawn[episode == b] = world.rngs[b].random(np.count_nonzero(episode == b))
        until = forecast.probabilities.cumsum(axis=1, dtype=np.float64)
        return np.asarray((until < drawn[:, None] * until[:, -1:]).sum(axis=1))

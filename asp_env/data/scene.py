"""Scenes: everything that a predictor or planner may use at one tick."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64

from asp_env.data.classes import is_predicted
from asp_env.data.road_map import RoadMap
from asp_env.data.signals import SceneSignals
from asp_env.dynamics import inverse
from asp_env.errors import AspEnvError

EGO = 0
"""The slot of the ego."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """B situations of up to A agents, with the present tick and n past ticks; it holds no future.

    Slot 0 is the ego. Slots without an agent hold zeros, id -1 and `valid` false.
    """

    states: Float[np.ndarray, "b a ticks 4"]
    """[x m, y m, heading rad, speed m/s] at n past ticks and, last, now."""
    actions: Float[np.ndarray, "b a ticks-1 2"]
    """[acceleration m/s², steering rad] between consecutive states, inferred from them; with the
    accelerations of the files for `histories(…, "accelerations")`."""
    valid: Bool[np.ndarray, "b a ticks"]
    """Whether the agent is present at each tick."""
    sizes: Float[np.ndarray, "b a 2"]
    """Length and width, m."""
    classes: Int[np.ndarray, "b a"]
    """`AgentClass` of each agent."""
    ids: Int[np.ndarray, "b a"]
    """Track ids."""
    tick: Int[np.ndarray, " b"]
    """The present tick of each situation."""
    targets: Int[np.ndarray, "t 2"]
    """(situation, slot) of the agents to forecast."""
    route: Float[np.ndarray, "b p 2"]
    """The ego's route, points 1 m apart, without times."""
    route_valid: Bool[np.ndarray, "b p"]
    """Which points of the route exist; these come first."""
    maps: tuple[RoadMap, ...]
    map_index: Int[np.ndarray, " b"]
    """Index into `maps` of each situation."""
    dt_s: float
    """Seconds per tick."""
    signals: SceneSignals | None = None
    """Traffic signals up to now; None if no recording of the scene has any."""
    seeds: UInt64[np.ndarray, " b"] | None = None
    """Random number of each situation, which stochastic predictors draw from. In environments it
    follows from the seed of `reset`; None where the noise is the same in every episode, as in
    `asp-env drive`."""

    def with_targets(self, targets: Int[np.ndarray, "t 2"]) -> "Scene":
        """The same scene with other targets."""
        return dataclasses.replace(self, targets=targets)

    def situation(self, index: int) -> "Scene":
        """A scene of one of the situations, which becomes situation 0."""
        shared = ("targets", "maps", "dt_s", "signals", "seeds")
        names = [field.name for field in dataclasses.fields(self) if field.name not in shared]
        targets = self.targets[self.targets[:, 0] == index]
        targets[:, 0] = 0
        own = {name: getattr(self, name)[index : index + 1] for name in names}
        signals = None if self.signals is None else self.signals.situation(index)
        seeds = None if self.seeds is None else self.seeds[index : index + 1]
        return dataclasses.replace(self, targets=targets, signals=signals, seeds=seeds, **own)

    @property
    def history(self) -> int:
        """Number n of past ticks."""
        return self.states.shape[2] - 1

    @property
    def target_states(self) -> Float[np.ndarray, "t 4"]:
        """Present states of the targets."""
        return self.states[self.targets[:, 0], self.targets[:, 1], -1]

    @property
    def predictable(self) -> Bool[np.ndarray, " t"]:
        """Mask of targets of a predicted class that are present at every tick of the scene."""
        at = (self.targets[:, 0], self.targets[:, 1])
        predicted = is_predicted(self.classes[at])
        return predicted & self.valid[at].all(axis=-1)

    def check_dt(self, dt_s: float, name: str) -> None:
        """Checks that the scene has the time step of a predictor.

        Args:
            dt_s: the predictor's time step, s.
            name: the predictor's name, for the message.

        Raises:
            AspEnvError: the time steps differ.
        """
        if abs(self.dt_s - dt_s) > 1e-6:
            raise AspEnvError(
                f"{name} was made for a time step of {dt_s:g} s, the scene has {self.dt_s:g} s"
            )


def infer_actions(
    states: Float[np.ndarray, "*batch ticks 4"],
    valid: Bool[np.ndarray, "*batch ticks"],
    lengths_m: Float[np.ndarray, "*batch"],
    dt_s: float,
) -> Float[np.ndarray, "*batch ticks-1 2"]:
    """Actions between consecutive states by the inverse bicycle model.

    Args:
        states: [x m, y m, heading rad, speed m/s].
        valid: whether the agent is present.
        lengths_m: of the agents.
        dt_s: seconds per tick.

    Returns:
        [acceleration m/s², steering rad]; zero where either state is not valid.
    """
    both = valid[..., 1:] & valid[..., :-1]
    lengths = np.where(valid.any(axis=-1), lengths_m, 1).astype(states.dtype)[..., None]
    actions = inverse(states[..., :-1, :], states[..., 1:, :], lengths, dt_s)
    return np.where(both[..., None], actions, 0).astype(states.dtype)

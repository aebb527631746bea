"""All that may be known at one tick, for several situations at once."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.classes import PREDICTED
from asp_env.data.road_map import RoadMap
from asp_env.dynamics import inverse
from asp_env.errors import AspEnvError

EGO = 0
"""The slot of the ego."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """B situations of up to A agents with n past ticks and the present one. No future in it.

    Slots of absent agents are zeros with id -1 and `valid` false. Slot 0 is the ego.
    """

    states: Float[np.ndarray, "b a ticks 4"]
    """[x m, y m, heading rad, speed m/s]; the last tick is now."""
    actions: Float[np.ndarray, "b a ticks-1 2"]
    """[acceleration m/s², steering rad], inferred from the states; the last one ends now."""
    valid: Bool[np.ndarray, "b a ticks"]
    sizes: Float[np.ndarray, "b a 2"]
    """Length and width, metres."""
    classes: Int[np.ndarray, "b a"]
    ids: Int[np.ndarray, "b a"]
    tick: Int[np.ndarray, " b"]
    targets: Int[np.ndarray, "t 2"]
    """(situation, slot) of the agents to forecast."""
    route: Float[np.ndarray, "b p 2"]
    """The ego's way, points 1 m apart: geometry, no times."""
    route_valid: Bool[np.ndarray, "b p"]
    maps: tuple[RoadMap, ...]
    map_index: Int[np.ndarray, " b"]
    """Which of `maps` each situation lies on."""
    dt_s: float

    def with_targets(self, targets: Int[np.ndarray, "t 2"]) -> "Scene":
        """The same scene with other agents to forecast."""
        return dataclasses.replace(self, targets=targets)

    def situation(self, number: int) -> "Scene":
        """One of the situations alone, as situation 0."""
        shared = ("targets", "maps", "dt_s")
        names = [field.name for field in dataclasses.fields(self) if field.name not in shared]
        targets = self.targets[self.targets[:, 0] == number]
        targets[:, 0] = 0
        mine = {name: getattr(self, name)[number : number + 1] for name in names}
        return dataclasses.replace(self, targets=targets, **mine)

    @property
    def history(self) -> int:
        """n, the number of past ticks."""
        return self.states.shape[2] - 1

    @property
    def target_states(self) -> Float[np.ndarray, "t 4"]:
        """The targets' states now."""
        return self.states[self.targets[:, 0], self.targets[:, 1], -1]

    @property
    def predictable(self) -> Bool[np.ndarray, " t"]:
        """Targets of a predicted class that were seen at every tick of the history."""
        at = (self.targets[:, 0], self.targets[:, 1])
        known = np.isin(self.classes[at], [int(kind) for kind in PREDICTED])
        return known & self.valid[at].all(axis=-1)

    def check_dt(self, dt_s: float, who: str) -> None:
        """Refuses a scene of another time step than a predictor was made for.

        Raises:
            AspEnvError: the time steps differ.
        """
        if abs(self.dt_s - dt_s) > 1e-6:
            raise AspEnvError(
                f"{who} was made for a time step of {dt_s:g} s, the scene has {self.dt_s:g} s"
            )


def infer_actions(
    states: Float[np.ndarray, "*batch ticks 4"],
    valid: Bool[np.ndarray, "*batch ticks"],
    lengths_m: Float[np.ndarray, "*batch"],
    dt_s: float,
) -> Float[np.ndarray, "*batch ticks-1 2"]:
    """The actions between consecutive states; zero where either state is not valid."""
    both = valid[..., 1:] & valid[..., :-1]
    lengths = np.where(valid.any(axis=-1), lengths_m, 1).astype(states.dtype)[..., None]
    actions = inverse(states[..., :-1, :], states[..., 1:, :], lengths, dt_s)
    return np.where(both[..., None], actions, 0).astype(states.dtype)

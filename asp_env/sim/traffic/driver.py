"""The socket for drivers, which control agents other than the ego, and what drivers share."""

from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Shaped

from asp_env.data.classes import PREDICTED, AgentClass
from asp_env.data.scene import EGO
from asp_env.errors import AspEnvError
from asp_env.sim.world import World

Value = TypeVar("Value")
AnyDriver = TypeVar("AnyDriver", bound="BaseDriver")

CONTROLLABLE = PREDICTED | {AgentClass.BICYCLE}
"""The classes of agents that drivers may control."""

EXIT_MARGIN_M = 10.0
"""A controlled agent leaves the episode this far outside the area of all recorded positions.
Chosen by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Control:
    """What a driver's agents do in the coming tick."""

    actions: Float[np.ndarray, "b a 2"]
    """[acceleration m/s², steering rad]; zero for agents that are not controlled."""
    controlled: Bool[np.ndarray, "b a"]
    """Mask of agents that execute their action. An agent that is controlled before it appears stays
    absent."""
    leaving: Bool[np.ndarray, "b a"]
    """Mask of agents that leave now, or that will never appear."""
    euler: Bool[np.ndarray, "b a"] | None = None
    """Mask of agents whose action is integrated by Euler's method, because it belongs to a forecast
    of that kind; None if all are integrated by Heun's."""


@runtime_checkable
class Driver(Protocol):
    """Controls some agents of a world. It may store arrays between ticks, which `reset` renews.

    A deep copy is a snapshot of its memory. Values that never change, such as recordings and
    predictors, should be shared by the copies (`Shared`).
    """

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Prepares for episodes that have just started; the sizes of arrays may have changed.

        Args:
            world: the world with all episodes.
            reset_mask: mask of the new episodes.
            agent_mask: mask of the driver's agents in all episodes, constant during an episode; by
                default `controllable_agents`.

        Raises:
            AspEnvError: the driver does not fit the world.
        """
        ...

    def control(self, world: World) -> Control:
        """What the driver's agents do from now to the next tick."""
        ...


@runtime_checkable
class DriverPlug(Protocol):
    """What is registered under a driver's name in the entry point group `asp_env.drivers`."""

    def from_name(self, argument: str, *, dt_s: float) -> Driver:
        """Creates a driver.

        Args:
            argument: the part of the name after the first colon, possibly empty.
            dt_s: length of a tick.

        Raises:
            AspEnvError: the argument is missing, superfluous or invalid.
        """
        ...


class BaseDriver:
    """Base of drivers without an argument: their plug."""

    name: ClassVar[str]

    @classmethod
    def from_name(cls: type[AnyDriver], argument: str, *, dt_s: float) -> AnyDriver:
        """Creates the driver.

        Args:
            argument: must be empty.
            dt_s: not used.

        Raises:
            AspEnvError: there is an argument.
        """
        del dt_s
        if argument:
            raise AspEnvError(
                f"driver {cls.name} takes no argument, {argument!r} was given: use {cls.name}"
            )
        return cls()


class Shared(Generic[Value]):
    """A value that deep copies of its owner share, because it never changes."""

    def __init__(self, value: Value) -> None:
        self.value = value

    def __deepcopy__(self, memo: dict[int, Any]) -> "Shared[Value]":
        del memo
        return self


def no_control(shape: tuple[int, int]) -> Control:
    """A control of no agents, of shape (B, A)."""
    return Control(
        actions=np.zeros((*shape, 2), dtype=np.float32),
        controlled=np.zeros(shape, dtype=bool),
        leaving=np.zeros(shape, dtype=bool),
    )


def controllable_agents(world: World) -> Bool[np.ndarray, "b a"]:
    """Mask of agents that drivers may control: vehicles and bicycles, not parked, not the ego.

    The world always moves pedestrians, animals, trailers and parked vehicles.
    """
    episodes = world.episodes
    mask = np.isin(episodes.classes, [int(kind) for kind in CONTROLLABLE])
    mask &= ~episodes.parked & (episodes.ids >= 0)
    mask[:, EGO] = False
    return mask


def exit_bounds(world: World) -> Float[np.ndarray, "b 4"]:
    """The area of each episode beyond which agents leave: [min x, min y, max x, max y], m."""
    numbers, index = np.unique(world.episodes.recording, return_inverse=True)
    extents = np.array([world.recordings[int(number)].extent_m for number in numbers])
    return (extents + EXIT_MARGIN_M * np.array([-1, -1, 1, 1]))[index]


def outside_bounds(
    states: Float[np.ndarray, "b a 4"], bounds: Float[np.ndarray, "b 4"]
) -> Bool[np.ndarray, "b a"]:
    """Mask of agents whose centre is outside the bounds [min x, min y, max x, max y], m."""
    x, y = states[..., 0], states[..., 1]
    min_x, min_y, max_x, max_y = (bounds[:, i, None] for i in range(4))
    return (x < min_x) | (x > max_x) | (y < min_y) | (y > max_y)


def resized(array: Shaped[np.ndarray, "..."], shape: tuple[int, ...]) -> Shaped[np.ndarray, "..."]:
    """The array itself if it has this shape, else a cropped copy padded with zeros."""
    if array.shape == shape:
        return array
    out = np.zeros(shape, dtype=array.dtype)
    common = tuple(slice(min(sizes)) for sizes in zip(array.shape, shape, strict=True))
    out[common] = array[common]
    return out


def require_replay(world: World, driver: str) -> None:
    """Checks that uncontrolled agents replay their recorded tracks.

    Args:
        world: the world to check.
        driver: name of the driver that requires it, for the message.

    Raises:
        AspEnvError: they do not.
    """
    if world.traffic != "log":
        raise AspEnvError(
            f"traffic {driver}: this world replays no tracks, its vehicles drive themselves; "
            f"use {world.traffic}, idm or predictor:NAME, or recordings in a folder as DATA"
        )

"""The socket for drivers, and what all of them need."""

from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Shaped

from asp_env.data.classes import PREDICTED, AgentClass
from asp_env.data.scene import EGO
from asp_env.errors import AspEnvError
from asp_env.sim.world import World

Value = TypeVar("Value")
Made = TypeVar("Made", bound="BaseDriver")

LEAVES_BEYOND_M = 10.0
"""Where nobody was ever recorded within this distance, a driven agent leaves the episode."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Control:
    """What a driver wants its agents to do in the coming tick."""

    actions: Float[np.ndarray, "b a 2"]
    driven: Bool[np.ndarray, "b a"]
    """Who obeys them. Somebody who is not there yet stays away for as long as it is driven."""
    leaving: Bool[np.ndarray, "b a"]
    """Who is gone from now on, or never comes."""


@runtime_checkable
class Driver(Protocol):
    """Moves some agents of one world. It may keep arrays between ticks, made anew by `reset`.

    A deep copy is a snapshot of its memory: recordings, predictors and whatever else never changes
    should be shared by the copies (`Shared`).
    """

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """The episodes at `reset_mask` have just begun; sizes of the world's arrays may have changed.

        Args:
            world: what is driven in.
            reset_mask: the new episodes. The others go on.
            agent_mask: the agents of all episodes that are this driver's, fixed for an episode; by
                default all vehicles but the ego.
        """
        ...

    def control(self, world: World) -> Control:
        """What its agents do from now to the next tick; nothing for anybody else."""
        ...


@runtime_checkable
class DriverPlug(Protocol):
    """What the registry holds under a driver's name."""

    def from_name(self, argument: str, *, dt_s: float) -> Driver:
        """The driver for what stands behind the colon of its name, possibly nothing.

        Raises:
            AspEnvError: the argument is missing, superfluous, or not understood.
        """
        ...


class Shared(Generic[Value]):
    """Something that all copies of its owner have in common, since it never changes."""

    def __init__(self, value: Value) -> None:
        """Holds the value."""
        self.value = value

    def __deepcopy__(self, memo: dict[int, Any]) -> "Shared[Value]":
        """Itself."""
        del memo
        return self


def vehicles(world: World) -> Bool[np.ndarray, "b a"]:
    """Who can be driven: vehicles and bicycles that are not parked, but not the ego.

    Pedestrians, animals, trailers and parked vehicles are always left to the world.
    """
    kinds = [int(kind) for kind in PREDICTED | {AgentClass.BICYCLE}]
    episodes = world.episodes
    found = np.isin(episodes.classes, kinds) & ~episodes.parked & (episodes.ids >= 0)
    found[:, EGO] = False
    return found


def no_control(shape: tuple[int, int]) -> Control:
    """Nobody is driven."""
    return Control(
        actions=np.zeros((*shape, 2), dtype=np.float32),
        driven=np.zeros(shape, dtype=bool),
        leaving=np.zeros(shape, dtype=bool),
    )


def resized(array: Shaped[np.ndarray, "..."], shape: tuple[int, ...]) -> Shaped[np.ndarray, "..."]:
    """The array itself if it has that shape, else one that has, filled up with zeros."""
    if array.shape == shape:
        return array
    out = np.zeros(shape, dtype=array.dtype)
    common = tuple(slice(min(have, want)) for have, want in zip(array.shape, shape, strict=True))
    out[common] = array[common]
    return out


def areas(world: World) -> Float[np.ndarray, "b 4"]:
    """Of each episode, smallest x and y and largest x and y beyond which an agent leaves."""
    numbers, index = np.unique(world.episodes.recording, return_inverse=True)
    found = np.array([world.recordings[int(number)].extent_m for number in numbers])
    return (found + LEAVES_BEYOND_M * np.array([-1, -1, 1, 1]))[index]


def outside(
    states: Float[np.ndarray, "b a 4"], area: Float[np.ndarray, "b 4"]
) -> Bool[np.ndarray, "b a"]:
    """Whose centre lies outside of its episode's area."""
    x, y = states[..., 0], states[..., 1]
    low_x, low_y, high_x, high_y = (area[:, i, None] for i in range(4))
    return (x < low_x) | (x > high_x) | (y < low_y) | (y > high_y)


def check_replayed(world: World, who: str) -> None:
    """Refuses a world in which those whom nobody drives do not replay their log.

    Raises:
        AspEnvError: this is one.
    """
    if world.traffic != "log":
        raise AspEnvError(
            f"traffic {who}: in this world nobody replays a log, its vehicles drive themselves; "
            f"use {world.traffic}, idm or predictor:NAME, or recordings in a folder as DATA"
        )


class BaseDriver:
    """Drivers whose name says it all: what the registry asks of them."""

    name: ClassVar[str]

    @classmethod
    def from_name(cls: type[Made], argument: str, *, dt_s: float) -> Made:
        """The driver, which takes no argument.

        Raises:
            AspEnvError: there is one.
        """
        del dt_s
        if argument:
            raise AspEnvError(
                f"driver {cls.name} takes no argument, {argument!r} was given: use {cls.name}"
            )
        return cls()

"""Classes of agents, the names that files use for them, and default footprints."""

from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Int

from asp_env.errors import DataError


class AgentClass(IntEnum):
    """Class of an agent. Caches and rollouts store the numbers, which therefore never change."""

    CAR = 0
    VAN = 1
    TRUCK = 2
    BUS = 3
    TRUCK_BUS = 4
    TRAILER = 5
    MOTORCYCLE = 6
    BICYCLE = 7
    PEDESTRIAN = 8
    ANIMAL = 9
    OTHER = 10


ALIASES = {
    **{kind.name.lower(): kind for kind in AgentClass},
    "passenger": AgentClass.CAR,
    "pedestrian/bicycle": AgentClass.BICYCLE,
    "cyclist": AgentClass.BICYCLE,
    "bike": AgentClass.BICYCLE,
    "motorbike": AgentClass.MOTORCYCLE,
    "motorcyclist": AgentClass.MOTORCYCLE,
    "person": AgentClass.PEDESTRIAN,
    "lorry": AgentClass.TRUCK,
    "unknown": AgentClass.OTHER,
}
"""Class by its lower-case name in the files of inD, rounD, INTERACTION and related data sets."""

FOOTPRINTS_M = np.array(
    [
        (4.5, 1.8),
        (5.5, 2.0),
        (9.0, 2.5),
        (12.0, 2.5),
        (10.0, 2.5),
        (7.0, 2.5),
        (2.2, 0.8),
        (1.8, 0.6),
        (0.5, 0.5),
        (0.8, 0.4),
        (2.0, 1.0),
    ],
    dtype=np.float32,
)
"""(classes, 2) length and width, m, of agents whose file gives 0. Chosen by hand."""

PREDICTED = frozenset(
    {
        AgentClass.CAR,
        AgentClass.VAN,
        AgentClass.TRUCK,
        AgentClass.BUS,
        AgentClass.TRUCK_BUS,
        AgentClass.MOTORCYCLE,
        AgentClass.OTHER,
    }
)
"""Classes that are predicted and can be driven: all but bicycles and pedestrians (as in Janjoš et
al. 2021), animals and trailers."""

VULNERABLE = frozenset({AgentClass.BICYCLE, AgentClass.PEDESTRIAN, AgentClass.ANIMAL})
"""Vulnerable road users, whose recorded heading is unreliable."""

_IS_PREDICTED = np.array([kind in PREDICTED for kind in range(max(AgentClass) + 1)])


def is_predicted(classes: Int[np.ndarray, "*n"]) -> Bool[np.ndarray, "*n"]:
    """Mask of the agents whose `AgentClass` is one of `PREDICTED`."""
    return np.asarray(_IS_PREDICTED[classes])


def parse_class(name: str) -> AgentClass:
    """The class of a name in a file, in upper or lower case.

    Raises:
        DataError: the name is unknown.
    """
    try:
        return ALIASES[name.strip().lower()]
    except (KeyError, AttributeError):
        known = ", ".join(sorted(ALIASES))
        raise DataError(f"unknown class {name!r}: known are {known}") from None

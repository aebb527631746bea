"""Road users: one enumeration, the names that files use for them, and default footprints."""

from enum import IntEnum

import numpy as np

from asp_env.errors import DataError


class AgentClass(IntEnum):
    """What an agent is. The numbers are stored in caches and rollouts and never change."""

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
"""Lower-cased class names of files; inD, rounD, INTERACTION and its relatives."""

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
"""(classes, 2) default length and width where a file says 0."""

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
"""Targets of prediction: every class but bicycles and pedestrians (paper), animals and trailers."""

VULNERABLE = frozenset({AgentClass.BICYCLE, AgentClass.PEDESTRIAN, AgentClass.ANIMAL})
"""Road users whose recorded heading is not to be relied on."""


def parse_class(name: str) -> AgentClass:
    """The class that a file calls `name`, in any case.

    Raises:
        DataError: the name is not known.
    """
    try:
        return ALIASES[name.strip().lower()]
    except (KeyError, AttributeError):
        known = ", ".join(sorted(ALIASES))
        raise DataError(f"unknown class {name!r}: known are {known}") from None

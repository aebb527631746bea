"""Who drives whom: a table from agents to drivers, merged by mask."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool

from asp_env import registry
from asp_env.data.classes import PREDICTED, AgentClass, parse_class
from asp_env.data.recording import DEFAULT_DT_S
from asp_env.errors import AspEnvError, DataError
from asp_env.sim.traffic import Control, Driver, DriverPlug
from asp_env.sim.traffic.driver import no_control, resized, vehicles
from asp_env.sim.traffic.log import LogDriver
from asp_env.sim.world import World

TrafficSpec = str | Driver | Mapping[Any, str | Driver]
"""A driver or its name, or a table from ids, names of classes and `default` to those."""

DEFAULT = "default"
DRIVABLE = PREDICTED | {AgentClass.BICYCLE}
_NEXT_PAIR = re.compile(r",(?=[^,:=]+=)")

_KEYS = f"an agent's id, {', '.join(sorted(kind.name.lower() for kind in DRIVABLE))} or {DEFAULT}"


class Traffic:
    """Drivers side by side in one episode, each of its own agents.

    An agent has the driver of its id, else of its class, else the default one, from the reset of
    its episode to its end. Only vehicles that are not parked are driven; all others are left to
    the world.
    """

    def __init__(
        self,
        drivers: Sequence[Driver],
        *,
        default: int,
        by_class: Mapping[AgentClass, int],
        by_id: Mapping[int, int],
    ) -> None:
        """A table of indices into `drivers`."""
        self.drivers = tuple(drivers)
        self._of_class = np.full(len(AgentClass), default)
        for kind, number in by_class.items():
            self._of_class[kind] = number
        self._ids = np.array(sorted(by_id), dtype=np.int64)
        self._of_id = np.array([by_id[key] for key in sorted(by_id)], dtype=np.int64)
        self._masks = np.zeros((len(drivers), 0, 0), dtype=bool)

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Deals the agents of the new episodes."""
        ids, driven = world.episodes.ids, vehicles(world) if agent_mask is None else agent_mask
        number = self._of_class[world.episodes.classes]
        if len(self._ids):
            at = np.searchsorted(self._ids, ids).clip(max=len(self._ids) - 1)
            number = np.where(self._ids[at] == ids, self._of_id[at], number)
        self._masks = resized(self._masks, (len(self.drivers), *ids.shape))
        dealt = driven & (number == np.arange(len(self.drivers))[:, None, None])
        self._masks[:, reset_mask] = dealt[:, reset_mask]
        for driver, theirs in zip(self.drivers, self._masks, strict=True):
            if theirs.any():
                driver.reset(world, reset_mask, theirs.copy())

    def control(self, world: World) -> Control:
        """What all of them say, each of its own agents."""
        merged = no_control(world.episodes.ids.shape)
        for driver, theirs in zip(self.drivers, self._masks, strict=True):
            if theirs.any():
                control = driver.control(world)
                np.copyto(merged.actions, control.actions, where=control.driven[..., None])
                np.logical_or(merged.driven, control.driven, out=merged.driven)
                np.logical_or(merged.leaving, control.leaving, out=merged.leaving)
        return merged


def make_traffic(
    spec: TrafficSpec | None, *, dt_s: float = DEFAULT_DT_S, default: str = LogDriver.name
) -> Driver:
    """The driver, or table of drivers, of all agents that the caller does not move.

    Args:
        spec: a driver, or the name of one such as `idm` or `predictor:ssp-asp:RUN`; or a table
            `{"default": "idm", "truck": "log", 17: driver}`, which as text is
            `default=idm,truck=log,17=policy`. None, and a table without a default, leave the
            others to the world.
        dt_s: the time step of the world to come, for drivers that depend on it.
        default: the name of the driver that leaves everybody to the world to come.

    Raises:
        AspEnvError: a name is unknown, or a key is neither an id, a vehicle's class nor `default`.
    """
    if spec is None:
        spec = default
    if isinstance(spec, str):
        if "=" not in spec.partition(":")[0]:
            return _make_driver(spec, dt_s)
        spec = _parse(spec)
    if not isinstance(spec, Mapping):
        if not isinstance(spec, Driver):
            raise AspEnvError(f"traffic {spec!r}: expected the name of a driver or a table of them")
        return spec
    return _make_table({DEFAULT: default, **spec}, dt_s)


def _parse(text: str) -> dict[str, str]:
    """`idm` stands for itself; `default=idm,17=log` for a table."""
    table: dict[str, str] = {}
    for pair in _NEXT_PAIR.split(text):
        key, _, name = (part.strip() for part in pair.partition("="))
        if key in table:
            raise AspEnvError(f"traffic {text!r} names {key!r} twice")
        table[key] = name
    return table


def _make_table(spec: Mapping[Any, str | Driver], dt_s: float) -> Traffic:
    drivers: list[Driver] = []
    numbers: dict[str | int, int] = {}
    by_class: dict[AgentClass, int] = {}
    by_id: dict[int, int] = {}
    default = 0
    for key, value in spec.items():
        name = value if isinstance(value, str) else id(value)
        if name not in numbers:
            numbers[name] = len(drivers)
            drivers.append(make_traffic(value, dt_s=dt_s))
        if key == DEFAULT:
            default = numbers[name]
        elif isinstance(key, str) and not key.isdigit():
            by_class[_vehicle_class(key)] = numbers[name]
        elif int(key) >= 0:
            by_id[int(key)] = numbers[name]
        else:
            raise AspEnvError(f"traffic for {key}: expected {_KEYS}")
    return Traffic(drivers, default=default, by_class=by_class, by_id=by_id)


def _vehicle_class(key: str) -> AgentClass:
    try:
        kind = parse_class(key)
    except DataError:
        raise AspEnvError(f"traffic for {key!r}: expected {_KEYS}") from None
    if kind not in DRIVABLE:
        raise AspEnvError(f"traffic for {key!r}: only vehicles are driven; expected {_KEYS}")
    return kind


def _make_driver(name: str, dt_s: float) -> Driver:
    kind, _, argument = name.partition(":")
    plug: DriverPlug = registry.find("drivers", kind)
    return plug.from_name(argument, dt_s=dt_s)

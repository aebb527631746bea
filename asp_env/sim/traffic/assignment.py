"""Assignment of agents to drivers: by id, by class, or by default."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool

from asp_env import registry
from asp_env.arguments import shown, whole_number
from asp_env.data.classes import AgentClass, parse_class
from asp_env.data.recording import DEFAULT_DT_S
from asp_env.errors import AspEnvError, DataError
from asp_env.sim.traffic.driver import (
    CONTROLLABLE,
    Control,
    Driver,
    DriverPlug,
    controllable_agents,
    no_control,
    resized,
)
from asp_env.sim.traffic.log import LogDriver
from asp_env.sim.world import World

TrafficSpec = str | Driver | Mapping[Any, str | Driver]
"""A driver or its name, or a table from ids, names of classes and `default` to drivers or names."""

DEFAULT = "default"
"""The key of the driver of all agents that no other key of a table covers."""

_NEXT_PAIR = re.compile(r",(?=[^,:=]+=)")

_KEYS = (
    f"an agent's id, {', '.join(sorted(kind.name.lower() for kind in CONTROLLABLE))} or {DEFAULT}"
)


class Traffic:
    """Several drivers in one episode, each with its own agents.

    From the start of its episode to the end, an agent has the driver of its id, else that of its
    class, else the default one. Agents that drivers may not control (`controllable_agents`) are
    left to the world.
    """

    def __init__(
        self,
        drivers: Sequence[Driver],
        *,
        default: int,
        by_class: Mapping[AgentClass, int],
        by_id: Mapping[int, int],
    ) -> None:
        """Creates a table.

        Args:
            drivers: the drivers, which the other arguments refer to by index.
            default: driver of the agents that neither mapping covers.
            by_class: driver of each class.
            by_id: driver of each agent id.
        """
        self.drivers = tuple(drivers)
        self._of_class = np.full(len(AgentClass), default)
        for kind, index in by_class.items():
            self._of_class[kind] = index
        self._ids = np.array(sorted(by_id), dtype=np.int64)
        self._of_id = np.array([by_id[key] for key in sorted(by_id)], dtype=np.int64)
        self._masks = np.zeros((len(drivers), 0, 0), dtype=bool)
        """The agents of each driver: (drivers, B, A)."""

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Assigns the agents of the new episodes; drivers without any agent are not reset."""
        ids = world.episodes.ids
        agents = controllable_agents(world) if agent_mask is None else agent_mask
        index = self._of_class[world.episodes.classes]
        if len(self._ids):
            position = np.searchsorted(self._ids, ids).clip(max=len(self._ids) - 1)
            index = np.where(self._ids[position] == ids, self._of_id[position], index)
        self._masks = resized(self._masks, (len(self.drivers), *ids.shape))
        assigned = agents & (index == np.arange(len(self.drivers))[:, None, None])
        self._masks[:, reset_mask] = assigned[:, reset_mask]
        for driver, mask in zip(self.drivers, self._masks, strict=True):
            if mask.any():
                driver.reset(world, reset_mask, mask.copy())

    def control(self, world: World) -> Control:
        """The controls of all drivers, merged; drivers without any agent are not called."""
        merged = no_control(world.episodes.ids.shape)
        euler = np.zeros(merged.controlled.shape, dtype=bool)
        for driver, mask in zip(self.drivers, self._masks, strict=True):
            if mask.any():
                control = driver.control(world)
                np.copyto(merged.actions, control.actions, where=control.controlled[..., None])
                np.logical_or(merged.controlled, control.controlled, out=merged.controlled)
                np.logical_or(merged.leaving, control.leaving, out=merged.leaving)
                if control.euler is not None:
                    np.logical_or(euler, control.euler, out=euler)
        return dataclasses.replace(merged, euler=euler if euler.any() else None)


def make_traffic(
    spec: TrafficSpec | None, *, dt_s: float = DEFAULT_DT_S, default: str = LogDriver.name
) -> Driver:
    """The driver, or table of drivers, of all agents that the caller does not control.

    Args:
        spec: a driver, or a name such as `idm` or `predictor:ssp-asp:RUN`; or a table such as
            `{"default": "idm", "truck": "log", 17: driver}`, which may be given as the text
            `default=idm,truck=log,17=policy`. Without a default, the other agents have the driver
            `default`; None means all agents.
        dt_s: length of a tick, for drivers that depend on it.
        default: name of the driver that leaves all agents to the world (`World.traffic`).

    Raises:
        AspEnvError: a name is unknown, or a key is neither an id, a vehicle's class nor `default`.
    """
    if spec is None:
        spec = default
    if isinstance(spec, str):
        if "=" not in spec.partition(":")[0]:
            return _make_driver(spec, dt_s)
        spec = _parse_table(spec)
    if not isinstance(spec, Mapping):
        if not isinstance(spec, Driver):
            raise AspEnvError(f"traffic {spec!r}: expected the name of a driver or a table of them")
        return spec
    return _make_table({DEFAULT: default, **spec}, dt_s)


def _parse_table(text: str) -> dict[str, str]:
    table: dict[str, str] = {}
    for pair in _NEXT_PAIR.split(text):
        key, _, name = (part.strip() for part in pair.partition("="))
        if key in table:
            raise AspEnvError(f"traffic {text!r} names {key!r} twice")
        table[key] = name
    return table


def _make_table(spec: Mapping[Any, str | Driver], dt_s: float) -> Traffic:
    drivers: list[Driver] = []
    indices: dict[str | int, int] = {}
    by_class: dict[AgentClass, int] = {}
    by_id: dict[int, int] = {}
    default = 0
    for key, value in spec.items():
        if value is None:
            raise AspEnvError(f"traffic for {key!r}: None, expected the name of a driver")
        name = value if isinstance(value, str) else id(value)
        if name not in indices:
            indices[name] = len(drivers)
            drivers.append(make_traffic(value, dt_s=dt_s))
        if key == DEFAULT:
            default = indices[name]
        elif isinstance(key, str) and not key.isdecimal():
            by_class[_controllable_class(key)] = indices[name]
        else:
            by_id[_agent_id(key)] = indices[name]
    return Traffic(drivers, default=default, by_class=by_class, by_id=by_id)


def _agent_id(key: object) -> int:
    try:
        return whole_number("", int(key) if isinstance(key, str) else key, least=0)
    except AspEnvError:
        raise AspEnvError(f"traffic for {shown(key)}: expected {_KEYS}") from None


def _controllable_class(key: str) -> AgentClass:
    try:
        kind = parse_class(key)
    except DataError:
        raise AspEnvError(f"traffic for {key!r}: expected {_KEYS}") from None
    if kind not in CONTROLLABLE:
        raise AspEnvError(f"traffic for {key!r}: only vehicles have drivers; expected {_KEYS}")
    return kind


def _make_driver(name: str, dt_s: float) -> Driver:
    kind, _, argument = name.partition(":")

    def made_by(plug: DriverPlug) -> Any:
        return plug.from_name(argument, dt_s=dt_s)

    return registry.make("drivers", kind, made_by, Driver)

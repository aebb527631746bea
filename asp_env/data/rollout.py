"""The log of an episode, saved as one `.npz` without pickles."""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env import arguments
from asp_env.data.classes import AgentClass
from asp_env.data.scenarios.scenario import Scenario
from asp_env.errors import DataError
from asp_env.files import atomic_file
from asp_env.stored import brief, check_fields, parse_json, read_arrays

FORMAT = 1
"""Version of the file format."""

MAX_POSITION_M = 1e7
"""Largest coordinate; UTM coordinates are below 10,000 km."""

LONGEST_TICK_S = 60.0
"""Largest time step. Chosen by hand."""

_AXES = (
    ("states", "ticks a 4", "f"),
    ("valid", "ticks a", "b"),
    ("log_states", "ticks a 4", "f"),
    ("log_valid", "ticks a", "b"),
    ("sizes", "a 2", "f"),
    ("classes", "a", "iu"),
    ("ids", "a", "iu"),
    ("route", "p 2", "f"),
    ("plans", "plans horizon 2", "f"),
    ("forecast_states", "rows modes steps 2", "f"),
    ("forecast_log_probs", "rows modes", "f"),
    ("forecast_slots", "rows", "iu"),
    ("forecast_ticks", "rows", "iu"),
    ("events", "ticks kinds", "b"),
)
"""Name, axes and dtype kinds of each array in a file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rollout:
    """The log of one episode with A agents; tick 0 is the first observation."""

    scenario: Scenario
    dt_s: float
    """Seconds per tick."""
    states: Float[np.ndarray, "ticks a 4"]
    """[x m, y m, heading rad, speed m/s] of the episode."""
    valid: Bool[np.ndarray, "ticks a"]
    """Whether the agent is present."""
    log_states: Float[np.ndarray, "ticks a 4"]
    """The recorded states at the same ticks."""
    log_valid: Bool[np.ndarray, "ticks a"]
    sizes: Float[np.ndarray, "a 2"]
    """Length and width, m."""
    classes: Int[np.ndarray, " a"]
    """`AgentClass` of each agent."""
    ids: Int[np.ndarray, " a"]
    """Track ids."""
    route: Float[np.ndarray, "p 2"]
    """The ego's route, points 1 m apart."""
    plans: Float[np.ndarray, "plans horizon 2"]
    """Planned positions of the ego from tick 0 on, m; empty if it follows no planner."""
    forecast_states: Float[np.ndarray, "rows modes steps 2"]
    """Forecast positions of all ticks, back to back, m."""
    forecast_log_probs: Float[np.ndarray, "rows modes"]
    """Natural logarithms of the modes' probabilities."""
    forecast_slots: Int[np.ndarray, " rows"]
    """The agent of each forecast."""
    forecast_ticks: Int[np.ndarray, " rows"]
    """The tick of the episode at which each forecast was made."""
    events: Bool[np.ndarray, "ticks kinds"]
    """Which events of `event_names` occur at each tick."""
    event_names: tuple[str, ...]

    def save(self, path: str | Path) -> None:
        """Writes one compressed `.npz`, atomically."""
        header = {
            "format": FORMAT,
            "scenario": dataclasses.asdict(self.scenario),
            "dt_s": self.dt_s,
            "event_names": self.event_names,
        }
        arrays: dict[str, Any] = {
            field.name: value
            for field in dataclasses.fields(self)
            if isinstance(value := getattr(self, field.name), np.ndarray)
        }
        text = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
        with atomic_file(arguments.path("rollout", path)) as partial, partial.open("wb") as file:
            np.savez_compressed(file, header=text, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> "Rollout":
        """Reads a file written by `save`.

        Raises:
            DataError: the file is missing, damaged, or of another format version.
        """
        path = arguments.path("rollout", path)
        try:
            arrays = read_arrays(path)
            header = parse_json(arrays.pop("header").tobytes())
            if header["format"] != FORMAT:
                raise DataError(
                    f"rollout format {brief(repr(header['format']))}, expected {FORMAT}"
                )
            _check_header(header)
            _check(arrays, header)
            _check_values(arrays)
            scenario = {**header["scenario"], "tags": tuple(header["scenario"]["tags"])}
            return cls(
                scenario=Scenario(**scenario),
                dt_s=float(header["dt_s"]),
                event_names=tuple(header["event_names"]),
                **{name: arrays[name] for name, _, _ in _AXES},
            )
        except DataError as error:
            raise DataError(f"{path}: {error}") from error
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(f"{path}: not a readable rollout ({brief(error)})") from error


def _check_header(header: Mapping[str, Any]) -> None:
    """Checks the types and ranges of what is not an array.

    Raises:
        DataError: a value is damaged.
    """
    check_fields(Rollout, {name: header[name] for name in ("dt_s", "event_names")})
    if not 0 < header["dt_s"] <= LONGEST_TICK_S:
        raise DataError(
            f"time step {header['dt_s']} s: expected a positive number up to {LONGEST_TICK_S:g}"
        )
    check_fields(Scenario, header["scenario"])
    for name in ("recording", "start_tick", "length"):
        if header["scenario"][name] < 0:
            raise DataError(f"{name} is {header['scenario'][name]}, expected 0 or more")


def _check(arrays: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> None:
    """Checks shapes, dtypes and index ranges.

    Raises:
        DataError: an array does not fit the others or the header.
    """
    sizes: dict[str, int] = {"kinds": len(header["event_names"])}
    for name, axes, kinds in _AXES:
        array = arrays[name]
        if array.dtype.kind not in kinds or array.ndim != len(axes.split()):
            raise DataError(f"{name}: {array.dtype} {array.shape}, expected ({axes})")
        for axis, size in zip(axes.split(), array.shape, strict=True):
            expected = int(axis) if axis.isdigit() else sizes.setdefault(axis, size)
            if size != expected:
                raise DataError(f"{name}: {size} along {axis!r}, expected {expected}")
    if not (sizes["ticks"] and sizes["a"] and sizes["plans"] <= sizes["ticks"]):
        raise DataError(f"{sizes['ticks']} ticks, {sizes['a']} agents, {sizes['plans']} plans")
    ends = {"forecast_slots": sizes["a"], "forecast_ticks": sizes["ticks"]}
    for name, end in (ends | {"classes": len(AgentClass)}).items():
        if not ((arrays[name] >= 0) & (arrays[name] < end)).all():
            raise DataError(f"{name}: expected numbers from 0 to {end - 1}")


def _check_values(arrays: Mapping[str, np.ndarray]) -> None:
    """Checks that all numbers are plausible that a mask does not leave out.

    Raises:
        DataError: a number is not finite, or too large.
    """
    shown = {
        "states": arrays["states"][arrays["valid"]],
        "log_states": arrays["log_states"][arrays["log_valid"]],
        **{name: arrays[name] for name in ("sizes", "route", "plans", "forecast_states")},
    }
    for name, values in shown.items():
        if not (np.abs(values) <= MAX_POSITION_M).all():
            raise DataError(f"{name}: expected numbers up to {MAX_POSITION_M:,.0f}")
    if not (arrays["sizes"] >= 0).all():
        raise DataError("sizes: expected no negative number")
    if not (arrays["forecast_log_probs"] <= 1e-3).all():
        raise DataError("forecast_log_probs: expected logarithms of probabilities")

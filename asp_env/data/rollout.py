"""The log of an episode, saved as one `.npz` without pickles."""

import dataclasses
import json
import math
import zipfile
import zlib
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

FORMAT = 1
"""Version of the file format."""

_READ_ERRORS = (
    *(OSError, EOFError, ValueError, KeyError, TypeError),
    *(zipfile.BadZipFile, zlib.error),
    RuntimeError,  # an encrypted archive, or an unknown compression method
)

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
            with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            header = json.loads(arrays.pop("header").tobytes())
            if header["format"] != FORMAT:
                raise DataError(f"rollout format {header['format']}, expected {FORMAT}")
            _check(arrays, header)
            scenario = header["scenario"]
            scenario["tags"] = tuple(scenario["tags"])
            return cls(
                scenario=Scenario(**scenario),
                dt_s=header["dt_s"],
                event_names=tuple(header["event_names"]),
                **arrays,
            )
        except DataError as error:
            raise DataError(f"{path}: {error}") from error
        except _READ_ERRORS as error:
            reason = str(error) or type(error).__name__
            raise DataError(f"{path}: not a readable rollout ({reason})") from error


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
    if not 0 < header["dt_s"] < math.inf:
        raise DataError(f"time step {header['dt_s']} s: expected a positive number")

"""The log of an episode, saved as one `.npz` without pickles."""

import dataclasses
import json
import os
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.scenario import Scenario
from asp_env.errors import DataError

FORMAT = 1

_DAMAGED = (
    *(OSError, EOFError, ValueError, KeyError, TypeError),
    *(zipfile.BadZipFile, zlib.error, RuntimeError),  # the last: encrypted, or of another method
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rollout:
    """What happened in one episode of L steps with A agents; tick 0 is the first observation."""

    scenario: Scenario
    dt_s: float
    states: Float[np.ndarray, "ticks a 4"]
    valid: Bool[np.ndarray, "ticks a"]
    log_states: Float[np.ndarray, "ticks a 4"]
    """What the recording holds, for comparison."""
    log_valid: Bool[np.ndarray, "ticks a"]
    sizes: Float[np.ndarray, "a 2"]
    classes: Int[np.ndarray, " a"]
    ids: Int[np.ndarray, " a"]
    route: Float[np.ndarray, "p 2"]
    plans: Float[np.ndarray, "plans horizon 2"]
    """The ego's planned positions at each tick where it planned; may be empty."""
    forecast_states: Float[np.ndarray, "rows modes steps 2"]
    """Forecast positions of all ticks, back to back."""
    forecast_log_probs: Float[np.ndarray, "rows modes"]
    forecast_slots: Int[np.ndarray, " rows"]
    forecast_ticks: Int[np.ndarray, " rows"]
    """The tick of the episode at which each row was said."""
    events: Bool[np.ndarray, "ticks kinds"]
    event_names: tuple[str, ...]

    def save(self, path: Path) -> None:
        """Writes one compressed `.npz`, aside first, then renamed."""
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
        aside = path.with_name(f".{path.name}.{os.getpid()}.npz")
        np.savez_compressed(aside, header=text, **arrays)
        aside.replace(path)

    @classmethod
    def load(cls, path: Path) -> "Rollout":
        """Reads what `save` wrote.

        Raises:
            DataError: the file is missing, damaged, or of another format.
        """
        try:
            with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            header = json.loads(arrays.pop("header").tobytes())
            if header["format"] != FORMAT:
                raise DataError(f"{path}: rollout format {header['format']}, expected {FORMAT}")
            scenario = header["scenario"]
            scenario["tags"] = tuple(scenario["tags"])
            return cls(
                scenario=Scenario(**scenario),
                dt_s=header["dt_s"],
                event_names=tuple(header["event_names"]),
                **arrays,
            )
        except DataError:
            raise
        except _DAMAGED as error:
            why = str(error) or type(error).__name__
            raise DataError(f"{path}: not a rollout that can be read ({why})") from error

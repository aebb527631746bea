"""Errors of forecasts on every snippet of the test recordings, stored in one file per predictor."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.predictor import Predictor
from asp_env.data.snippets import SnippetIndex, gather_scene, index_snippets
from asp_env.data.source import Recordings
from asp_env.data.split import snippet_parts
from asp_env.errors import AspEnvError, DataError
from asp_env.evaluation.open_loop.ground_truth import gather_ground_truth
from asp_env.evaluation.open_loop.scoring import (
    BATCH,
    ForecastSample,
    complete_forecast,
    mode_violations,
    stays_on_road,
)
from asp_env.files import atomic_file
from asp_env.metrics.forecast.errors import SELECTIONS, moving, open_loop_errors
from asp_env.stored import read_arrays

METRICS = ("MAE", "MSE", "ADE", "FDE")

VIOLATIONS = ("infeasible", "off-road", "overlap")
"""Why a mode cannot be driven, as in `mode_violations`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Errors:
    """Errors of one predictor on N snippets."""

    values: Float[np.ndarray, "selections metrics n"]
    """In the order of `SELECTIONS` and `METRICS`; in metres, MSE in square metres."""
    moving: Bool[np.ndarray, " n"]
    """Mask of the targets that move."""
    recording: Int[np.ndarray, " n"]
    track: Int[np.ndarray, " n"]
    tick: Int[np.ndarray, " n"]
    stamp: str
    """Hash of all that the errors depend on."""
    violations: Float[np.ndarray, "violations n"]
    """Share of all modes for which each of `VIOLATIONS` holds."""
    violations_valid: Bool[np.ndarray, "violations n"]
    """Mask of the snippets to which each of them applies; false in files of earlier versions, which
    have no violations."""

    def save(self, path: Path) -> None:
        """Writes a compressed `.npz` file atomically."""
        with atomic_file(path) as partial, partial.open("wb") as file:
            np.savez_compressed(
                file,
                values=self.values,
                moving=self.moving,
                recording=self.recording,
                track=self.track,
                tick=self.tick,
                stamp=np.array(self.stamp),
                violations=self.violations,
                violations_valid=self.violations_valid,
            )

    @classmethod
    def load(cls, path: Path) -> "Errors":
        """Reads a file that `save` wrote.

        Raises:
            DataError: the file is missing or damaged.
        """
        try:
            file = read_arrays(path)
            nothing = np.zeros((len(VIOLATIONS), len(file["moving"])), dtype=bool)
            return cls(
                values=file["values"],
                moving=file["moving"],
                recording=file["recording"],
                track=file["track"],
                tick=file["tick"],
                stamp=str(file["stamp"]),
                violations=file.get("violations", nothing.astype(np.float32)),
                violations_valid=file.get("violations_valid", nothing),
            )
        except (OSError, KeyError, ValueError, TypeError) as error:
            reason = str(error) or type(error).__name__
            raise DataError(
                f"{path}: not readable errors of forecasts ({reason}); remove the file, and they "
                "are computed again"
            ) from error


def stamp_of(path: Path) -> str | None:
    """The stamp of a file of errors; None if the file does not exist or is damaged."""
    try:
        return str(read_arrays(path)["stamp"])
    except (OSError, KeyError, ValueError):
        return None


def snippets_to_evaluate(
    recordings: Recordings,
    *,
    horizon_s: float,
    dt_s: float,
    part: Literal["test", "all"],
    per_recording: int | None,
    parked: bool = False,
) -> SnippetIndex:
    """The snippets that all predictors are evaluated on.

    Args:
        recordings: the recordings.
        horizon_s: forecast horizon in seconds.
        dt_s: duration of a tick in seconds.
        part: `test` of the split by recording, or `all`.
        per_recording: largest number of snippets of each recording, which are chosen at random;
            None for all.
        parked: whether parked vehicles are targets, too.

    Raises:
        AspEnvError: there is no snippet, or the recordings cannot be split.
    """
    index = index_snippets(recordings, dt_s=dt_s, horizon_s=horizon_s, parked=parked)
    if part == "test":
        parts, _ = snippet_parts(recordings, index, "recording")
        index = index.select(parts == "test")
    if per_recording is not None:
        rng = np.random.default_rng(0)
        chosen = [np.zeros(0, dtype=np.int64)]
        for number in np.unique(index.recording):
            rows = np.flatnonzero(index.recording == number)
            count = min(per_recording, len(rows))
            chosen.append(np.sort(rng.choice(rows, count, replace=False)))
        index = index.select(np.concatenate(chosen))
    if not len(index):
        raise AspEnvError(
            f"no snippet of {recordings.source!r} is left to evaluate {horizon_s:g} s on: give "
            "more recordings, or longer ones"
        )
    return index


def compute_errors(
    predictors: Mapping[str, Predictor],
    index: SnippetIndex,
    *,
    scenes: Sequence[Any],
    recorded: Sequence[Any],
    stamp: str,
) -> dict[str, Errors]:
    """Errors of every predictor on the same snippets, by name.

    Args:
        predictors: predictors by any name.
        index: the snippets.
        scenes: the recordings that scenes are made from.
        recorded: the same recordings as ground truth.
        stamp: hash of all that the errors depend on.

    Raises:
        AspEnvError: a predictor omits targets or forecasts less than the horizon.
    """
    count = len(index)
    values = {
        name: np.zeros((len(SELECTIONS), len(METRICS), count), dtype=np.float32)
        for name in predictors
    }
    shape = (len(VIOLATIONS), count)
    violations = {name: np.zeros(shape, dtype=np.float32) for name in predictors}
    applies = np.zeros(shape, dtype=bool)
    moves = np.zeros(count, dtype=bool)
    for start in range(0, count, BATCH):
        rows = slice(start, min(start + BATCH, count))
        chosen = index.select(np.arange(rows.start, rows.stop))
        scene, known = gather_scene(scenes, chosen), gather_ground_truth(recorded, chosen)
        future, now, on_road = known.future, known.present, stays_on_road(known)
        moves[rows] = moving(now, future.states[..., :2], future.valid)
        # Differences of positions far from the origin would lose millimetres in float32.
        origin = now[:, None, :2]
        truth = future.states[..., :2] - origin
        for name, predictor in predictors.items():
            forecast = complete_forecast(predictor, scene, future, index.horizon_ticks)
            sample = ForecastSample(
                states=forecast.states[:, :, : index.horizon_ticks],
                log_probs=forecast.log_probs,
                now=scene.target_states,
            )
            local = sample.states[..., :2] - origin[:, None]
            for which, selection in enumerate(SELECTIONS):
                errors = open_loop_errors(local, forecast.log_probs, truth, future.valid, selection)
                values[name][which, :, rows] = [errors[metric].value for metric in METRICS]
            of_modes = mode_violations(sample, known, on_road, dt_s=index.dt_s)
            for number, violation in enumerate(VIOLATIONS):
                violates, applies[number, rows] = of_modes[violation]
                violations[name][number, rows] = violates.mean(axis=1)
    return {
        name: Errors(
            values=array,
            moving=moves,
            recording=index.recording.astype(np.int32),
            track=index.track.astype(np.int32),
            tick=index.tick.astype(np.int32),
            stamp=stamp,
            violations=violations[name],
            violations_valid=applies,
        )
        for name, array in values.items()
    }

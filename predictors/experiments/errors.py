"""Errors of forecasts on every snippet of the test recordings, kept for all later questions."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.predictor import Predictor
from asp_env.data.snippets import (
    SnippetIndex,
    gather_future,
    gather_present,
    gather_scene,
    index_snippets,
)
from asp_env.data.source import Recordings
from asp_env.data.split import snippet_parts
from asp_env.errors import AspEnvError
from asp_env.evaluation.open_loop.judging import BATCH, ask
from asp_env.metrics.forecast.errors import SELECTIONS, moving, open_loop_errors

METRICS = ("MAE", "MSE", "ADE", "FDE")


@dataclass(frozen=True, slots=True, kw_only=True)
class Errors:
    """One predictor's errors on N snippets."""

    values: Float[np.ndarray, "selections metrics n"]
    """In the order of `SELECTIONS` and `METRICS`; metres, MSE square metres."""
    moving: Bool[np.ndarray, " n"]
    recording: Int[np.ndarray, " n"]
    track: Int[np.ndarray, " n"]
    tick: Int[np.ndarray, " n"]
    stamp: str
    """What they were made of; other data or weights have another."""

    def of(self, selection: str, metric: str) -> Float[np.ndarray, " n"]:
        """One metric of one selection."""
        return self.values[[*SELECTIONS].index(selection), METRICS.index(metric)]

    def same_snippets(self, other: "Errors") -> bool:
        """Whether they speak of the same targets at the same times, in the same order."""
        return all(
            np.array_equal(getattr(self, name), getattr(other, name))
            for name in ("recording", "track", "tick")
        )

    def save(self, path: Path) -> None:
        """Writes aside, then renames."""
        path.parent.mkdir(parents=True, exist_ok=True)
        aside = path.with_name(f".{path.name}.part")
        with aside.open("wb") as file:
            np.savez_compressed(
                file,
                values=self.values,
                moving=self.moving,
                recording=self.recording,
                track=self.track,
                tick=self.tick,
                stamp=np.array(self.stamp),
            )
        os.replace(aside, path)

    @classmethod
    def load(cls, path: Path) -> "Errors":
        """What was saved."""
        with np.load(path, allow_pickle=False) as file:
            return cls(
                values=file["values"],
                moving=file["moving"],
                recording=file["recording"],
                track=file["track"],
                tick=file["tick"],
                stamp=str(file["stamp"]),
            )


def stamp_of(path: Path) -> str | None:
    """What kept errors were made of; None where there are none, or none that are whole."""
    try:
        # NumPy leaves a file open that it was asked to open and that is damaged.
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            return str(file["stamp"])
    except (OSError, KeyError, ValueError, BadZipFile):
        return None


def snippets_to_judge(
    recordings: Recordings,
    *,
    horizon_s: float,
    dt_s: float,
    part: Literal["test", "all"],
    per_recording: int | None,
) -> SnippetIndex:
    """The snippets that predictors are judged on, the same for all of them.

    Args:
        recordings: the test recordings, or those whose part `test` is to be judged on.
        horizon_s: how far is forecast.
        dt_s: the time step.
        part: `test` of the split by recording, or `all`.
        per_recording: how many of each recording at most, at random; None takes all.

    Raises:
        AspEnvError: there is none, or the recordings cannot be split.
    """
    index = index_snippets(recordings, dt_s=dt_s, horizon_s=horizon_s)
    if part == "test":
        parts, _ = snippet_parts(recordings, index, "recording")
        index = index.select(parts == "test")
    if per_recording is not None:
        rng = np.random.default_rng(0)
        kept = [np.zeros(0, dtype=np.int64)]
        for number in np.unique(index.recording):
            mine = np.flatnonzero(index.recording == number)
            count = min(per_recording, len(mine))
            kept.append(np.sort(rng.choice(mine, count, replace=False)))
        index = index.select(np.concatenate(kept))
    if not len(index):
        raise AspEnvError(
            f"no snippet of {recordings.source!r} is left to judge {horizon_s:g} s on: give more "
            "recordings, or longer ones"
        )
    return index


def judge_snippets(
    predictors: Mapping[str, Predictor],
    index: SnippetIndex,
    *,
    scenes: Sequence[Any],
    recorded: Sequence[Any],
    stamp: str,
) -> dict[str, Errors]:
    """Errors of every predictor on the same snippets, by the predictors' names here.

    Args:
        predictors: by any name.
        index: the snippets.
        scenes: the recordings that scenes are made of.
        recorded: the same recordings as they were recorded: what is true.
        stamp: to be kept with the errors.

    Raises:
        AspEnvError: a predictor leaves targets out, or forecasts less than the horizon.
    """
    count = len(index)
    values = {
        name: np.zeros((len(SELECTIONS), len(METRICS), count), dtype=np.float32)
        for name in predictors
    }
    goes = np.zeros(count, dtype=bool)
    for start in range(0, count, BATCH):
        rows = slice(start, min(start + BATCH, count))
        some = index.select(np.arange(rows.start, rows.stop))
        scene, future = gather_scene(scenes, some), gather_future(recorded, some)
        now, _ = gather_present(recorded, some)
        goes[rows] = moving(now, future.states[..., :2], future.valid)
        # Differences of positions far from the origin would lose millimetres in float32.
        origin = now[:, None, :2]
        truth = future.states[..., :2] - origin
        for name, predictor in predictors.items():
            forecast = ask(predictor, scene, future, index.horizon_ticks)
            local = forecast.states[:, :, : index.horizon_ticks, :2] - origin[:, None]
            for which, selection in enumerate(SELECTIONS):
                found = open_loop_errors(local, forecast.log_probs, truth, future.valid, selection)
                values[name][which, :, rows] = [found[metric].value for metric in METRICS]
    return {
        name: Errors(
            values=of,
            moving=goes,
            recording=index.recording.astype(np.int32),
            track=index.track.astype(np.int32),
            tick=index.tick.astype(np.int32),
            stamp=stamp,
        )
        for name, of in values.items()
    }

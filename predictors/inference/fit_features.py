"""Statistics of the features of a finished run, which the guard of its forecasts reads.

`asp-env train` fits them on the validation data of the run. `python -m
predictors.inference.fit_features NAME:RUN DATA…` adds them to a run that lacks them, or replaces
them.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from jaxtyping import Bool, Float

from asp_env import registry
from asp_env.console import text_console
from asp_env.data.histories import histories
from asp_env.data.recording import Recording
from asp_env.data.snippets import SnippetIndex, gather_scene, index_snippets
from asp_env.data.source import Recordings, join_data, open_readable
from asp_env.data.split import TrainedOn, num_ticks, part_of_ticks
from asp_env.errors import AspEnvError, CheckpointError
from predictors.inference.checkpoint import (
    PredictorSpec,
    folder_and_chaining,
    load_trained,
    read_config,
)
from predictors.inference.feature_distance import (
    FEATURES,
    MIN_TARGETS,
    FeatureDistance,
    fit_feature_distance,
)
from predictors.inference.trained import TrainedPredictor

MAX_TARGETS = 4000
"""Largest number of targets that statistics are fitted on, at even spacing. Chosen by hand: about
16 times the number of features of the small networks, and seconds of computation."""

CHUNK = 256
"""Targets whose scenes are in memory at once. Chosen by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitFeatures:
    """Fit the statistics of features that the fallback to constant velocity needs."""

    run_name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME:RUN")]
    """Finished run, such as ssp-asp:RUN."""
    data: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="DATA …")]
    """Validation data of the run, or other data of the traffic
    that it was trained for. Recordings that it was trained on
    are left out."""

    def run(self) -> None:
        """Fits and writes the file.

        Raises:
            AspEnvError: the run or the data are bad.
        """
        name, _, argument = self.run_name.partition(":")
        spec = registry.find("predictors", name)
        if not isinstance(spec, PredictorSpec) or not argument:
            raise AspEnvError(f"{self.run_name}: expected a finished run, such as ssp-asp:RUN")
        folder, _ = folder_and_chaining(name, argument)
        add_feature_distance(folder, self.data)
        text_console().print(f"wrote {folder / FEATURES}", soft_wrap=True)


def add_feature_distance(folder: Path, data: Sequence[str]) -> FeatureDistance:
    """Fits the statistics of a finished run on validation data and writes them into its folder.

    Of recordings that the run knows, only its validation part is used; recordings that it does not
    know are used as a whole.

    Args:
        folder: the folder of the run.
        data: one or several DATA, as `open_data` takes them.

    Raises:
        CheckpointError: the folder holds no finished run.
        AspEnvError: the data are bad, or have too few targets.
    """
    config = read_config(folder)
    spec: PredictorSpec = registry.find("predictors", config["predictor"])
    predictor = load_trained(spec, str(folder))
    if not data:
        raise AspEnvError("no DATA: expected the validation data of the run")
    recordings = join_data([open_readable(each, dt_s=predictor.dt_s) for each in data])
    index = index_snippets(
        recordings,
        dt_s=predictor.dt_s,
        horizon_s=predictor.horizon * predictor.dt_s,
        history_s=predictor.history * predictor.dt_s,
    )
    index = index.select(_not_trained_on(recordings, index, predictor.trained_on))
    history: Any = predictor.metadata.get("history", "recorded")
    found = feature_distance_of(predictor, histories(recordings, history), index)
    if found is None:
        raise CheckpointError(
            f"{', '.join(data)}: {len(index)} targets that {folder} was not trained on, expected "
            f"{MIN_TARGETS} or more: give more validation data"
        )
    found.save(folder)
    return found


def feature_distance_of(
    predictor: TrainedPredictor, scenes: Sequence[Recording], index: SnippetIndex
) -> FeatureDistance | None:
    """Statistics of the features of a predictor on some snippets.

    Args:
        predictor: the predictor.
        scenes: recordings as the predictor observes them.
        index: snippets, of which at most `MAX_TARGETS` are used.

    Returns:
        The statistics; None for fewer than `MIN_TARGETS` snippets.
    """
    count = min(len(index), MAX_TARGETS)
    chosen = index.select(np.linspace(0, len(index) - 1, count).astype(np.int64))
    return fit_feature_distance(_features(predictor, scenes, chosen), chosen.recording)


def _features(
    predictor: TrainedPredictor, scenes: Sequence[Recording], index: SnippetIndex
) -> Float[np.ndarray, "n z"]:
    parts = [np.zeros((0, predictor.network.config.features), dtype=np.float32)]
    for first in range(0, len(index), CHUNK):
        rows = np.arange(first, min(first + CHUNK, len(index)))
        features = predictor.predict(gather_scene(scenes, index.select(rows))).features
        assert features is not None
        parts.append(features[:, : predictor.network.config.features])
    return np.concatenate(parts)


def _not_trained_on(
    recordings: Recordings, index: SnippetIndex, trained_on: TrainedOn | None
) -> Bool[np.ndarray, " n"]:
    """Mask of the snippets of the validation part, and of recordings that the run does not know."""
    parts = {} if trained_on is None else trained_on.parts
    mask = np.zeros(len(index), dtype=bool)
    for number, content in enumerate(recordings.hashes()):
        rows = index.recording == number
        part = parts.get(content, "none")
        if part == "blocks":
            ticks = part_of_ticks(num_ticks(recordings[number], index.dt_s))
            mask[rows] = ticks[index.tick[rows]] == "validation"
        else:
            mask[rows] = part in ("validation", "none")
    return mask


if __name__ == "__main__":
    try:
        tyro.cli(FitFeatures).run()
    except AspEnvError as error:
        sys.stderr.write(f"fit_features: {error}\n")
        sys.exit(2)

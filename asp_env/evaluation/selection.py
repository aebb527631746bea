"""The predictors that a run compares: loaded, checked, and told apart by short names.

MERGED: What of DATA may be used to judge predictors that were trained on some of it.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import PurePath
from typing import Literal

import numpy as np
from jaxtyping import Bool

from asp_env.data.predictor import Predictor, load_predictor
from asp_env.data.snippets import SnippetIndex, index_snippets
from asp_env.data.source import Recordings
from asp_env.data.split import (
    SPLIT_HORIZON_S,
    num_ticks,
    snippet_parts,
    ticks_of_part,
    unseen_ticks,
)
from asp_env.errors import AspEnvError


def load_predictors(names: Sequence[str], *, horizon: int, dt_s: float) -> list[Predictor]:
    """The predictors of some names, each of which forecasts at least `horizon` ticks.

    Raises:
        AspEnvError: there is none, one is named twice, or one forecasts less.
    """
    if not names:
        raise AspEnvError("--predictors: none given; expected at least one, such as oracle")
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise AspEnvError(f"--predictors: {name} is named {count} times; name it once")
    predictors = [load_predictor(name, horizon=horizon, dt_s=dt_s) for name in names]
    for name, predictor in zip(names, predictors, strict=True):
        if predictor.horizon < horizon:
            raise AspEnvError(
                f"{name} forecasts {predictor.horizon * dt_s:g} s, less than --horizon "
                f"{horizon * dt_s:g}"
            )
    return predictors


def short_names(names: Sequence[str]) -> dict[str, str]:
    """By full name: without its folder, or with what of the folder tells it from the others."""
    found = {name: name.partition(":")[0] for name in names}
    found = _lengthen(found, lambda name: PurePath(name.partition(":")[2]).name)
    return _lengthen(found, lambda name: name.partition(":")[2].strip("/").replace("/", "-"))


def _lengthen(short: dict[str, str], add: Callable[[str], str]) -> dict[str, str]:
    taken = Counter(short.values())
    return {
        name: f"{name.partition(':')[0]} {add(name)}".strip() if taken[label] > 1 else label
        for name, label in short.items()
    }


PartChoice = Literal["auto", "train", "validation", "test", "all"]


def ticks_to_judge(
    recordings: Recordings, predictors: Sequence[Predictor], part: PartChoice, *, dt_s: float
) -> tuple[list[Bool[np.ndarray, " _"]], str]:
    """The ticks of each recording that may be judged on, and in words which they are.

    `auto`: what no predictor has learned from or was selected on. `train`, `validation` and `test`:
    that part of what the predictors were trained on; where none was trained on these recordings,
    that part of them under the split by recording for 3 s. `all`: everything, seen or not.

    Raises:
        AspEnvError: these recordings cannot be split.
    """
    contents = set(recordings.hashes())
    trained = [
        known
        for predictor in predictors
        if (known := predictor.trained_on) is not None and contents & set(known.parts)
    ]
    if part == "auto":
        label = "what no predictor has seen" if trained else "all, of which no predictor saw any"
        return unseen_ticks(recordings, trained, dt_s), label
    if part == "all":
        lengths = [num_ticks(recording, dt_s) for recording in recordings]
        return [np.ones(length, dtype=bool) for length in lengths], "all, seen or not"
    if trained:
        label = f"{part} of what the predictors were trained on"
        return ticks_of_part(recordings, trained, part, dt_s), label
    index = index_snippets(recordings, dt_s=dt_s, horizon_s=SPLIT_HORIZON_S)
    try:
        _, dealt = snippet_parts(recordings, index, "recording")
    except AspEnvError as error:
        raise AspEnvError(
            f"--part {part}: no location has three recordings with snippets, so there is no split "
            "by recording; say --part all"
        ) from error
    return ticks_of_part(recordings, [dealt], part, dt_s), f"{part} of the split by recording"


def keep_within(index: SnippetIndex, allowed: Sequence[Bool[np.ndarray, " _"]]) -> SnippetIndex:
    """The snippets whose every tick is allowed.

    Raises:
        AspEnvError: there is none.
    """
    keep = np.zeros(len(index), dtype=bool)
    for number, ticks in enumerate(allowed):
        total = np.concatenate([[0], np.cumsum(ticks)])
        mine = np.flatnonzero(index.recording == number)
        first = index.tick[mine] - index.history
        after = np.minimum(index.tick[mine] + index.horizon_ticks + 1, len(ticks))
        keep[mine] = total[after] - total[first] == index.history + index.horizon_ticks + 1
    if not keep.any():
        raise no_data_error("snippet")
    return index.select(keep)


def no_data_error(what: str) -> AspEnvError:
    """The error for data without anything to judge on."""
    return AspEnvError(
        f"no {what} is left to judge on: these recordings are too short, or the predictors were "
        "trained on them; give other data, or say --part all"
    )

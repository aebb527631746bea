"""What of DATA may be used to judge predictors that were trained on some of it."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool

from asp_env.data.parts import (
    SPLIT_HORIZON_S,
    num_ticks,
    snippet_parts,
    ticks_of_part,
    unseen_ticks,
)
from asp_env.data.predictor import Predictor
from asp_env.data.snippets import SnippetIndex, index_snippets
from asp_env.data.source import Recordings
from asp_env.errors import AspEnvError

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
        after = np.minimum(index.tick[mine] + index.horizon + 1, len(ticks))
        keep[mine] = total[after] - total[first] == index.history + index.horizon + 1
    if not keep.any():
        raise nothing_left("snippet")
    return index.select(keep)


def nothing_left(what: str) -> AspEnvError:
    """The error for data without anything to judge on."""
    return AspEnvError(
        f"no {what} is left to judge on: these recordings are too short, or the predictors were "
        "trained on them; give other data, or say --part all"
    )

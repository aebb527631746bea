"""What of DATA may be used to judge predictors that were trained on some of it."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool

from asp_env.data.parts import num_ticks, snippet_parts, unseen_ticks
from asp_env.data.predictor import Predictor
from asp_env.data.snippets import SnippetIndex, index_snippets
from asp_env.data.source import Recordings
from asp_env.errors import AspEnvError

PartChoice = Literal["auto", "train", "validation", "test", "all"]


def ticks_to_judge(
    recordings: Recordings,
    predictors: Sequence[Predictor],
    part: PartChoice,
    *,
    dt_s: float,
    horizon_s: float,
) -> tuple[list[Bool[np.ndarray, " _"]], str]:
    """The ticks of each recording that may be judged on, and in words which they are.

    `auto`: what no predictor has learned from or was selected on. `train`, `validation` and `test`:
    that part of DATA under the split by recording. `all`: everything, seen or not.
    """
    if part == "auto":
        trained = [known for predictor in predictors if (known := predictor.trained_on) is not None]
        overlap = {name for known in trained for name in known.parts} & set(recordings.hashes())
        label = "what no predictor has seen" if overlap else "all, of which no predictor saw any"
        return unseen_ticks(recordings, trained, dt_s), label
    lengths = [num_ticks(recording, dt_s) for recording in recordings]
    if part == "all":
        return [np.ones(length, dtype=bool) for length in lengths], "all, seen or not"
    index = index_snippets(recordings, dt_s=dt_s, horizon_s=horizon_s)
    _, known = snippet_parts(recordings, index, "recording")
    mine = [known.parts[content] == part for content in recordings.hashes()]
    chosen = [np.full(length, keep) for length, keep in zip(lengths, mine, strict=True)]
    return chosen, f"{part} of the split by recording"


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

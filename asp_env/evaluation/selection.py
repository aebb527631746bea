"""Which predictors are evaluated, and which part of DATA they are evaluated on."""

import glob
import hashlib
import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path, PurePath
from typing import Literal

import numpy as np
from jaxtyping import Bool

from asp_env import registry
from asp_env.data.predictor import GuardablePlug, Predictor, load_predictor
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

GUARDED = "guarded"
"""Name of the predictor that guards another one by a fallback to constant velocity."""

_WRAPPERS = re.compile(r"(delayed:\d+:|most-probable:)*")
"""Names of predictors that change the forecast of another one, before its name."""

LONGEST_LABEL_BYTES = 120
"""File systems take names of 255 bytes; with a planner, labels are of two of these."""

PartChoice = Literal["auto", "train", "validation", "test", "all"]


def expand_runs(names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The training runs that each name stands for.

    A name such as `ffw-asp:runs/*` is one method of several runs: all folders that match the
    pattern behind the last colon before it, sorted by path. `*`, `?` and `[…]` match within one
    level of folders. A pattern that is itself a path is no pattern, and an option behind `@`, as in
    `ssp-asp:runs/*@beam`, applies to every run.

    Args:
        names: registered names, with `:RUN` for a trained predictor.

    Returns:
        The names of the runs by name as given, in the order of `names`; a name without a pattern
        stands for itself.

    Raises:
        AspEnvError: a name is given twice, no folder matches, or a pattern contains `**`.
    """
    for name, count in Counter(names).items():
        if count > 1:
            raise _named_repeatedly(name, count)
    return {name: _matching_runs(name) for name in names}


def _matching_runs(name: str) -> tuple[str, ...]:
    wildcard = min((name.find(c) for c in "*?[" if c in name), default=-1)
    if wildcard < 0:
        return (name,)
    start = name.rfind(":", 0, wildcard) + 1
    pattern, at, option = name[start:].partition("@")
    if not start or Path(pattern).exists():
        return (name,)
    if "**" in pattern:
        raise AspEnvError(f"{name}: ** is not supported; use one * for each level of folders")
    folders = sorted(path for path in glob.glob(pattern) if Path(path).is_dir())
    if not folders:
        raise AspEnvError(
            f"{name}: no folder matches {pattern}; give the folders of finished runs, with the "
            "pattern in quotes"
        )
    return tuple(f"{name[:start]}{folder}{at}{option}" for folder in folders)


def _named_repeatedly(name: str, count: int) -> AspEnvError:
    return AspEnvError(f"--predictors: {name} is named {count} times; name it once")


def with_fallback(names: Sequence[str]) -> tuple[str, ...]:
    """The names with a guard for every trained predictor: `ffw-asp:RUN` is `guarded:ffw-asp:RUN`.

    The guard is of the predictor itself, so `delayed:2:ffw-asp:RUN` becomes
    `delayed:2:guarded:ffw-asp:RUN`. Predictors without a guard keep their names.

    Raises:
        AspEnvError: a name is unknown.
    """
    return tuple(_with_fallback(name) for name in names)


def _with_fallback(name: str) -> str:
    start = len(_WRAPPERS.match(name)[0])  # pyright: ignore[reportOptionalSubscript]
    plug = registry.find("predictors", name[start:].partition(":")[0])
    return f"{name[:start]}{GUARDED}:{name[start:]}" if isinstance(plug, GuardablePlug) else name


def load_predictors(names: Sequence[str], *, horizon: int, dt_s: float) -> list[Predictor]:
    """Loads predictors by name.

    Args:
        names: registered names, with `:RUN` for a trained predictor.
        horizon: number of ticks that each must forecast.
        dt_s: duration of a tick in seconds.

    Raises:
        AspEnvError: no name is given, a name is given twice, or a predictor cannot be loaded or
            forecasts fewer ticks.
    """
    if not names:
        raise AspEnvError("--predictors: none given; expected at least one, such as oracle")
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise _named_repeatedly(name, count)
    predictors = [load_predictor(name, horizon=horizon, dt_s=dt_s) for name in names]
    for name, predictor in zip(names, predictors, strict=True):
        if predictor.horizon < horizon:
            raise AspEnvError(
                f"{name} forecasts {predictor.horizon * dt_s:g} s, less than --horizon "
                f"{horizon * dt_s:g}"
            )
    return predictors


def shared_metadata(predictors: Sequence[Predictor], key: str) -> str:
    """An entry of the metadata of the runs of a method; different entries are joined by ` | `.

    Args:
        predictors: the predictor of each run.
        key: key of `Predictor.metadata`.
    """
    return " | ".join(dict.fromkeys(each.metadata.get(key, "") for each in predictors))


def short_names(names: Sequence[str]) -> dict[str, str]:
    """The shortest distinct labels of predictors, by their full names.

    A label is the name without its run folder (`mtp`), as `split_name` cuts it off. Where that is
    ambiguous, the last part of the folder is added (`mtp 1`), and where that is ambiguous too, the
    whole path (`mtp a-1`). Very long ones are shortened, see `file_label`.
    """
    labels = {name: split_name(name)[0] for name in names}
    labels = _lengthen(labels, lambda run: PurePath(run).name)
    labels = _lengthen(labels, lambda run: run.strip("/").replace("/", "-"))
    return {name: file_label(label) for name, label in labels.items()}


def file_label(label: str) -> str:
    """The label, or the begin of a long one with a hash of it: the name of a folder of rollouts."""
    content = label.encode()
    if len(content) <= LONGEST_LABEL_BYTES:
        return label
    digest = hashlib.sha256(content).hexdigest()[:8]
    begin = content[: LONGEST_LABEL_BYTES - len(digest) - 4].decode(errors="ignore")
    return f"{begin}… {digest}"


def split_name(name: str) -> tuple[str, str]:
    """The label of a predictor and its run folder, which is empty for a predictor without one.

    Numbers in the name belong to the label: `noisy-oracle:2` is `noisy-oracle 2`, and
    `delayed:2:mtp:runs/1` is `delayed 2 mtp` with the folder `runs/1`. So does the predictor in
    `most-probable:mtp:runs/1` and in `guarded:mtp:runs/1`.
    """
    kind, _, argument = name.partition(":")
    if kind in ("most-probable", GUARDED) and argument:
        label, run = split_name(argument)
        return f"{kind} {label}", run
    number, _, inner = argument.partition(":")
    if not re.fullmatch(r"[0-9.]+", number):
        return kind, argument
    label, run = split_name(inner)
    return f"{kind} {number} {label}".strip(), run


def _lengthen(labels: dict[str, str], suffix: Callable[[str], str]) -> dict[str, str]:
    counts = Counter(labels.values())
    lengthened = {}
    for name, label in labels.items():
        short, run = split_name(name)
        lengthened[name] = f"{short} {suffix(run)}".strip() if counts[label] > 1 else label
    return lengthened


def ticks_to_evaluate(
    recordings: Recordings, predictors: Sequence[Predictor], part: PartChoice, *, dt_s: float
) -> tuple[list[Bool[np.ndarray, " _"]], str]:
    """Masks of the ticks that predictors are evaluated on.

    Args:
        recordings: DATA.
        predictors: all predictors that are compared.
        part: `auto` excludes everything that any of the predictors was trained or selected on.
            `train`, `validation` and `test` are that part of the predictors' training split; if
            none of the predictors was trained on these recordings, that part of the split by
            recording for a horizon of 3 s. `all` excludes nothing.
        dt_s: duration of a tick in seconds.

    Returns:
        A mask of ticks for each recording, and a description of the choice.

    Raises:
        AspEnvError: these recordings cannot be split.
    """
    contents = set(recordings.hashes())
    trained = [
        trained_on
        for predictor in predictors
        if (trained_on := predictor.trained_on) is not None and contents & set(trained_on.parts)
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
        _, split = snippet_parts(recordings, index, "recording")
    except AspEnvError as error:
        raise AspEnvError(
            f"--part {part}: no location has three recordings with snippets, so there is no split "
            "by recording; use --part all"
        ) from error
    return ticks_of_part(recordings, [split], part, dt_s), f"{part} of the split by recording"


def snippets_within(index: SnippetIndex, allowed: Sequence[Bool[np.ndarray, " _"]]) -> SnippetIndex:
    """The snippets whose history, present and horizon lie within the allowed ticks.

    Args:
        index: snippets.
        allowed: a mask of ticks for each recording.

    Raises:
        AspEnvError: no snippet is left.
    """
    keep = np.zeros(len(index), dtype=bool)
    for number, ticks in enumerate(allowed):
        total = np.concatenate([[0], np.cumsum(ticks)])
        rows = np.flatnonzero(index.recording == number)
        first = index.tick[rows] - index.history
        after = np.minimum(index.tick[rows] + index.horizon_ticks + 1, len(ticks))
        keep[rows] = total[after] - total[first] == index.history + index.horizon_ticks + 1
    if not keep.any():
        raise no_data_error("snippet")
    return index.select(keep)


def no_data_error(what: str) -> AspEnvError:
    """The error for data that contain nothing to evaluate on.

    Args:
        what: what is missing, in the singular, such as `snippet` or `scenario`.
    """
    return AspEnvError(
        f"no {what} is left to evaluate on: these recordings are too short, or the predictors were "
        "trained on them; give other data, or use --part all"
    )

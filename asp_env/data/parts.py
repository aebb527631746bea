"""Which snippets and scenarios of DATA are learned from, selected on, and judged on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Shaped

from asp_env.data.clock import frames_per_tick
from asp_env.data.recording import Recording
from asp_env.data.snippets import SnippetIndex, index_snippets
from asp_env.data.source import Recordings
from asp_env.data.split import Part, split_blocks, split_by_recording

Split = Literal["recording", "blocks"]

SPLIT_HORIZON_S = 3.0
"""Recordings are dealt by their number of snippets with this horizon, whatever is learned."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainedOn:
    """Which recordings a trained predictor has seen, so that it is judged on others."""

    source: str
    """DATA as its user named it."""
    split: Split
    parts: Mapping[str, str]
    """By the content hash of each recording: its part, or `blocks` where its blocks were dealt."""

    def after(self, earlier: "TrainedOn") -> "TrainedOn":
        """What a predictor has seen that goes on from one which had learned from `earlier`.

        Blocks stay blocks where both had them; a recording that either learned from otherwise, or
        was selected on, is not free any more.
        """
        parts = dict(self.parts)
        for content, part in earlier.parts.items():
            mine = parts.get(content, "none")
            if part not in ("train", "validation", "blocks") or part == mine:
                continue
            free = mine in ("test", "none")
            parts[content] = part if free else "train"
        return TrainedOn(source=self.source, split=self.split, parts=parts)


def snippet_parts(
    recordings: Recordings, index: SnippetIndex, split: Split
) -> tuple[Shaped[np.ndarray, " n"], TrainedOn]:
    """The part of each snippet, and what a predictor trained on them is to remember.

    Recordings are dealt by their number of snippets of 3 s, whatever these snippets' horizon, so
    that a run for 6 s that goes on from one for 3 s learns from the same recordings.

    Raises:
        AspEnvError: nothing would be left to test on.
    """
    if split == "recording":
        dealt = index_snippets(recordings, dt_s=index.dt_s, horizon_s=SPLIT_HORIZON_S)
        counts = np.bincount(dealt.recording, minlength=len(recordings))
        locations = [recording.location for recording in recordings]
        of_recording = np.array(split_by_recording(counts, locations))
        remembered, parts = of_recording, of_recording[index.recording]
    else:
        remembered = np.full(len(recordings), "blocks")
        parts = split_blocks(
            index.recording,
            index.tick - index.history,
            index.tick + index.horizon,
            lengths=np.array([num_ticks(recording, index.dt_s) for recording in recordings]),
        )
    by_hash = dict(zip(recordings.hashes(), remembered.tolist(), strict=True))
    return parts, TrainedOn(source=recordings.source, split=split, parts=by_hash)


def num_ticks(recording: Recording, dt_s: float) -> int:
    """How many ticks a recording lasts."""
    return -(-recording.num_frames // frames_per_tick(recording.frame_rate_hz, dt_s))


def unseen_ticks(
    recordings: Recordings, trained_on: Sequence[TrainedOn], dt_s: float
) -> list[Bool[np.ndarray, " _"]]:
    """Of each recording, the ticks that none of some predictors learned from or was selected on."""
    unseen = []
    for recording, content in zip(recordings, recordings.hashes(), strict=True):
        length = num_ticks(recording, dt_s)
        free = np.ones(length, dtype=bool)
        for known in trained_on:
            part = known.parts.get(content, "none")
            if part == "blocks":
                free &= part_of_ticks(length) == "test"
            elif part in ("train", "validation"):
                free[:] = False
        unseen.append(free)
    return unseen


def ticks_of_part(
    recordings: Recordings, trained_on: Sequence[TrainedOn], part: Part, dt_s: float
) -> list[Bool[np.ndarray, " _"]]:
    """Of each recording, the ticks that were this part of what every one of some predictors had."""
    found = []
    for recording, content in zip(recordings, recordings.hashes(), strict=True):
        length = num_ticks(recording, dt_s)
        mine = np.ones(length, dtype=bool)
        for known in trained_on:
            dealt = known.parts.get(content, "none")
            mine &= part_of_ticks(length) == part if dealt == "blocks" else dealt == part
        found.append(mine)
    return found


def part_of_ticks(length: int) -> Shaped[np.ndarray, " ticks"]:
    """The part of every single tick of a recording whose blocks are dealt."""
    at = np.arange(length)
    return split_blocks(np.zeros_like(at), at, at, lengths=np.array([length]))

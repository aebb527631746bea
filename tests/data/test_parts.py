"""Snippets and ticks by part: no tick is used for both training and evaluation."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from asp_env.data.recording import Recording
from asp_env.data.snippets import SnippetIndex
from asp_env.data.source import Recordings
from asp_env.data.split import TrainedOn, num_ticks, part_of_ticks, snippet_parts, unseen_ticks
from asp_env.errors import AspEnvError
from tests.builders import make_recording

RECORDING = make_recording(duration_s=8.0)
"""It has snippets with a horizon of 3 s."""


class MadeUp(Recordings):
    """Recordings at one place that differ only in length, with the hashes h0, h1, and so on."""

    def __init__(self, frames: list[int]) -> None:
        super().__init__("made up", ())
        self.made = [dataclasses.replace(RECORDING, num_frames=count) for count in frames]

    def __len__(self) -> int:
        return len(self.made)

    def __getitem__(self, index: Any) -> Any:
        return self.made[index]

    def __iter__(self) -> Iterator[Recording]:
        return iter(self.made)

    def hashes(self) -> tuple[str, ...]:
        return tuple(f"h{number}" for number in range(len(self)))


def all_snippets(recordings: MadeUp, *, horizon_ticks: int = 15) -> SnippetIndex:
    """Snippets with a history of 15 ticks at every third tick."""
    found = [np.arange(15, num_ticks(each, 0.2) - horizon_ticks, 3) for each in recordings]
    return SnippetIndex(
        recording=np.repeat(np.arange(len(found)), [len(ticks) for ticks in found]),
        track=np.zeros(sum(map(len, found)), dtype=np.int64),
        tick=np.concatenate(found),
        dt_s=0.2,
        history=15,
        horizon_ticks=horizon_ticks,
    )


def used(index: SnippetIndex, rows: np.ndarray, number: int, length: int) -> np.ndarray:
    """Mask of the ticks of a recording within the given snippets."""
    mask = np.zeros(length, dtype=bool)
    for tick in index.tick[rows & (index.recording == number)]:
        mask[tick - index.history : tick + index.horizon_ticks + 1] = True
    return mask


@pytest.mark.parametrize(("frames", "ticks"), [(501, 101), (500, 100), (496, 100), (1, 1), (0, 0)])
def test_num_ticks(frames: int, ticks: int) -> None:
    """Frames 0 to 500 of 25 Hz hold the ticks 0 to 100: every fifth frame is one."""
    assert num_ticks(dataclasses.replace(RECORDING, num_frames=frames), 0.2) == ticks


@given(
    frames=st.lists(st.integers(700, 12_000), min_size=1, max_size=3),
    horizon_ticks=st.sampled_from([15, 30]),
    evaluated_dt_s=st.sampled_from([0.2, 0.2, 0.08, 0.4]),
)
def test_split_by_blocks(frames: list[int], horizon_ticks: int, evaluated_dt_s: float) -> None:
    """Unseen ticks are in no training or validation snippet, also at another time step.

    At the same time step they include all test snippets.
    """
    recordings = MadeUp(frames)
    index = all_snippets(recordings, horizon_ticks=horizon_ticks)
    parts, trained_on = snippet_parts(recordings, index, "blocks")
    assert trained_on.parts == dict.fromkeys(recordings.hashes(), "blocks")
    assert (trained_on.source, trained_on.split) == ("made up", "blocks")
    seen = np.isin(parts, ["train", "validation"])
    for number, unseen in enumerate(unseen_ticks(recordings, [trained_on], evaluated_dt_s)):
        length = num_ticks(recordings.made[number], 0.2)
        assert unseen.any()
        seen_frames = np.flatnonzero(used(index, seen, number, length)) * 5
        unseen_frames = np.flatnonzero(unseen) * round(evaluated_dt_s * 25)
        assert not np.isin(unseen_frames, seen_frames).any()
        if evaluated_dt_s == 0.2:
            assert unseen[used(index, parts == "test", number, length)].all()


def test_split_by_recording() -> None:
    """Of ten equal recordings, only the test recording is unseen."""
    recordings = MadeUp([3_000] * 10)
    index = all_snippets(recordings)
    parts, trained_on = snippet_parts(recordings, index, "recording")
    assert sorted(trained_on.parts.values()) == ["test", *["train"] * 8, "validation"]
    for number, content in enumerate(recordings.hashes()):
        assert set(parts[index.recording == number]) == {trained_on.parts[content]}
    for content, unseen in zip(
        recordings.hashes(), unseen_ticks(recordings, [trained_on], 0.2), strict=True
    ):
        assert len(unseen) == 600
        assert unseen.all() if trained_on.parts[content] == "test" else not unseen.any()


def test_split_by_time_of_day() -> None:
    """Of ten hours of the clock one is unseen; without a start time there is an error."""
    recordings = MadeUp([3_000] * 20)
    with pytest.raises(AspEnvError, match=r"no start time.*use --split recording"):
        snippet_parts(recordings, all_snippets(recordings), "daytime")
    recordings.made = [
        dataclasses.replace(recording, start_hour=8.0 + number // 2)
        for number, recording in enumerate(recordings.made)
    ]
    index = all_snippets(recordings)
    parts, trained_on = snippet_parts(recordings, index, "daytime")
    assert trained_on.split == "daytime"
    held_out = np.unique(index.recording[parts == "test"])
    assert held_out[0] % 2 == 0
    assert held_out.tolist() == [held_out[0], held_out[0] + 1]
    unseen = unseen_ticks(recordings, [trained_on], 0.2)
    assert [bool(mask.all()) for mask in unseen] == [number in held_out for number in range(20)]


def test_too_few_recordings() -> None:
    """The error suggests the other split."""
    recordings = MadeUp([3_000] * 2)
    with pytest.raises(AspEnvError, match="use --split blocks"):
        snippet_parts(recordings, all_snippets(recordings), "recording")


def trained(**parts: str) -> TrainedOn:
    """The data of a predictor, by hash."""
    return TrainedOn(source="elsewhere", split="recording", parts=parts)


@pytest.mark.parametrize(
    ("part", "unseen"),
    [("train", False), ("validation", False), ("test", True), ("none", True)],
)
def test_recordings_are_identified_by_content(part: str, unseen: bool) -> None:
    """Those of the test part, left out or unknown are unseen."""
    recordings = MadeUp([500, 500])
    first, second = unseen_ticks(recordings, [trained(h0=part, h7="train")], 0.2)
    assert first.all() == first.any() == unseen
    assert second.all()


def test_ticks_that_are_unseen_by_several_predictors() -> None:
    recordings = MadeUp([500, 500, 1_500])
    blocks = trained(h2="blocks")
    unseen = unseen_ticks(recordings, [trained(h0="train"), trained(h1="test"), blocks], 0.2)
    assert [each.any() for each in unseen] == [False, True, True]
    np.testing.assert_array_equal(unseen[2], part_of_ticks(300) == "test")
    assert all(each.all() for each in unseen_ticks(recordings, [], 0.2))


def test_test_block_of_ticks() -> None:
    """One block of 30 consecutive ticks of 300."""
    (ticks,) = np.nonzero(part_of_ticks(300) == "test")
    assert len(ticks) == 30
    assert ticks[0] % 30 == 0
    assert ticks[-1] - ticks[0] == 29


@pytest.mark.parametrize(
    ("own", "earlier", "known"),
    [
        ("train", "train", "train"),
        ("test", "train", "train"),
        ("none", "validation", "validation"),
        ("test", "blocks", "blocks"),
        ("blocks", "blocks", "blocks"),
        ("blocks", "train", "train"),
        ("train", "blocks", "train"),
        ("test", "test", "test"),
        ("train", "test", "train"),
    ],
)
def test_continued_training_includes_the_earlier_data(own: str, earlier: str, known: str) -> None:
    both = trained(h0=own, h1="test").continued_from(trained(h0=earlier, h2="train", h3="test"))
    assert both.parts == {"h0": known, "h1": "test", "h2": "train"}

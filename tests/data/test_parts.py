"""No tick is both learned from and judged on."""

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
"""With snippets of 3 s, by which recordings are dealt."""


class MadeUp(Recordings):
    """Recordings at one place of which nothing but the length matters."""

    def __init__(self, frames: list[int]) -> None:
        """Their hashes are h0, h1, …."""
        super().__init__("made up", ())
        self.made = [dataclasses.replace(RECORDING, num_frames=count) for count in frames]

    def __len__(self) -> int:
        """How many there are."""
        return len(self.made)

    def __getitem__(self, index: Any) -> Any:
        """One of them."""
        return self.made[index]

    def __iter__(self) -> Iterator[Recording]:
        """One after the other."""
        return iter(self.made)

    def hashes(self) -> tuple[str, ...]:
        """A name for each."""
        return tuple(f"h{number}" for number in range(len(self)))


def every_snippet(recordings: MadeUp, *, horizon: int = 15) -> SnippetIndex:
    """Snippets of 15 ticks of history around every third tick that has room for them."""
    found = [np.arange(15, num_ticks(each, 0.2) - horizon, 3) for each in recordings]
    return SnippetIndex(
        recording=np.repeat(np.arange(len(found)), [len(ticks) for ticks in found]),
        track=np.zeros(sum(map(len, found)), dtype=np.int64),
        tick=np.concatenate(found),
        dt_s=0.2,
        history=15,
        horizon=horizon,
    )


def used(index: SnippetIndex, rows: np.ndarray, number: int, length: int) -> np.ndarray:
    """Which ticks of a recording some snippets read."""
    read = np.zeros(length, dtype=bool)
    for tick in index.tick[rows & (index.recording == number)]:
        read[tick - index.history : tick + index.horizon + 1] = True
    return read


@pytest.mark.parametrize(("frames", "ticks"), [(501, 101), (500, 100), (496, 100), (1, 1), (0, 0)])
def test_num_ticks(frames: int, ticks: int) -> None:
    """Frames 0 to 500 of 25 Hz hold the ticks 0 to 100: every fifth frame is one."""
    assert num_ticks(dataclasses.replace(RECORDING, num_frames=frames), 0.2) == ticks


@given(
    frames=st.lists(st.integers(700, 12_000), min_size=1, max_size=3),
    horizon=st.sampled_from([15, 30]),
    judged_dt_s=st.sampled_from([0.2, 0.2, 0.08, 0.4]),
)
def test_blocks(frames: list[int], horizon: int, judged_dt_s: float) -> None:
    """Unseen ticks are in no snippet that was trained or validated on, at any other step either.

    And at the same step every snippet of the test part lies within them.
    """
    recordings = MadeUp(frames)
    index = every_snippet(recordings, horizon=horizon)
    parts, known = snippet_parts(recordings, index, "blocks")
    assert known.parts == dict.fromkeys(recordings.hashes(), "blocks")
    assert (known.source, known.split) == ("made up", "blocks")
    learned = np.isin(parts, ["train", "validation"])
    unseen = unseen_ticks(recordings, [known], judged_dt_s)
    for number, free in enumerate(unseen):
        length = num_ticks(recordings.made[number], 0.2)
        assert free.any()
        seen_at = np.flatnonzero(used(index, learned, number, length)) * 5
        judged_at = np.flatnonzero(free) * round(judged_dt_s * 25)
        assert not np.isin(judged_at, seen_at).any()
        if judged_dt_s == 0.2:
            assert free[used(index, parts == "test", number, length)].all()


def test_whole_recordings() -> None:
    """Of ten equal recordings one is tested on, which is unseen, and one selected on."""
    recordings = MadeUp([3_000] * 10)
    index = every_snippet(recordings)
    parts, known = snippet_parts(recordings, index, "recording")
    assert sorted(known.parts.values()) == ["test", *["train"] * 8, "validation"]
    for number, content in enumerate(recordings.hashes()):
        assert set(parts[index.recording == number]) == {known.parts[content]}
    for content, free in zip(
        recordings.hashes(), unseen_ticks(recordings, [known], 0.2), strict=True
    ):
        assert len(free) == 600
        assert free.all() if known.parts[content] == "test" else not free.any()


def test_too_few_recordings() -> None:
    """Two recordings cannot be split whole: the error names the other way."""
    recordings = MadeUp([3_000] * 2)
    with pytest.raises(AspEnvError, match="use --split blocks"):
        snippet_parts(recordings, every_snippet(recordings), "recording")


def trained(**parts: str) -> TrainedOn:
    """What a predictor remembers of recordings by their hash."""
    return TrainedOn(source="elsewhere", split="recording", parts=parts)


@pytest.mark.parametrize(
    ("part", "free"),
    [("train", False), ("validation", False), ("test", True), ("none", True)],
)
def test_known_by_content(part: str, free: bool) -> None:
    """Learned from or selected on: not free. Tested on, left out, or never met: free."""
    recordings = MadeUp([500, 500])
    first, second = unseen_ticks(recordings, [trained(h0=part, h7="train")], 0.2)
    assert first.all() == first.any() == free
    assert second.all()


def test_several_predictors() -> None:
    """What any of them saw is not free for any; of one that learned nothing all is."""
    recordings = MadeUp([500, 500, 1_500])
    blocks = trained(h2="blocks")
    free = unseen_ticks(recordings, [trained(h0="train"), trained(h1="test"), blocks], 0.2)
    assert [each.any() for each in free] == [False, True, True]
    np.testing.assert_array_equal(free[2], part_of_ticks(300) == "test")
    assert all(each.all() for each in unseen_ticks(recordings, [], 0.2))


def test_blocks_of_ticks() -> None:
    """Of 300 ticks one block of 30 in a row is tested on."""
    (at,) = np.nonzero(part_of_ticks(300) == "test")
    assert len(at) == 30
    assert at[0] % 30 == 0
    assert at[-1] - at[0] == 29


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
def test_what_a_start_saw_is_seen(own: str, earlier: str, known: str) -> None:
    """A recording is as free as the less free of two runs left it; others' are kept besides."""
    both = trained(h0=own, h1="test").after(trained(h0=earlier, h2="train", h3="test"))
    assert both.parts == {"h0": known, "h1": "test", "h2": "train"}

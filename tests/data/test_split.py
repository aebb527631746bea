"""Splits: shares, separation in time, reproducibility."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from asp_env.data.split import split_blocks, split_by_daytime, split_by_recording
from asp_env.errors import AspEnvError


def snippets(lengths: list[int], span: int, every: int) -> tuple[np.ndarray, ...]:
    """(recording, first, last) of snippets of `span` ticks that start every `every` ticks."""
    rows = [
        (number, first, first + span - 1)
        for number, length in enumerate(lengths)
        for first in range(0, length - span + 1, every)
    ]
    table = np.array(rows, dtype=np.int64).reshape(-1, 3)
    return table[:, 0], table[:, 1], table[:, 2]


def test_ten_equal_recordings_are_split_8_1_1() -> None:
    parts = split_by_recording(np.full(10, 7), ["1"] * 10)
    assert sorted(parts) == ["test"] + ["train"] * 8 + ["validation"]


def test_shares_are_of_snippets() -> None:
    """If the counts allow it, test and validation get exactly a tenth of the snippets each."""
    counts = np.array([400, 300, 100, 50, 50, 60, 40])
    parts = np.array(split_by_recording(counts, ["1"] * 7))
    assert counts[parts == "test"].sum() == 100
    assert counts[parts == "validation"].sum() == 100


def test_small_locations_are_split_together() -> None:
    """Two locations with three recordings: 4:1:1, not twice 1:1:1; one with two is not split.

    Test and validation are at different locations, so that both are trained on.
    """
    locations = ["4", "4", "4", "1", "1", "1", "2", "2"]
    parts = split_by_recording(np.full(8, 5), locations)
    assert parts[6:] == ("train", "train")
    for place in (slice(0, 3), slice(3, 6)):
        assert parts[place].count("train") == 2
    assert sorted(parts[:6]) == ["test"] + ["train"] * 4 + ["validation"]


def test_a_location_with_three_recordings_alone() -> None:
    """Nothing but 1:1:1 is possible."""
    assert sorted(split_by_recording(np.full(3, 5), ["1"] * 3)) == ["test", "train", "validation"]


def test_locations_as_those_of_ind() -> None:
    """7, 11, 12 and 3 equal recordings: 3 of 33 for testing, and as many for validation.

    Those with 11 and 12 are split on their own, the other ten together.
    """
    locations = ["4"] * 7 + ["1"] * 11 + ["2"] * 12 + ["3"] * 3
    parts = np.array(split_by_recording(np.full(33, 9), locations))
    for held_out in ("test", "validation"):
        at = [locations[i] for i in np.flatnonzero(parts == held_out)]
        assert len(at) == 3
        assert {"1", "2"} < set(at)


@given(
    counts=st.lists(st.integers(1, 900), min_size=8, max_size=40),
    places=st.integers(2, 9),
)
def test_pooled_locations_keep_training_recordings(counts: list[int], places: int) -> None:
    """A location is never without training recordings, whatever the counts."""
    table = np.array(counts)
    locations = [str(number % places) for number in range(len(counts))]
    try:
        parts = split_by_recording(table, locations)
    except AspEnvError:
        assert len(counts) < 3 * places  # locations with fewer than three recordings each
        return
    for place in set(locations):
        own = [part for part, other in zip(parts, locations, strict=True) if other == place]
        assert "train" in own or locations.count(place) < 3


def test_times_of_day() -> None:
    """Ten hours of the clock with two equal recordings each, of which one is the test."""
    hours = [8 + number % 10 + number / 40 for number in range(20)]
    parts = split_by_daytime(np.full(20, 5), hours)
    assert sorted(parts) == ["test"] * 2 + ["train"] * 16 + ["validation"] * 2
    assert parts[:10] == parts[10:]
    assert parts == split_by_daytime(np.full(20, 5), hours)


def test_recordings_without_snippets_have_no_time_of_day() -> None:
    assert split_by_daytime(np.array([4, 0, 4, 4]), [8.0, 9.0, 10.0, 11.0])[1] == "none"
    with pytest.raises(AspEnvError, match=r"2 hours of the clock \(8:00, 10:00\).*needs three"):
        split_by_daytime(np.array([4, 0, 4, 4]), [8.0, 9.0, 10.0, 10.5])


def test_recordings_without_snippets_are_left_out() -> None:
    """They do not count towards the three recordings that a location needs."""
    parts = split_by_recording(np.array([9, 0, 9, 9, 0]), ["1"] * 5)
    assert [part == "none" for part in parts] == [False, True, False, False, True]
    with pytest.raises(AspEnvError, match=r"at most 2 recordings .* use --split blocks"):
        split_by_recording(np.array([9, 0, 9, 5]), ["1", "1", "1", "2"])


@pytest.mark.parametrize("counts", [[], [0, 0, 0]])
def test_no_snippets_to_split(counts: list[int]) -> None:
    with pytest.raises(AspEnvError, match="--split blocks"):
        split_by_recording(np.array(counts, dtype=np.int64), ["1"] * len(counts))


@given(counts=st.lists(st.integers(1, 900), min_size=3, max_size=20), seed=st.integers(0, 99))
def test_by_recording_laws(counts: list[int], seed: int) -> None:
    """Every part has a recording, and the split is reproducible."""
    table = np.array(counts)
    parts = split_by_recording(table, ["1"] * len(counts), seed=seed)
    assert set(parts) == {"train", "validation", "test"}
    assert parts == split_by_recording(table, ["1"] * len(counts), seed=seed)


@given(
    lengths=st.lists(st.integers(0, 900), min_size=1, max_size=4),
    span=st.integers(1, 60),
    every=st.integers(1, 5),
    seed=st.integers(0, 200),
)
def test_parts_are_at_least_one_snippet_apart(
    lengths: list[int], span: int, every: int, seed: int
) -> None:
    recording, first, last = snippets(lengths, span, every)
    parts = split_blocks(recording, first, last, lengths=np.array(lengths), seed=seed)
    assert set(parts) <= {"train", "validation", "test", "none"}
    for number in range(len(lengths)):
        own = recording == number
        for part in ("train", "validation", "test"):
            inside = own & (parts == part)
            others = own & (parts != part) & (parts != "none")
            if inside.any() and others.any():
                between = np.maximum(
                    first[others] - last[inside][:, None], first[inside][:, None] - last[others]
                )
                assert between.min() - 1 >= span


def test_block_shares() -> None:
    """Of a long recording, test and validation get nearly a tenth of the snippets each."""
    lengths = [6_000]
    parts = split_blocks(*snippets(lengths, 31, 3), lengths=np.array(lengths))
    share = {part: float((parts == part).mean()) for part in ("train", "validation", "test")}
    assert 0.09 < share["test"] < 0.1
    assert 0.09 < share["validation"] < 0.1
    assert share["train"] > 0.75


def test_blocks_do_not_depend_on_other_recordings() -> None:
    recording, first, last = snippets([700, 500], 31, 3)
    both = split_blocks(recording, first, last, lengths=np.array([700, 500]))
    alone = split_blocks(*snippets([500], 31, 3), lengths=np.array([500]))
    assert both[recording == 1].tolist() == alone.tolist()


@pytest.mark.parametrize("seed", [42, 0, 1, 2])
def test_one_block_of_each(seed: int) -> None:
    """Snippets of one tick show the blocks: one each for test and validation, not adjoining."""
    parts = split_blocks(*snippets([1_000], 1, 1), lengths=np.array([1_000]), seed=seed)
    test, validation = (np.flatnonzero(parts == part) for part in ("test", "validation"))
    assert len(test) == len(validation) == 100
    assert np.ptp(test) == np.ptp(validation) == 99
    assert test[0] % 100 == validation[0] % 100 == 0
    assert abs(int(test[0] - validation[0])) > 100

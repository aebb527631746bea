"""What may be judged on: ticks that no predictor has learned from."""

import dataclasses

import numpy as np
import pytest

from asp_env.data.snippets import index_snippets
from asp_env.data.source import Recordings
from asp_env.data.split import TrainedOn, num_ticks, part_of_ticks
from asp_env.errors import AspEnvError
from asp_env.evaluation.selection import PartChoice, keep_within, ticks_to_judge
from predictors.physical import ConstantVelocity

_NAMED: tuple[PartChoice, ...] = ("train", "validation", "test")
UNTRAINED = ConstantVelocity(horizon=15, dt_s=0.2)


def _trained(recordings: Recordings, *parts: str) -> ConstantVelocity:
    """A predictor that remembers these parts of the recordings."""
    by_hash = dict(zip(recordings.hashes(), parts, strict=True))
    split = "blocks" if "blocks" in parts else "recording"
    known = TrainedOn(source="elsewhere", split=split, parts=by_hash)
    return dataclasses.replace(UNTRAINED, trained_on=known)


def _judge(recordings: Recordings, *predictors: ConstantVelocity, part: PartChoice = "auto"):
    return ticks_to_judge(recordings, predictors, part, dt_s=0.2)


def test_nobody_trained_everything_is_judged(recordings):
    """101 ticks of each 20 s recording, all allowed."""
    allowed, words = _judge(recordings, UNTRAINED)
    assert [ticks.tolist() for ticks in allowed] == [[True] * 101] * 3
    assert words == "all, of which no predictor saw any"


def test_what_was_trained_or_selected_on_is_left_out(recordings):
    """Of train, validation and test only test is left; known by content, not by name."""
    allowed, words = _judge(recordings, _trained(recordings, "train", "validation", "test"))
    assert [bool(ticks.any()) for ticks in allowed] == [False, False, True]
    assert [bool(ticks.all()) for ticks in allowed] == [False, False, True]
    assert words == "what no predictor has seen"


def test_all_predictors_count(recordings):
    """What one of two has seen is not judged for either, so that they share a table."""
    allowed, _ = _judge(
        recordings,
        _trained(recordings, "train", "test", "test"),
        UNTRAINED,
        _trained(recordings, "test", "test", "validation"),
    )
    assert [bool(ticks.any()) for ticks in allowed] == [False, True, False]


def test_blocks_leave_their_test_ticks(recordings):
    """Where blocks were dealt, one block in ten of every recording is judged."""
    allowed, _ = _judge(recordings, _trained(recordings, "blocks", "blocks", "blocks"))
    for recording, ticks in zip(recordings, allowed, strict=True):
        length = num_ticks(recording, 0.2)
        assert ticks.tolist() == (part_of_ticks(length) == "test").tolist()
        assert 9 <= ticks.sum() <= 11


def test_other_data_do_not_count(recordings):
    """A predictor trained on recordings of other content leaves all of these."""
    elsewhere = TrainedOn(source="x", split="recording", parts={"another hash": "train"})
    allowed, words = _judge(recordings, dataclasses.replace(UNTRAINED, trained_on=elsewhere))
    assert all(ticks.all() for ticks in allowed)
    assert words == "all, of which no predictor saw any"


def test_all_means_all(recordings):
    """`--part all` judges on what was trained on, and says so."""
    predictor = _trained(recordings, "train", "train", "train")
    allowed, words = _judge(recordings, predictor, part="all")
    assert all(ticks.all() for ticks in allowed)
    assert words == "all, seen or not"


def test_the_named_parts_share_the_recordings(recordings):
    """Train, validation and test each take whole recordings, and together all three."""
    taken = np.zeros(3, dtype=int)
    for part in _NAMED:
        allowed, words = _judge(recordings, UNTRAINED, part=part)
        assert words == f"{part} of the split by recording"
        assert all(ticks.all() or not ticks.any() for ticks in allowed)
        taken += [bool(ticks.any()) for ticks in allowed]
    assert taken.tolist() == [1, 1, 1]


def test_snippets_keep_within_the_allowed_ticks(recordings):
    """Of ticks 20 to 60 a snippet of 15 + 1 + 15 may be at 35 to 45: multiples of 3, 36 … 45."""
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    allowed = [np.zeros(101, dtype=bool) for _ in range(3)]
    allowed[1][20:61] = True
    kept = keep_within(index, allowed)
    assert set(kept.recording.tolist()) == {1}
    assert sorted(set(kept.tick.tolist())) == [36, 39, 42, 45]
    everything = keep_within(index, [np.ones(101, dtype=bool)] * 3)
    assert len(everything) == len(index)


def test_nothing_left_is_an_error(recordings):
    """One line that names the way out, `--part all`."""
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    with pytest.raises(AspEnvError, match=r"no snippet is left to judge on.*--part all"):
        keep_within(index, [np.zeros(101, dtype=bool)] * 3)


def test_a_named_part_is_that_of_the_training(recordings):
    """`--part validation` takes what a predictor was selected on, not what a new deal says."""
    predictor = _trained(recordings, "validation", "train", "test")
    allowed, words = _judge(recordings, predictor, part="validation")
    assert [bool(ticks.all()) for ticks in allowed] == [True, False, False]
    assert words == "validation of what the predictors were trained on"


def test_a_named_part_of_blocks_is_blocks(recordings):
    """`--part test` of a predictor trained on blocks never takes a tick that it learned from."""
    predictor = _trained(recordings, "blocks", "blocks", "blocks")
    allowed, _ = _judge(recordings, predictor, part="test")
    for ticks in allowed:
        assert ticks.tolist() == (part_of_ticks(len(ticks)) == "test").tolist()

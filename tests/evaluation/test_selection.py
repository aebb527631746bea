"""Which ticks and snippets predictors are evaluated on."""

import dataclasses

import numpy as np
import pytest

from asp_env.data.snippets import index_snippets
from asp_env.data.source import Recordings
from asp_env.data.split import TrainedOn, num_ticks, part_of_ticks
from asp_env.errors import AspEnvError
from asp_env.evaluation.selection import (
    PartChoice,
    expand_runs,
    snippets_within,
    ticks_to_evaluate,
)
from predictors.physical import ConstantVelocity

_NAMED: tuple[PartChoice, ...] = ("train", "validation", "test")
UNTRAINED = ConstantVelocity(horizon=15, dt_s=0.2)


def _trained(recordings: Recordings, *parts: str) -> ConstantVelocity:
    """A predictor that was trained with this split of the recordings."""
    by_hash = dict(zip(recordings.hashes(), parts, strict=True))
    split = "blocks" if "blocks" in parts else "recording"
    trained_on = TrainedOn(source="elsewhere", split=split, parts=by_hash)
    return dataclasses.replace(UNTRAINED, trained_on=trained_on)


def _ticks(recordings: Recordings, *predictors: ConstantVelocity, part: PartChoice = "auto"):
    return ticks_to_evaluate(recordings, predictors, part, dt_s=0.2)


def test_predictors_without_training_are_evaluated_on_everything(recordings):
    """A recording of 20 s has 101 ticks."""
    allowed, label = _ticks(recordings, UNTRAINED)
    assert [ticks.tolist() for ticks in allowed] == [[True] * 101] * 3
    assert label == "all, of which no predictor saw any"


def test_training_and_validation_recordings_are_excluded(recordings):
    """Recordings are identified by their content, not by their name."""
    allowed, label = _ticks(recordings, _trained(recordings, "train", "validation", "test"))
    assert [bool(ticks.any()) for ticks in allowed] == [False, False, True]
    assert [bool(ticks.all()) for ticks in allowed] == [False, False, True]
    assert label == "what no predictor has seen"


def test_the_training_data_of_any_predictor_are_excluded(recordings):
    """So all predictors of a table are evaluated on the same data."""
    allowed, _ = _ticks(
        recordings,
        _trained(recordings, "train", "test", "test"),
        UNTRAINED,
        _trained(recordings, "test", "test", "validation"),
    )
    assert [bool(ticks.any()) for ticks in allowed] == [False, True, False]


def test_the_test_blocks_of_a_split_by_blocks_are_left(recordings):
    """They are one of ten blocks of every recording."""
    allowed, _ = _ticks(recordings, _trained(recordings, "blocks", "blocks", "blocks"))
    for recording, ticks in zip(recordings, allowed, strict=True):
        length = num_ticks(recording, 0.2)
        assert ticks.tolist() == (part_of_ticks(length) == "test").tolist()
        assert 9 <= ticks.sum() <= 11


def test_training_on_other_data_excludes_nothing(recordings):
    elsewhere = TrainedOn(source="x", split="recording", parts={"another hash": "train"})
    allowed, label = _ticks(recordings, dataclasses.replace(UNTRAINED, trained_on=elsewhere))
    assert all(ticks.all() for ticks in allowed)
    assert label == "all, of which no predictor saw any"


def test_part_all_includes_training_data(recordings):
    predictor = _trained(recordings, "train", "train", "train")
    allowed, label = _ticks(recordings, predictor, part="all")
    assert all(ticks.all() for ticks in allowed)
    assert label == "all, seen or not"


def test_the_parts_are_a_partition_of_the_recordings(recordings):
    """Train, validation and test are whole recordings, together all three."""
    taken = np.zeros(3, dtype=int)
    for part in _NAMED:
        allowed, label = _ticks(recordings, UNTRAINED, part=part)
        assert label == f"{part} of the split by recording"
        assert all(ticks.all() or not ticks.any() for ticks in allowed)
        taken += [bool(ticks.any()) for ticks in allowed]
    assert taken.tolist() == [1, 1, 1]


def test_snippets_lie_within_the_allowed_ticks(recordings):
    """In ticks 20 to 60, snippets of 15 + 1 + 15 ticks are at multiples of 3 from 36 to 45."""
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    allowed = [np.zeros(101, dtype=bool) for _ in range(3)]
    allowed[1][20:61] = True
    within = snippets_within(index, allowed)
    assert set(within.recording.tolist()) == {1}
    assert sorted(set(within.tick.tolist())) == [36, 39, 42, 45]
    everything = snippets_within(index, [np.ones(101, dtype=bool)] * 3)
    assert len(everything) == len(index)


def test_no_snippets_are_an_error_that_names_the_option(recordings):
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    with pytest.raises(AspEnvError, match=r"no snippet is left to evaluate on.*--part all"):
        snippets_within(index, [np.zeros(101, dtype=bool)] * 3)


def test_a_part_is_that_of_the_training_split(recordings):
    """`--part validation` is what a predictor was selected on, not a new split."""
    predictor = _trained(recordings, "validation", "train", "test")
    allowed, label = _ticks(recordings, predictor, part="validation")
    assert [bool(ticks.all()) for ticks in allowed] == [True, False, False]
    assert label == "validation of what the predictors were trained on"


def test_a_part_of_a_split_by_blocks_consists_of_blocks(recordings):
    """`--part test` contains no tick that the predictor was trained on."""
    predictor = _trained(recordings, "blocks", "blocks", "blocks")
    allowed, _ = _ticks(recordings, predictor, part="test")
    for ticks in allowed:
        assert ticks.tolist() == (part_of_ticks(len(ticks)) == "test").tolist()


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """Folders `runs/b`, `runs/a`, `runs/[x]` and `runs/10`, and a file, in the present folder."""
    monkeypatch.chdir(tmp_path)
    for name in ("b", "a", "[x]", "10"):
        (tmp_path / "runs" / name).mkdir(parents=True)
    (tmp_path / "runs" / "notes.txt").write_text("no run")


@pytest.mark.usefixtures("runs")
def test_a_pattern_is_one_method_of_several_runs():
    """Folders only, sorted by path; options and registered names around the pattern remain."""
    names = (
        "oracle",
        "mtp:runs/?",
        "ssp-asp:runs/[ab]@beam",
        "delayed:2:mtp:runs/1*",
        "mtp:runs/a",
    )
    assert expand_runs(names) == {
        "oracle": ("oracle",),
        "mtp:runs/?": ("mtp:runs/a", "mtp:runs/b"),
        "ssp-asp:runs/[ab]@beam": ("ssp-asp:runs/a@beam", "ssp-asp:runs/b@beam"),
        "delayed:2:mtp:runs/1*": ("delayed:2:mtp:runs/10",),
        "mtp:runs/a": ("mtp:runs/a",),
    }
    assert expand_runs(["mtp:runs/*"])["mtp:runs/*"] == (
        "mtp:runs/10", "mtp:runs/[x]", "mtp:runs/a", "mtp:runs/b",
    )  # fmt: skip


@pytest.mark.usefixtures("runs")
def test_a_folder_whose_name_looks_like_a_pattern_is_itself():
    assert expand_runs(["mtp:runs/[x]"]) == {"mtp:runs/[x]": ("mtp:runs/[x]",)}


@pytest.mark.usefixtures("runs")
@pytest.mark.parametrize(
    ("names", "what"),
    [
        (["mtp:runs/**"], r"mtp:runs/\*\*: \*\* is not supported; use one \* for each level"),
        (["mtp:other/*"], r"mtp:other/\*: no folder matches other/\*; give the folders of"),
        (["mtp:runs/*.txt"], "no folder matches"),
        (["mtp:runs/a", "mtp:runs/a"], "mtp:runs/a is named 2 times"),
    ],
)
def test_patterns_without_runs_are_errors_of_one_line(names, what):
    with pytest.raises(AspEnvError, match=what) as caught:
        expand_runs(names)
    assert "\n" not in str(caught.value)

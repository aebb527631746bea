"""The study of fine-tuning: folds, shares, and what it writes."""

import csv
import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from asp_env.data.snippets import SnippetIndex
from asp_env.errors import AspEnvError
from predictors.experiments.finetuning import (
    SHARES_TRIED,
    Finetuning,
    Study,
    clear_of,
    folds_of_blocks,
    folds_of_recordings,
    select_by_time,
    take_share,
)
from predictors.training.fitting import train
from tests.predictors.tiny import tiny_config, write_data


def index(recordings: list[int], ticks: list[int]) -> SnippetIndex:
    """Snippets with a history of 2 ticks and a horizon of 3."""
    return SnippetIndex(
        recording=np.array(recordings), track=np.zeros(len(ticks), dtype=np.int64),
        tick=np.array(ticks), dt_s=0.2, history=2, horizon_ticks=3,
    )  # fmt: skip


def test_folds_have_similar_numbers_of_snippets() -> None:
    """5, 4, 3, 2 and 1 snippets in two folds: 5 + 2 and 4 + 3, then 1 to the first."""
    counts = np.array([1, 5, 3, 2, 4])
    np.testing.assert_array_equal(folds_of_recordings(counts, 2), [0, 0, 1, 0, 1])
    np.testing.assert_array_equal(folds_of_recordings(counts, 0), np.arange(5))


def test_blocks_by_hand() -> None:
    """20 ticks in two blocks; the snippet at tick 9 spans both and is in no fold."""
    group, fold = folds_of_blocks(index([0] * 4, [2, 6, 9, 16]), 2)
    np.testing.assert_array_equal(fold, [0, 0, -1, 1])
    np.testing.assert_array_equal(group[fold >= 0], [0, 0, 1])


def test_training_shares_no_tick_with_the_held_out_fold() -> None:
    """Snippets span 2 ticks back and 3 ahead; the held-out ones span ticks 8 to 15."""
    snippets = index([0, 0, 0, 0, 0, 1], [4, 5, 10, 12, 18, 10])
    fold = np.array([0, 0, 1, 1, 0, 0])
    np.testing.assert_array_equal(clear_of(snippets, fold, 1), [1, 0, 0, 0, 1, 1])


def test_share_is_taken_from_the_beginning_of_recordings() -> None:
    """A quarter of eight snippets are the first two of one recording; all of them are all."""
    snippets = index([0, 0, 0, 0, 1, 1, 1, 1], [9, 3, 5, 7] * 2)
    rows = np.arange(8)
    taken = {tuple(take_share(snippets, rows, 0.25, seed=seed).tolist()) for seed in range(8)}
    assert taken == {(1, 2), (5, 6)}
    np.testing.assert_array_equal(take_share(snippets, rows, 1.0, seed=0), rows)


def test_last_snippets_validate_and_training_ends_before_them() -> None:
    """Ticks 0 to 19: the border is tick 15, and futures of 3 ticks end before it."""
    snippets = index([0] * 20, [*range(20)])
    training, validation = select_by_time(snippets, np.arange(20))
    np.testing.assert_array_equal(validation, np.arange(15, 20))
    np.testing.assert_array_equal(training, np.arange(12))


def test_study_writes_paired_rows(tmp_path: Path) -> None:
    """Every method on the same snippets; zero-shot has no difference to itself."""
    start = train(
        tiny_config("ffw-asp", "vectors", epochs=1), write_data(tmp_path / "a"), tmp_path / "start"
    )
    Finetuning(
        data=(write_data(tmp_path / "b", cars=5),), out=tmp_path / "out", seeds=1, folds=2,
        from_run=f"ffw-asp:{start}", shares=(0.0, 1.0), epochs=1,
    ).run()  # fmt: skip
    with (tmp_path / "out" / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    fde = {
        row["predictor"]: row
        for row in rows
        if (row["metric"], row["selection"], row["subset"]) == ("FDE", "most-probable", "all")
    }
    assert [*fde] == ["constant-velocity", "zero-shot", "fine-tuned 1", "from scratch 1"]
    assert len({row["n"] for row in fde.values()}) == 1
    differences = {
        row["predictor"]: float(row["value"])
        for row in rows
        if (row["metric"], row["selection"], row["subset"])
        == ("FDE - zero-shot", "most-probable", "all")
    }
    assert [*differences] == ["fine-tuned 1", "from scratch 1"]
    for name, difference in differences.items():
        expected = float(fde[name]["value"]) - float(fde["zero-shot"]["value"])
        assert difference == pytest.approx(expected, abs=1e-4)


def test_single_fold_is_refused(tmp_path: Path) -> None:
    data = write_data(tmp_path / "a", recordings=1)
    with pytest.raises(AspEnvError, match="or --by blocks"):
        Finetuning(data=(data,), out=tmp_path / "out", from_run="ffw-asp:pretrained").run()


def test_too_small_share_is_refused_before_training(tmp_path: Path) -> None:
    """The share that the message suggests can be trained, and the next smaller one cannot."""
    options = Finetuning(
        data=(write_data(tmp_path / "a", cars=5),), out=tmp_path / "out", seeds=2, folds=2,
        from_run="ffw-asp:pretrained", shares=(0.001,),
    )  # fmt: skip
    with pytest.raises(AspEnvError, match=r"share 0\.001: with fold 0 held out") as raised:
        options.run()
    assert not (tmp_path / "out").exists()
    found = re.search(r"--shares of at least ([\d.]+)", str(raised.value))
    assert found is not None
    enough = float(found[1])
    Study.open(dataclasses.replace(options, shares=(enough,))).check_shares()
    smaller = [each for each in SHARES_TRIED if each < enough]
    for share in smaller[-1:]:
        with pytest.raises(AspEnvError):
            Study.open(dataclasses.replace(options, shares=(share,))).check_shares()

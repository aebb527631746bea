"""The comparison of policies."""

import json
from pathlib import Path

import numpy as np
import pytest

from asp_env.cli import main
from policies.comparison import compare_rows, default_rows, early_success, learning_curves

METRIC = "success"


def test_means_and_differences_by_hand() -> None:
    reference = [{METRIC: np.array([0.0, 1.0, 0.0, 1.0])}, {METRIC: np.array([0.0, 0.0, 0.0, 0.0])}]
    better = [{METRIC: np.ones(4)}, {METRIC: np.ones(4)}]
    rows = compare_rows({"a": reference, "b": better}, [0, 0, 1, 1], "a", early={"b": [0.5]})
    assert rows[0].estimates[METRIC].value == 0.25
    assert not rows[0].less_reference
    assert rows[1].estimates[METRIC].value == 1.0
    assert (rows[0].early_success, rows[1].early_success) == ((), (0.5,))
    assert rows[1].less_reference[METRIC].estimate.value == 0.75


def test_equal_rows_differ_by_nothing() -> None:
    values = {METRIC: np.array([0.0, 1.0, 1.0])}
    rows = compare_rows({"a": [values], "b": [values]}, [0, 1, 2], "a", early={})
    less = rows[1].less_reference[METRIC]
    assert (less.estimate.value, less.estimate.low, less.estimate.high) == (0.0, 0.0, 0.0)


def test_learning_curves_by_hand(tmp_path: Path) -> None:
    for seed, value in enumerate((0.2, 0.4)):
        folder = tmp_path / str(seed)
        folder.mkdir()
        lines = [f"{step},{value}" for step in range(100, 2100, 100)]
        (folder / "progress.csv").write_text(
            "\n".join(["time/total_timesteps,episodes/success", *lines])
        )
    curve = learning_curves({"a": [tmp_path / "0", tmp_path / "1"]})["a"]
    assert curve.shape == (20, 4)
    np.testing.assert_allclose(curve[:, 0], np.arange(100, 2100, 100))
    np.testing.assert_allclose(curve[:, 1:], [[0.3, 0.2, 0.4]] * 20)


def test_early_success_by_hand(tmp_path: Path) -> None:
    """Values at 100, 200 and 300 of 400 steps: the first two count."""
    lines = ["time/total_timesteps,episodes/success", "100,0.1", "200,0.3", "300,0.9"]
    (tmp_path / "progress.csv").write_text("\n".join(lines))
    assert early_success(tmp_path, steps=400) == pytest.approx(0.2)
    assert np.isnan(early_success(tmp_path, steps=100))


def test_privileged_rows_are_marked() -> None:
    rows = default_rows("ssp-asp:pretrained")
    assert [name for name, row in rows.items() if row.privileged] == ["oracle", "shuffled oracle"]


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("plotly")
    out = tmp_path / "compared"
    args = [
        *("rl", "compare", "sample:roundabout", "--held-out", "sample:roundabout"),
        *("--out", str(out), "--rows", "no forecast", "constant velocity", "--seeds", "1"),
        *("--steps", "2048", "--scenarios", "", "--max-scenarios", "4"),
    ]
    assert main(args) == 0
    content = json.loads((out / "comparison.json").read_text())
    names = [row["name"] for row in content["rows"]]
    assert names[0] == "expert"
    assert {"no forecast", "constant velocity", "zero actions", "random actions"} <= set(names)
    expert = content["rows"][0]["estimates"]["success"]
    assert expert["value"] == 1.0
    assert "plotly" in (out / "curves.html").read_text()
    assert main([*args[:-1], "3"]) == 2
    assert "another comparison" in capsys.readouterr().err


def test_unknown_row(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ["rl", "compare", "sample:roundabout", "--held-out", "sample:roundabout", "--out"]
    assert main([*args, str(tmp_path / "x"), "--rows", "orakle"]) == 2
    assert "orakle" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("data", "options", "message"),
    [
        ("nowhere", [], "nowhere does not exist"),
        ("sample:roundabout", ["--learned", "ssp-asp:nowhere"], "nowhere holds no trained"),
        ("sample:roundabout", ["--learned", "oracle"], "--learned oracle: it is not trained"),
        ("sample:roundabout", ["--rows", "oracle", "oracle"], "--rows oracle, oracle: name each"),
        ("sample:roundabout", ["--seeds", "0"], "--seeds 0: expected at least 1"),
    ],
)
def test_bad_options_are_refused_before_anything_is_trained(
    data: str, options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The folder is not made."""
    out = tmp_path / "compared"
    args = ["rl", "compare", data, "--held-out", "sample:roundabout", "--out", str(out)]
    assert main([*args, *options]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert (printed.err.count("\n"), printed.out) == (1, "")
    assert not out.exists()

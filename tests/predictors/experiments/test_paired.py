"""Paired differences of methods of several runs: by hand, and on recordings."""

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from predictors.experiments.errors import METRICS, VIOLATIONS, Errors
from predictors.experiments.paired import Paired, compared, table
from tests.predictors.tiny import write_data


def errors(fde_m: list[float]) -> Errors:
    """Errors on six snippets of three recordings, of which the last one stands."""
    values = np.zeros((2, len(METRICS), 6), dtype=np.float32)
    values[:, METRICS.index("FDE")] = fde_m
    violations = np.zeros((len(VIOLATIONS), 6), dtype=np.float32)
    violations[0, :2] = 1.0
    return Errors(
        values=values,
        moving=np.array([True] * 5 + [False]),
        recording=np.array([0, 0, 1, 1, 2, 2]),
        track=np.arange(6),
        tick=np.zeros(6, dtype=int),
        stamp="",
        violations=violations,
        violations_valid=np.ones((len(VIOLATIONS), 6), dtype=bool),
    )


def test_differences_by_hand() -> None:
    """Means over five moving targets and two runs; a constant difference has no width."""
    first = [errors([1, 2, 3, 4, 5, 99]), errors([3, 4, 5, 6, 7, 99])]
    second = [errors([2, 3, 4, 5, 6, 0])]
    rows = compared({"first": first, "same": first, "second": second})
    assert [row.runs for row in rows] == [2, 2, 1]
    assert rows[0].fde_m["most-probable"].value == pytest.approx(4.0)
    assert rows[0].less_reference_m == {}
    assert rows[1].less_reference_m["best-of-3"].estimate.value == pytest.approx(0.0)
    assert rows[2].less_reference_m["most-probable"].estimate.value == pytest.approx(0.0)
    assert rows[0].violations == {VIOLATIONS[0]: pytest.approx(0.4)} | dict.fromkeys(
        VIOLATIONS[1:], 0.0
    )
    constant = compared({"one": second, "other": [errors([3, 4, 5, 6, 7, 0])]})[1]
    estimate = constant.less_reference_m["most-probable"].estimate
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((1.0, 1.0, 1.0))


def test_physical_predictors_on_recordings(tmp_path: Path) -> None:
    """Both forecast cars that go straight alike; the table names the reference."""
    data = write_data(tmp_path / "data")
    methods = ("constant-velocity", "constant-turn-rate")
    rows = Paired(data=data, methods=methods, per_recording=20).compare()
    assert [row.method for row in rows] == list(methods)
    assert rows[1].less_reference_m["most-probable"].estimate.n == rows[0].fde_m["best-of-3"].n
    console = Console(width=200, record=True)
    console.print(table(rows))
    assert "less constant-velocity" in console.export_text()

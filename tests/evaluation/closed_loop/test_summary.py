"""Rows of a comparison, from scores by hand."""

import numpy as np
import pandas as pd
import pytest

from asp_env.data.scenarios.scenario import ScenarioSet
from asp_env.errors import MissingExtraError
from asp_env.evaluation.closed_loop import tidy_table
from asp_env.evaluation.closed_loop.scenario_table import DrivenScenarios, write_scenario_table
from asp_env.evaluation.closed_loop.summary import Comparison, MethodScores, comparison_rows
from asp_env.evaluation.closed_loop.tidy_table import write_tidy_table
from asp_env.evaluation.results import Condition, Row
from tests.evaluation.made_up import made_method as _method
from tests.evaluation.made_up import made_scenarios as _scenarios
from tests.evaluation.made_up import made_scores as _scores

LADDER = {
    "constant-velocity": 0.90,
    "blend:0.25": 0.92,
    "blend:0.5": 0.94,
    "blend:0.75": 0.96,
    "oracle": 0.98,
}


def _rows(methods: list[MethodScores], scenarios: ScenarioSet, **options) -> dict[tuple, Row]:
    """Rows by predictor, subset and metric."""
    common = Row(data="d", traffic="log", rules="pdms 1", metric="", value=0.0, n=0)
    known = {"compared": ["score"], "reference": "constant-velocity", "replayed": True}
    comparison = Comparison(
        methods=methods,
        scenarios=scenarios,
        common=common,
        **(known | options),
    )
    rows = comparison_rows(comparison)
    assert len({(r.predictor, r.subset, r.metric) for r in rows}) == len(rows)
    return {(r.predictor, r.subset, r.metric): r for r in rows}


DIFFERENCE = "score - constant-velocity"


def test_differences_are_paired_by_scenario():
    """Gains of 0.2 and 0.4 in two recordings: 0.3 [0.2, 0.4], although the scores vary by 0.8."""
    rows = _rows(
        [
            _method("constant-velocity", _scores([0.1, 0.5])),
            _method("mtp", _scores([0.3, 0.9])),
        ],
        _scenarios(0, 1),
    )
    row = rows["mtp", "all", DIFFERENCE]
    assert (row.value, row.low, row.high, row.n) == pytest.approx((0.3, 0.2, 0.4, 2))
    assert row.mde == pytest.approx(2.8 * 0.1 / np.sqrt(2), rel=0.03)  # 2 recordings: s / sqrt(2)
    assert row.runs == 1
    assert ("constant-velocity", "all", DIFFERENCE) not in rows
    assert rows["constant-velocity", "all", "score"].mde is None


def test_p_values_are_adjusted_over_the_methods():
    """Two equal methods: twice the p value of one, at most 1."""
    reference = _method("constant-velocity", _scores([0.1, 0.5, 0.4]))
    scores = _scores([0.2, 0.5, 0.5])
    alone = _rows([reference, _method("a", scores)], _scenarios(0, 1, 2))
    both = _rows([reference, _method("a", scores), _method("b", scores)], _scenarios(0, 1, 2))
    p = alone["a", "all", DIFFERENCE].p_holm
    assert p is not None
    assert 0.0 < p < 0.5
    for name in "ab":
        assert both[name, "all", DIFFERENCE].p_holm == pytest.approx(2 * p)


def test_several_runs_are_one_method():
    """The mean over two runs in two recordings, with an interval over both."""
    runs = _scores([0.2, 0.4]), _scores([0.6, 0.8])
    rows = _rows(
        [
            _method("constant-velocity", _scores([0.1, 0.3])),
            _method("m:*", *runs, stream=1),
        ],
        _scenarios(0, 1),
    )
    score, gain = rows["m:*", "all", "score"], rows["m:*", "all", DIFFERENCE]
    assert (score.value, score.runs, score.n) == (pytest.approx(0.5), 2, 2)
    assert (score.low, score.high) == pytest.approx((0.2, 0.8))  # a run, and a recording twice
    assert (gain.value, gain.low, gain.high) == pytest.approx((0.3, 0.1, 0.5))


def test_metrics_that_a_run_lacks_are_means_of_the_others():
    """Differences are of the scenarios in which both methods and all runs have the metric."""
    nan = np.nan
    methods = [
        _method("constant-velocity", _scores([0, 0, 0], comfort=[0.0, 0.0, nan])),
        _method(
            "m",
            _scores([0, 0, 0], comfort=[1, nan, 0]),
            _scores([0, 0, 0], comfort=[1, 1, 0]),
        ),
    ]
    rows = _rows(methods, _scenarios(0, 1, 1), compared=["score", "comfort"])
    assert rows["m", "all", "comfort"].value == pytest.approx((1 + 0.5 + 0) / 2.5)
    gain = rows["m", "all", "comfort - constant-velocity"]
    assert (gain.value, gain.n, gain.low) == (1.0, 1, None)


def test_the_oracle_share_is_that_of_the_ladder():
    """0.93 is three eighths of the way in every recording; the rungs have no share."""
    ladder = [_method(name, _scores([score] * 4)) for name, score in LADDER.items()]
    blind = _method("blind", _scores([0.2] * 4))
    expert = _method("", _scores([1.0] * 4), planner="expert")
    rows = _rows(
        [expert, *ladder, blind, _method("m", _scores([0.93] * 4))],
        _scenarios(0, 0, 1, 1),
    )
    share, headroom = rows["m", "all", "oracle share"], rows["m", "all", "headroom"]
    assert (share.value, share.low, share.high, share.n) == pytest.approx((0.375, 0.375, 0.375, 4))
    assert (headroom.value, headroom.low, headroom.high) == pytest.approx((0.375, 0.375, 0.375))
    assert rows["blind", "all", "oracle share"].value == 0.0
    assert rows["blend:0.5", "all", "headroom"].value == pytest.approx(0.5)
    for name in ("", *LADDER):
        assert (name, "all", "oracle share") not in rows
    assert ("oracle", "all", "headroom") not in rows


def test_ladder_and_method_are_resampled_together():
    """Recordings of different levels: the share is 0.375 in each, so its interval has no width."""
    levels = np.array([0.0, 0.05, 0.1])
    methods = [_method(name, _scores(score - levels)) for name, score in LADDER.items()]
    rows = _rows([*methods, _method("m", _scores(0.93 - levels))], _scenarios(0, 1, 2))
    share = rows["m", "all", "oracle share"]
    assert (share.low, share.high) == pytest.approx((0.375, 0.375))
    assert rows["m", "all", "score"].high != pytest.approx(rows["m", "all", "score"].low)


def test_without_replay_or_score_there_is_no_ladder():
    """The oracle's forecasts come true only where the others replay their logs."""
    methods = [
        _method(name, _scores([score] * 2, progress=[1, 1])) for name, score in LADDER.items()
    ]
    for options in ({"replayed": False}, {"compared": ["progress"]}):
        rows = _rows(
            [*methods, _method("m", _scores([0.93] * 2, progress=[1, 1]))],
            _scenarios(0, 1),
            **options,
        )
        assert not {metric for *_, metric in rows} & {"oracle share", "headroom"}


def test_an_unresolved_headroom_has_no_number():
    """The oracle gains in one recording what it loses in the other."""
    methods = [
        _method("constant-velocity", _scores([0.5, 0.5])),
        _method("oracle", _scores([0.6, 0.4])),
        _method("m", _scores([0.6, 0.5])),
    ]
    row = _rows(methods, _scenarios(0, 1))["m", "all", "headroom"]
    assert np.isnan(row.value)
    assert row.low is None


def test_the_reference_may_be_any_method():
    """Also one of several runs, which are resampled too."""
    reference = _method("m:*", _scores([0.2, 0.2]), _scores([0.4, 0.4]), stream=3)
    rows = _rows(
        [reference, _method("b", _scores([0.5, 0.5]))],
        _scenarios(0, 1),
        reference="m:*",
    )
    gain = rows["b", "all", "score - m:*"]
    assert (gain.value, gain.low, gain.high) == pytest.approx((0.2, 0.1, 0.3))


def test_subsets_have_their_own_rows():
    methods = [
        _method("constant-velocity", _scores([0, 0])),
        _method("m", _scores([1.0, 0.5])),
    ]
    rows = _rows(methods, _scenarios(0, 1, left=(1,)))
    assert rows["m", "left", DIFFERENCE].value == 0.5
    assert rows["m", "all", DIFFERENCE].value == 0.75
    assert {subset for _, subset, _ in rows} == {"all", "left"}


def test_the_scenario_table_has_a_row_for_each_method_run_and_scenario(tmp_path):
    """Undefined metrics are empty, numbers have six digits, tags are separated by blanks."""
    methods = [
        _method("", _scores([1, 1], comfort=[1, np.nan]), planner="expert"),
        _method("m:*", _scores([1 / 3, 1]), _scores([0.5, 1])),
    ]
    scenarios = _scenarios(0, 1, left=(0,))
    driven = DrivenScenarios(
        condition=Condition(data="d", traffic="log", latency_ticks=2),
        scenarios=scenarios,
        methods=methods,
    )
    write_scenario_table(tmp_path, [driven])
    assert (tmp_path / "scenarios.csv").read_text().splitlines() == [
        "data,traffic,latency_ticks,scenario,recording,location,tags,planner,predictor,run,ending,"
        "fault,score,comfort",
        "d,log,2,r0-0-15,r0,here,left,expert,,,GOAL,,1,1",
        "d,log,2,r1-1-15,r1,here,,expert,,,GOAL,,1,",
        "d,log,2,r0-0-15,r0,here,left,sampling,m:*,m:* 0,GOAL,,0.333333,",
        "d,log,2,r1-1-15,r1,here,,sampling,m:*,m:* 0,GOAL,,1,",
        "d,log,2,r0-0-15,r0,here,left,sampling,m:*,m:* 1,GOAL,,0.5,",
        "d,log,2,r1-1-15,r1,here,,sampling,m:*,m:* 1,GOAL,,1,",
    ]


def test_the_tidy_table_is_the_scenario_table_with_a_row_per_metric(tmp_path):
    """Turned back into columns and rounded, its values are those of `scenarios.csv`."""
    pytest.importorskip("pyarrow")
    methods = [
        _method("", _scores([1, 1], comfort=[1, np.nan]), planner="expert"),
        _method("m:*", _scores([1 / 3, 1]), _scores([0.5, 1])),
    ]
    driven = [
        DrivenScenarios(
            condition=Condition(data="d", traffic=traffic, latency_ticks=2),
            scenarios=_scenarios(0, 1, left=(0,)),
            methods=methods,
        )
        for traffic in ("log", "idm")
    ]
    write_scenario_table(tmp_path, driven)
    write_tidy_table(tmp_path, driven)
    tidy = pd.read_parquet(tmp_path / "scenarios.parquet")
    # 2 traffics, 3 runs, 2 scenarios and 2 metrics, of which the second has one value per traffic.
    assert len(tidy) == 2 * 3 * 2 * 2
    valid = tidy["valid"].to_numpy()
    assert valid.sum() == 2 * 3 * 2 + 2
    assert (np.isfinite(tidy["value"].to_numpy()) == valid).all()
    wide = pd.read_csv(tmp_path / "scenarios.csv", dtype=str, keep_default_na=False)
    keys = [
        *("data", "traffic", "latency_ticks", "planner", "predictor", "run"),
        *("scenario", "recording", "location"),
    ]
    texts = tidy.astype(dict.fromkeys([*keys, "metric"], str))
    texts["value"] = [
        f"{v:.6g}" if ok else "" for v, ok in zip(tidy.value, tidy.valid, strict=True)
    ]
    back = texts.pivot(index=keys, columns="metric", values="value")
    for metric in ("score", "comfort"):
        assert back[metric].to_dict() == wide.set_index(keys)[metric].to_dict()


def test_without_pyarrow_one_line_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr(tidy_table, "find_spec", lambda _name: None)
    with pytest.raises(MissingExtraError, match=r"--parquet needs .* 'asp-env\[parquet\]'"):
        write_tidy_table(tmp_path, [])

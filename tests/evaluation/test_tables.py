"""Result tables for terminals, and the short names in them."""

import io
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console
from rich.table import Table

from asp_env.evaluation.results import Row
from asp_env.evaluation.selection import short_names
from asp_env.evaluation.tables import (
    driving_table,
    driving_tables,
    headlines,
    open_loop_tables,
    regret_tables,
)
from asp_env.evaluation.verdicts import verdict_text
from asp_env.metrics.driving.rules import PDMS, RULES

SHOWN = PDMS.shown


def _printed(table: Table) -> list[str]:
    out = io.StringIO()
    Console(file=out, width=80).print(table)
    return out.getvalue().splitlines()


def _row(metric: str, value: float, **fields) -> Row:
    known = {"data": "d", "n": 12, "low": value - 0.1, "high": value + 0.1}
    return Row(metric=metric, value=value, **(known | fields))


def _open_loop(*names: str, subsets: tuple[str, ...] = ("all", "moving")) -> list[Row]:
    """Rows of every metric in the tables; moving targets have twice the errors of all targets."""
    metrics = {
        "": {"NLL": 5.0, "ECE": 0.05, "off-road": 0.01, "overlap": 0.02, "infeasible": 0.03},
        "most-probable": {"FDE": 1.0, "ADE": 0.5, "miss": 0.2, "MAE": 0.3, "MSE": 12.25},
        "best-of-3": {"FDE": 0.8, "ADE": 0.4, "miss": 0.1, "MAE": 0.2, "MSE": 10.5},
    }
    return [
        _row(metric, value * (1 + (subset == "moving")), predictor=name, subset=subset,
             selection=selection)
        for name in names
        for subset in subsets
        for selection, values in metrics.items()
        for metric, value in values.items()
    ]  # fmt: skip


def test_open_loop_tables_are_of_moving_targets():
    """A table for each selection and one for all else, a line for each predictor."""
    tables = open_loop_tables(_open_loop("constant-velocity", "ffw-asp:runs/a"))
    assert len(tables) == 3
    lines = _printed(tables[0])
    assert "moving targets, most-probable" in lines[0]
    assert [line.split()[0] for line in lines[-2:]] == ["constant-velocity", "ffw-asp"]
    assert "2.00 [1.90, 2.10]" in lines[-1]
    assert "moving targets, best-of-3" in _printed(tables[1])[0]


def test_the_other_metrics_fit_80_columns():
    """MAE and MSE of both selections, then the metrics of all modes."""
    names = ("constant-turn-rate", "constant-velocity")
    lines = _printed(open_loop_tables(_open_loop(*names), names)[2])
    assert max(len(line) for line in lines) <= 80
    line = next(line for line in lines if line.startswith("constant-turn-rate *"))
    assert line.split()[2:] == [
        "0.60", "24.50", "0.40", "21.00", "10.00", "0.10", "0.02", "0.04", "0.06",
    ]  # fmt: skip


def test_tables_are_of_all_targets_if_none_moves():
    lines = _printed(open_loop_tables(_open_loop("oracle", subsets=("all",)))[0])
    assert "all targets, most-probable" in lines[0]
    assert "1.00 [0.90, 1.10]" in lines[-1]


def test_regret_tables():
    """Of all and of interactive scenarios; other tags are in the file only."""
    values = {"regret": 1.5, "regret removed": -123.25, "log1p regret": 0.25}
    rows = [
        _row(metric, value, predictor=name, subset=subset)
        for name in ("constant-velocity", "oracle")
        for subset in ("all", "left", "interactive")
        for metric, value in values.items()
    ]
    tables = regret_tables(rows, ["oracle"], planner="sampling")
    assert len(tables) == 2
    lines = [_printed(table) for table in tables]
    assert max(len(line) for each in lines for line in each) <= 80
    assert "planning regret, sampling, interactive" in lines[1][0]
    found = next(line for line in lines[0] if line.startswith("oracle *"))
    assert found.split()[2:5] == ["1.50", "[1.40,", "1.60]"]
    assert not regret_tables(_open_loop("oracle"), planner="sampling")


@pytest.mark.parametrize("rules", RULES.values(), ids=RULES)
def test_driving_tables_of_all_rules_fit_80_columns(rules):
    """With a score if the rules have one; the title states their name and version."""
    names = [*(["score"] if rules.weights else []), *rules.shown]
    rows = [
        _row(name, 0.5, planner="sampling", predictor="constant-velocity", rules=rules.label)
        for name in names
    ]
    lines = _printed(driving_table(rows, (), rules.shown))
    assert max(len(line) for line in lines) <= 80
    assert f"driving by {rules.label}" in lines[0]
    assert sum(line.count("0.50") for line in lines) == len(names)


def test_methods_are_in_the_order_of_the_rows():
    """A line for each method; the cell of a missing metric is empty."""
    rows = [
        _row("score", 0.9, planner="expert"),
        _row("score", 0.5, planner="sampling", predictor="oracle"),
        _row("comfort", 0.25, planner="sampling", predictor="oracle", n=9),
    ]
    lines = _printed(driving_table(rows, (), SHOWN))
    assert max(len(line) for line in lines) <= 80
    assert lines[-2].split()[0] == "expert"
    assert "0.25" not in lines[-2]
    assert "sampling + oracle" in lines[-1]
    assert "0.25" in lines[-1]
    assert lines[-1].split()[-1] == "12"


def test_two_runs_of_one_predictor_are_two_lines():
    """They are labelled with their folders."""
    rows = [
        _row("score", value, planner="sampling", predictor=f"ffw-asp:runs/{name}")
        for name, value in (("a", 0.25), ("b", 0.75))
    ]
    lines = _printed(driving_table(rows, (), SHOWN))
    assert "ffw-asp a" in lines[-2]
    assert "0.25" in lines[-2]
    assert "ffw-asp b" in lines[-1]
    assert "0.75" in lines[-1]


def test_a_value_without_bounds_has_no_interval():
    rows = [_row("score", 0.9, planner="expert", low=None, high=None)]
    assert "[" not in _printed(driving_table(rows, (), SHOWN))[-1]


LADDER = ("blind", "constant-velocity", "blend:0.25", "blend:0.5", "blend:0.75", "oracle")
PRIVILEGED = ("expert", "oracle", "blend:0.25", "blend:0.5", "blend:0.75")


def _compared(*subsets: str) -> list[Row]:
    """The ladder, a resolved method, and one of three runs that is not resolved."""
    rows = []
    for subset in subsets:
        common: dict[str, Any] = {
            "planner": "sampling",
            "subset": subset,
            "rules": "pdms 1",
            "n": 480,
        }
        rows.append(_row("score", 0.95, **(common | {"planner": "expert"})))
        for name in (*LADDER, "constant-turn-rate", "ffw-asp:runs/*"):
            several = name.startswith("ffw")
            about = common | {"predictor": name, "runs": 3 if several else 1}
            rows.append(_row("score", 0.9, **about))
            if name == "constant-velocity":
                continue
            gain: dict[str, Any] = {"value": 0.011, "low": -0.002, "high": 0.021} if several else {
                "value": 0.046, "low": 0.023, "high": 0.061}  # fmt: skip
            mde = 0.0247 if several else 0.028
            metric = "score - constant-velocity"
            rows.append(Row(data="d", metric=metric, mde=mde, p_holm=0.01, **about, **gain))
            if name not in LADDER:
                share: dict[str, Any] = {"value": 0.4, "low": 0.25, "high": 0.549}
                rows.append(Row(data="d", metric="oracle share", **about, **share))
    return rows


def test_differences_are_shown_with_their_verdicts():
    """Of a difference of 0.011 with an MDE of 0.0247: 480 (0.0247 / 0.011)² = 2420.2 scenarios."""
    tables = driving_tables(_compared("all"), PRIVILEGED, SHOWN)
    assert len(tables) == 2
    lines = _printed(tables[0])
    assert max(len(line) for line in lines) <= 80
    assert lines[0].strip() == "all 480 scenarios, sampling: score less that of constant-velocity"
    texts = [" ".join(line.split()) for line in lines]
    assert "constant-turn-rate +0.046 [0.023, 0.061] 0.028 resolved 40 % [25, 55]" in texts
    number = texts.index("ffw-asp (3 runs) +0.011 [-0.002, 0.021] 0.025 not resolved 40 % [25, 55]")
    assert texts[number + 1] == "n ≈ 2,500"
    assert "blend 0.25 * +0.046 [0.023, 0.061] 0.028 resolved" in texts
    assert not any(text.startswith("constant-velocity") for text in texts)


def test_interactive_scenarios_are_beside_all():
    """Two tables of each, wherever the tag occurs; other tags are in `metrics.csv` only."""
    rows = _compared("all", "left", "interactive")
    some = [replace(row, n=120) if row.subset == "interactive" else row for row in rows]
    tables = driving_tables(some, PRIVILEGED, SHOWN)
    titles = [_printed(table)[0].strip() for table in tables]
    assert [title.partition(" scenarios")[0] for title in titles] == [
        "all 480", "all 480", "120 interactive", "120 interactive",
    ]  # fmt: skip
    assert all(max(len(line) for line in _printed(table)) <= 80 for table in tables)


def test_scenarios_that_are_all_interactive_are_shown_once():
    tables = driving_tables(_compared("all", "interactive"), PRIVILEGED, SHOWN)
    titles = [_printed(table)[0].strip() for table in tables]
    assert [title.partition(" scenarios")[0] for title in titles] == ["480 interactive"] * 2


def test_without_differences_there_is_one_table():
    (table,) = driving_tables([_row("score", 0.9, planner="expert")], (), SHOWN)
    assert "driving by" in _printed(table)[0]


def test_headlines_are_of_the_methods_under_test():
    """Not of controls, privileged predictors and the expert; of interactive scenarios if any."""
    assert headlines(_compared("all"), PRIVILEGED) == [
        "All 480 scenarios: constant-turn-rate drives like a 40 % oracle [25, 55]: "
        "score +0.046 [0.023, 0.061] against constant-velocity, resolved.",
        "All 480 scenarios: ffw-asp (3 runs) drives like a 40 % oracle [25, 55]: "
        "score +0.011 [-0.002, 0.021] against constant-velocity, "
        "not resolved (n ≈ 2,500 needed).",
    ]
    sentences = headlines(_compared("all", "interactive"), PRIVILEGED)
    assert len(sentences) == 2
    assert sentences[0].startswith("480 interactive scenarios: constant-turn-rate drives")


@pytest.mark.parametrize(
    ("value", "low", "high", "mde", "text"),
    [
        (0.05, 0.01, 0.09, 0.04, "resolved"),
        (0.0, 0.0, 0.0, 0.0, "equal"),
        (0.0, -0.1, 0.1, 0.2, "not resolved (difference 0)"),
        (0.05, None, None, None, "not resolved (one recording)"),
        (0.05, -0.01, 0.09, 0.04, "not resolved (0 in interval)"),
        (0.01, -0.01, 0.03, 0.02, "not resolved (n ≈ 48 needed)"),
        (0.001, -0.01, 0.03, 0.02, "not resolved (n ≈ 4,800 needed)"),
    ],
)
def test_verdicts(value, low, high, mde, text):
    row = _row("score - constant-velocity", value, low=low, high=high, mde=mde)
    assert verdict_text(row) == text


def test_short_names_are_as_short_as_they_can_be():
    """The name alone, with its folder, or with the whole path."""
    assert short_names(["oracle", "mtp:runs/1"]) == {"oracle": "oracle", "mtp:runs/1": "mtp"}
    assert short_names(["mtp:a/1", "mtp:a/2/"]) == {"mtp:a/1": "mtp 1", "mtp:a/2/": "mtp 2"}
    assert short_names(["mtp:a/1", "mtp:/b/1"]) == {"mtp:a/1": "mtp a-1", "mtp:/b/1": "mtp b-1"}
    assert short_names(["oracle", "oracle"]) == {"oracle": "oracle"}
    assert short_names(["blend:0.25", "delayed:2:mtp:a", "mtp:b"]) == {
        "blend:0.25": "blend 0.25",
        "delayed:2:mtp:a": "delayed 2 mtp",
        "mtp:b": "mtp",
    }


def test_long_names_have_short_labels_that_differ():
    """Two runs `1` in folders of 300 characters of 3 bytes each."""
    names = [f"mtp:{'道' * 300}{end}/1" for end in "ab"]
    labels = list(short_names(names).values())
    assert all(label.startswith("mtp 道道") for label in labels)
    assert max(len(label.encode()) for label in labels) <= 120
    assert labels[0] != labels[1]


def test_short_names_contain_numbers():
    """The numbers of controls and delays are part of the label, and run folders are not."""
    names = {
        "blend:0.25": "blend 0.25",
        "blend:1": "blend 1",
        "noisy-oracle:2": "noisy-oracle 2",
        "delayed:2:oracle": "delayed 2 oracle",
        "most-probable:mtp:runs/1": "most-probable mtp",
        "delayed:2:blend:0.5": "delayed 2 blend 0.5",
        "delayed:1:delayed:2:mtp:runs/1": "delayed 1 delayed 2 mtp",
        "delayed:2:ffw-asp:runs/1": "delayed 2 ffw-asp 1",
        "delayed:2:ffw-asp:runs/2": "delayed 2 ffw-asp 2",
        "ffw-asp:runs/1": "ffw-asp",
        "dkm:2": "dkm 2",
    }
    assert short_names([*names]) == names


def test_privileged_planners_are_marked():
    """With a star after the name and a caption that explains it."""
    rows = [_row("score", 0.9, planner="prophet"), _row("score", 0.5, planner="sampling")]
    lines = _printed(driving_table(rows, ["prophet"], SHOWN))
    assert any(line.startswith("prophet *") for line in lines)
    assert "* uses the recorded future" in lines[-1]
    assert not any(line.startswith("sampling *") for line in lines)

"""Tests of the report's content."""

import base64
import gzip
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asp_env.errors import AspEnvError, DataError, MissingExtraError
from asp_env.evaluation.report import ForecastExamples, metric_note, write_report
from asp_env.evaluation.report.payload import MapTable, examples_payload
from asp_env.evaluation.report.results import COLUMNS
from asp_env.metrics.driving.rules import PDMS
from asp_env.metrics.driving.scores import driving_metrics
from tests.builders import make_recording
from tests.evaluation.runs import (
    difference_rows,
    make_examples,
    metric_rows,
    write_run,
    write_scenario_values,
    write_tables,
)
from tests.metrics.records import record

METHODS = ["sampling + constant-velocity", "sampling + ffw-asp"]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a synthetic run with every section."""
    out = tmp_path_factory.mktemp("run")
    recording = make_recording(duration_s=30.0)
    write_run(out, [recording])
    return write_report(
        out,
        title="Synthetic <b>&</b>",
        lead="Two methods & a fork.",
        maps={recording.name: recording.road_map},
        examples=make_examples([recording], count=2),
    )


def test_every_driving_metric_has_a_note() -> None:
    """Columns and cards are labelled, have a unit and are explained."""
    for name in driving_metrics(record(), PDMS):
        assert metric_note(name).text, name


def rows_of(page: str, heading: str) -> list[list[str]]:
    """The values of the first table with a heading, without intervals, badges and details."""
    table = page[page.index(f"<thead><tr><th>{heading}</th>") :].partition("</table>")[0]
    rows = re.findall(r"<tr[^>]*>(.*?)</tr>", table, re.DOTALL)
    return [
        [re.sub("<[^>]+>", "", re.sub("<(small|i).*", "", cell)) for cell in cells]
        for row in rows
        if (cells := re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row))
    ]


def data_of(page: str) -> dict[str, Any]:
    """The JSON data of the page."""
    match = re.search(r'<script type="application/json" id="data">(.*?)</script>', page)
    assert match is not None
    return json.loads(match[1])


def content_of(drive: dict[str, Any]) -> dict[str, Any]:
    """A rollout of the page with what happens in it."""
    return drive | json.loads(gzip.decompress(base64.b64decode(drive["body"])))


def text_of(markup: str) -> str:
    """The text of a part of the page, with single blanks."""
    return " ".join(re.sub("<[^>]+>", " ", markup).split()).replace(" :", ":")


def test_privileged_methods_come_first_and_the_best_of_the_others_is_bold(report: Path) -> None:
    """FDE of the subset `all` is 0.7 times the error of each predictor."""
    page = report.read_text()
    table = rows_of(page, "most probable")
    column = table[0].index("FDE")
    assert [row[0] for row in table[1:]] == [
        "oracle", "constant-velocity", "constant-turn-rate", "ffw-asp",
    ]  # fmt: skip
    assert [row[column] for row in table[1:]] == ["0.00", "2.66", "2.17", "1.33"]
    best = page[page.index("<thead><tr><th>most probable</th>") :].partition("</table>")[0]
    assert re.findall(r"<b>([\d.]+)</b>", best) == ["0.27", "0.18", "1.33", "0.53", "26.6", "0.50"]
    driving = rows_of(page, "")
    assert [row[0] for row in driving[1:]] == [
        "expert", "oracle", "idm", "constant-velocity", "ffw-asp",
    ]  # fmt: skip
    assert [row[driving[0].index("Score")] for row in driving[1:]] == [
        "0.930", "0.900", "0.740", "0.700", "0.810",
    ]  # fmt: skip


def test_kinds_of_targets_have_separate_tables(report: Path) -> None:
    """FDE for left and right turns is 1.2 and 1.1 times the error; there is no tab."""
    page = report.read_text()
    before, _, section = page.partition("FDE by manoeuvre")
    table = rows_of(section, "most probable")
    assert table[0][1:] == ["left", "right"]
    assert table[2] == ["constant-velocity", "4.56", "4.18"]
    assert "manoeuvre:left" not in before


def test_the_page_answers_first(report: Path) -> None:
    """The gain of 0.11 is beyond the MDE of 0.07; the scenarios are at one place."""
    page = report.read_text()
    first = page[page.index("<header>") : page.index("<section")]
    assert text_of(first).startswith(
        "Synthetic &lt;b&gt;&amp;&lt;/b&gt; Two methods &amp; a fork. Yes: with ffw-asp this "
        "planner drives better than with constant-velocity by +0.110 [0.060, 0.160]; 240 drives, "
        "1 place."
    )
    assert re.findall(r"<h2>(.*?)</h2>", page) == [
        "Which method drives best?", "Which predictor forecasts best?", "What decides?",
        "Which drives decide?", "Player", "Example forecasts", "Metrics", "Manifest",
    ]  # fmt: skip


def test_differences_have_their_own_range_and_the_ladder(report: Path) -> None:
    """Rows are sorted by the difference; the rungs are constant velocity at 0 and the oracle."""
    (ranking,) = data_of(report.read_text())["figures"]["ranking"]
    assert [row["label"] for row in ranking["rows"]] == ["oracle", "ffw-asp", "blind"]
    assert [row["class"] for row in ranking["rows"]] == ["better", "better", "worse"]
    assert [row["control"] for row in ranking["rows"]] == [True, False, True]
    assert ranking["rungs"] == [{"label": "CV", "value": 0.0}, {"label": "oracle", "value": 0.2}]


def test_each_planner_has_a_ranking_on_its_own_ladder(tmp_path: Path) -> None:
    """The oracle gains 0.2 with one planner and 0.1 with the other; a figure compares both."""
    rows = [row for row in metric_rows() if row["planner"]]
    rows += [row | {"planner": "pdm"} for row in rows if row["planner"] == "sampling"]
    differences = difference_rows()
    differences += [
        row | {"planner": "pdm", "value": float(str(row["value"])) / 2} for row in differences
    ]
    write_tables(tmp_path, [*rows, *differences])
    page = write_report(tmp_path, title="x").read_text()
    both, first, second = data_of(page)["figures"]["ranking"]
    assert both["title"] == "Score of all methods"
    assert len(both["rows"]) == 2 + 2 * 3
    assert "rungs" not in both
    assert [row["control"] for row in both["rows"] if "ffw-asp" in row["label"]] == [False, False]
    title = "score less that with constant-velocity"
    assert [first["title"], second["title"]] == [f"sampling: {title}", f"pdm: {title}"]
    assert [rung["value"] for rung in first["rungs"]] == [0.0, 0.2]
    assert [rung["value"] for rung in second["rungs"]] == [0.0, 0.1]
    for figure in (first, second):
        assert [row["label"] for row in figure["rows"]] == ["oracle", "ffw-asp", "blind"]


def test_metrics_that_do_not_vary_are_named_and_not_drawn(tmp_path: Path) -> None:
    rows = [row for row in metric_rows() if row["planner"]]
    for row in rows:
        if row["metric"] == "on road":
            row |= {"value": 1.0 if row["planner"] != "expert" else 0.5}
    write_tables(tmp_path, rows)
    page = write_report(tmp_path, title="x").read_text()
    titles = [figure["title"] for figure in data_of(page)["figures"]["others"]]
    assert "On road" not in titles
    assert "Progress" in titles
    assert "value: On road 100.0 %." in page


def test_drives_are_listed_by_their_difference(report: Path) -> None:
    """Scores are 0.9 and 0.4, 0.2 and 0.7, 0.8 and 0.8: one gain, one loss, three below 1."""
    page = report.read_text()
    section = page[page.index('data-section="drives"') : page.index('<section id="player"')]
    lists = {
        heading: re.findall(r'data-drive="([^"]*)" data-a="([^"]*)" data-b="([^"]*)"', content)
        for heading, content in re.findall(r"<h3>(.*?)</h3><ol>(.*?)</ol>", section, re.DOTALL)
    }
    names = sorted({drive["name"] for drive in data_of(page)["drives"]})
    pair = tuple(reversed(METHODS))
    assert lists["Largest gains"] == [(names[0], *pair)]
    assert lists["Largest losses"] == [(names[1], *pair)]
    assert lists["Lowest scores of sampling + ffw-asp"] == [
        (names[number], *pair) for number in (1, 2, 0)
    ]
    (bars,) = data_of(page)["figures"]["drives"]
    assert bars["choices"][0]["bars"] == [[0.5, names[0]], [-0.5, names[1]]]
    assert "in 2 of 3 scenarios: 1 higher, 1 lower" in bars["choices"][0]["text"]


def test_every_episode_has_the_command_that_drives_it_again(report: Path) -> None:
    drive = data_of(report.read_text())["drives"][-1]
    assert drive["driver"] == "sampling + ffw-asp"
    assert drive["command"] == (
        "asp-env drive sample:intersection --planner sampling --predictors ffw-asp:runs/demo "
        f"--scenarios 'OUT/scenarios.json#{drive['name']}' --part all --traffic idm --rules pdms "
        "--horizon 3.0 --dt 0.2 --out episode"
    )


def test_several_conditions_have_parts_and_a_summary(tmp_path: Path) -> None:
    """With traffic log the gain of ffw-asp is a tenth, which is not resolved."""
    rows: list[dict[str, object]] = []
    for traffic, share in (("idm", 1.0), ("log", 0.1)):
        for row in difference_rows():
            numbers = {
                name: float(str(row[name])) * share if name != "mde" else row[name]
                for name in ("value", "mde")
            }
            value = float(str(numbers["value"]))
            bounds = {"low": value - 0.05, "high": value + 0.05}
            rows.append(row | numbers | bounds | {"traffic": traffic, "p_holm": 1 - share})
    write_tables(tmp_path, [*metric_rows(), *rows])
    page = write_report(tmp_path, title="x").read_text()
    assert data_of(page)["conditions"] == [
        "traffic idm",
        "traffic log",
    ]
    assert "2 conditions: yes in 1, not resolved in 1." in page
    matrix = page[page.index('<table class="matrix"') :].partition("</table>")[0]
    cells = re.findall(r'<td class="(\w+)">([^<]*)', matrix)
    assert cells == [
        ("better", "+0.200"), ("open", "+0.020"),
        ("better", "+0.110"), ("open", "+0.011"),
        ("worse", "-0.500"), ("open", "-0.050"),
    ]  # fmt: skip
    assert 'id="ranking"' in page
    assert 'id="ranking-1"' in page
    assert page.count("<summary>All forecast errors as numbers</summary>") == 1


def test_the_page_is_self_contained_and_escapes_its_title(report: Path) -> None:
    """The page links no script, style, image or font; with 200 rollouts it is below 10 MB."""
    own = report.read_text()
    drives = [len(drive["body"]) for drive in data_of(own)["drives"]]
    assert len(own) - sum(drives) + 200 * max(drives) < 10e6
    assert "http" not in own.replace("http://www.w3.org/2000/svg", "")
    assert not re.search(r"<(script|link|img|iframe)[^>]*(src|href)=[\"'](?!data:)", own)
    assert "Synthetic &lt;b&gt;&amp;&lt;/b&gt;" in own
    assert "<b>&</b>" not in own


def test_rollouts_hold_poses_events_plans_and_forecasts(report: Path) -> None:
    """Poses are in centimetres and thousandths of a radian."""
    rollouts = [content_of(drive) for drive in data_of(report.read_text())["drives"]]
    assert [rollout["driver"] for rollout in rollouts] == sorted(METHODS * 3)
    assert len(rollouts) == 6
    rollout = rollouts[0]
    half = (rollout["ticks"] - 1) // 2
    assert rollout["events"][1] == ["off-road", half, half + 3]
    recording = make_recording(duration_s=30.0)
    ego = int(rollout["name"].split("-")[1])
    start_tick = int(rollout["name"].split("-")[2])
    track = recording.track(int(np.flatnonzero(recording.track_ids == ego)[0]))
    x, y, heading = track[start_tick * 5, :3] * (100, 100, 1000)
    assert np.abs(np.array(rollout["log"][0]) - (x, y, heading)).max() <= 0.51
    assert len(rollout["plans"]) == rollout["ticks"] - 1 == len(rollout["log"]) - 1
    forecasts = rollout["forecasts"][3]
    assert forecasts
    assert all(sum(p for p, _ in modes) == pytest.approx(1, abs=2e-3) for _, modes in forecasts)


@pytest.mark.parametrize(("conditions", "briefly"), [(4, 0), (5, 5)])
def test_many_conditions_have_tables_of_all_scenarios_alone(
    tmp_path: Path, conditions: int, briefly: int
) -> None:
    """The tables of fewer conditions have a tab for the tag `left`, too."""
    rows = [
        row | {"traffic": f"traffic-{number}"}
        for number in range(conditions)
        for row in metric_rows()
        if row["planner"]
    ]
    write_tables(tmp_path, rows)
    page = write_report(tmp_path, title="x").read_text()
    numbers = re.findall(r"All driving metrics as numbers.*?</details>", page, re.DOTALL)
    assert len(numbers) == conditions
    assert sum("metrics.csv has the metrics by tag" in each for each in numbers) == briefly
    assert sum(">left</button>" in each for each in numbers) == conditions - briefly


def test_examples_preserve_positions_and_final_errors() -> None:
    """Steps add up to the end of the forecast within a centimetre; errors are means."""
    recording = make_recording()
    examples = make_examples([recording], count=1)
    (row,) = examples_payload(examples, MapTable())
    forecast = examples.forecasts["ffw-asp"]
    for target in range(len(row["targets"])):
        for mode, (p, steps) in enumerate(row["forecasts"]["ffw-asp"]["modes"][target]):
            end = np.array(steps).reshape(-1, 2).sum(axis=0) / 100
            assert np.abs(end - forecast.states[target, mode, -1, :2]).max() < 0.006
            assert p == pytest.approx(np.exp(forecast.log_probs[target, mode]), abs=1e-3)
    straight = examples.forecasts["constant-velocity"].states[:, 0, -1, :2]
    miss = np.linalg.norm(straight - examples.future.states[:, -1, :2], axis=-1)
    assert row["forecasts"]["constant-velocity"]["fde"] == pytest.approx(miss.mean(), abs=0.006)


def test_sections_without_content_are_left_out(tmp_path: Path) -> None:
    write_tables(tmp_path, [row for row in metric_rows() if not row["planner"]])
    page = write_report(tmp_path, title="Open loop").read_text()
    assert re.findall(r'<section id="(\w+)"', page) == ["forecasts", "metrics", "manifest"]
    assert "ffw-asp forecasts better than constant-velocity" in page


def test_names_that_look_like_markup_are_escaped(tmp_path: Path) -> None:
    rows = [row | {"predictor": "</script><i>x"} for row in metric_rows() if not row["planner"]]
    write_tables(tmp_path, rows[:8])
    page = write_report(tmp_path, title="Odd").read_text()
    assert "</script><i>x" not in page
    assert "&lt;/script&gt;&lt;i&gt;x" in page
    assert any("</script><i>x" in name for name in data_of(page)["colours"])


def test_run_folders_of_before_recipes_were_named_still_load(tmp_path: Path) -> None:
    """The column `recipe` of `metrics.csv` was called `preset`; the page is the same."""
    write_tables(tmp_path, [row | {"recipe": "paper"} for row in metric_rows()])
    page = write_report(tmp_path, title="x").read_text()
    assert "recipe paper" in page
    table = tmp_path / "metrics.csv"
    table.write_text(table.read_text().replace(",recipe,", ",preset,", 1))
    assert write_report(tmp_path, title="x").read_text() == page


def test_missing_or_damaged_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(DataError, match=r"metrics\.csv: not a table"):
        write_report(tmp_path, title="x")
    (tmp_path / "metrics.csv").write_text("data,predictor\na,b\n")
    with pytest.raises(DataError, match="no column 'trained_on'"):
        write_report(tmp_path, title="x")
    write_tables(tmp_path, [metric_rows()[0] | {"value": "much"}])
    with pytest.raises(DataError, match="metric 'MAE': could not convert"):
        write_report(tmp_path, title="x")
    write_tables(tmp_path, metric_rows()[:1])
    (tmp_path / "scenarios.csv").write_text("scenario,recording\na,b\n")
    with pytest.raises(DataError, match=r"scenarios\.csv: no column 'location'"):
        write_report(tmp_path, title="x")
    write_scenario_values(tmp_path, {"00-1-2": (0.5, 0.5)})
    table = tmp_path / "scenarios.csv"
    table.write_text(table.read_text().replace(",0.5", ",half"))
    with pytest.raises(DataError, match=r"scenario '00-1-2': could not convert"):
        write_report(tmp_path, title="x")
    write_tables(tmp_path, metric_rows()[:2])
    whole = (tmp_path / "metrics.csv").read_text()
    for cut in (whole.rstrip()[:-20], whole.rstrip() + ",1\n"):
        (tmp_path / "metrics.csv").write_text(cut)
        with pytest.raises(DataError, match="row 3: has another number of cells"):
            write_report(tmp_path, title="x")
    recording = make_recording(duration_s=30.0)
    write_run(tmp_path, [recording])
    with pytest.raises(DataError, match="no map of recording '00' was given; given were 01"):
        write_report(tmp_path, title="x", maps={"01": recording.road_map})
    (tmp_path / "manifest.json").unlink()
    with pytest.raises(DataError, match=r"manifest\.json: not a manifest"):
        write_report(tmp_path, title="x", maps={"00": recording.road_map})
    assert not [path for path in tmp_path.iterdir() if "report" in path.name]


def test_examples_of_different_scenes_are_refused() -> None:
    examples = make_examples([make_recording()], count=1)
    with pytest.raises(AspEnvError, match="2 captions for 1 situations"):
        ForecastExamples(
            scene=examples.scene,
            future=examples.future,
            forecasts=examples.forecasts,
            captions=("a", "b"),
        )
    fewer = examples.scene.with_targets(examples.scene.targets[:1])
    with pytest.raises(AspEnvError, match="the future has"):
        ForecastExamples(
            scene=fewer, future=examples.future, forecasts={}, captions=examples.captions
        )


def test_a_missing_package_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_tables(tmp_path, metric_rows()[:1])
    monkeypatch.setattr("asp_env.evaluation.report.page.find_spec", {"plotly": 1}.get)
    with pytest.raises(MissingExtraError, match=r"'jinja2'.*asp-env\[report\]"):
        write_report(tmp_path, title="x")


def comparison(predictor: str, metric: str, value: float, **cells: object) -> dict[str, object]:
    """A row of a comparison, like those of `drive`."""
    common = {"data": "sample:intersection", "traffic": "idm", "latency_ticks": 0}
    common |= {"planner": "sampling", "predictor": predictor, "subset": "all", "n": 480}
    return {**dict.fromkeys(COLUMNS, ""), **common, "metric": metric, "value": value, **cells}


def test_comparisons_come_first_with_verdicts(tmp_path: Path) -> None:
    """Of a gain of 1.1 % with an MDE of 2.47 %, 480 (2.47 / 1.1)² = 2420.2 scenarios are needed."""
    gain, pattern = "score - constant-velocity", "ffw-asp:runs/*"
    rows = [
        comparison(pattern, gain, 0.011, low=-0.002, high=0.021, mde=0.0247, p_holm=0.2, runs=3),
        comparison(pattern, "oracle share", 0.4, low=0.25, high=0.55, runs=3),
        comparison(pattern, "headroom", 0.35, low=0.2, high=0.5, runs=3),
        comparison(pattern, "TTC - constant-velocity", 0.02, low=-0.01, high=0.05, runs=3),
        comparison("oracle", gain, 0.046, low=0.023, high=0.061, mde=0.028, p_holm=1e-5, runs=1),
        comparison("mtp:a", gain, 0.0, low=0.0, high=0.0, mde=0.0, p_holm=1.0, runs=1),
        comparison("mtp:a", "headroom", float("nan"), runs=1),
    ]
    rows = [row for row in metric_rows() if row["planner"]] + rows
    write_tables(tmp_path, rows)
    page = write_report(tmp_path, title="x").read_text()
    header, *table = rows_of(page, "score less constant-velocity")
    assert header[1:] == ["Difference", "MDE", "p", "Verdict", "Oracle share", "Headroom"]
    assert table == [
        ["oracle", "0.046", "0.028", "&lt; 0.001", "resolved", "&ndash;", "&ndash;"],
        ["ffw-asp", "0.011", "0.025", "0.200", "not resolved", "40.0", "35.0"],
        ["mtp", "0.000", "0.000", "1.000", "equal", "&ndash;", "not resolved"],
    ]
    assert page.index("score less constant-velocity</th>") < page.index("<th></th>")
    assert "n ≈ 2,500 needed" in page
    assert "mean of 3 runs" in page
    assert rows_of(page, "less constant-velocity")[1] == ["ffw-asp", "2.0"]
    headings = rows_of(page, "")[0]
    assert not {"Oracle share", "Headroom", "Score - CV"} & set(headings)


def test_run_folders_without_the_columns_of_comparisons_still_load(tmp_path: Path) -> None:
    """Folders of before lack `runs`, `mde` and `p_holm`; their differences have no verdict."""
    write_tables(tmp_path, [comparison("mtp:a", "score - constant-velocity", 0.1, low=0, high=0.2)])
    lines = (tmp_path / "metrics.csv").read_text().splitlines()
    assert lines[0].endswith(",rules,runs,mde,p_holm")
    old = [lines[0].removesuffix(",runs,mde,p_holm"), *(line[:-3] for line in lines[1:])]
    (tmp_path / "metrics.csv").write_text("\n".join(old) + "\n")
    page = write_report(tmp_path, title="x").read_text()
    assert rows_of(page, "score less constant-velocity")[1][:3] == [
        "mtp", "0.100", "&ndash;",
    ]  # fmt: skip

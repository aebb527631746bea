"""Tests of the report: its content, and that it works in a browser without a network."""

import json
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

from asp_env.errors import AspEnvError, DataError, MissingExtraError
from asp_env.evaluation.report import ForecastExamples, metric_note, write_report
from asp_env.evaluation.report.payload import MapTable, examples_payload
from asp_env.evaluation.report.results import COLUMNS
from asp_env.metrics.driving.rules import PDMS
from asp_env.metrics.driving.scores import driving_metrics
from tests.builders import make_recording
from tests.evaluation.runs import make_examples, metric_rows, write_run, write_tables
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
        "expert", "sampling + oracle", "idm", "sampling + constant-velocity", "sampling + ffw-asp",
    ]  # fmt: skip
    assert [row[driving[0].index("Score")] for row in driving[1:]] == [
        "93.0", "90.0", "74.0", "70.0", "81.0",
    ]  # fmt: skip


def test_kinds_of_targets_have_separate_tables(report: Path) -> None:
    """FDE for left and right turns is 1.2 and 1.1 times the error; there is no tab and no bar."""
    page = report.read_text()
    section = page.partition('<section id="breakdown">')[2].partition("</section>")[0]
    assert "FDE by manoeuvre" in section
    table = rows_of(section, "most probable")
    assert table[0][1:] == ["left", "right"]
    assert table[2] == ["constant-velocity", "4.56", "4.18"]
    assert "manoeuvre:left" not in page.partition('<section id="breakdown">')[0]
    bars = data_of(page)["figures"]["final-errors"]["data"]
    assert {x for bar in bars for x in bar["x"]} == {"all", "moving", "left", "straight"}


def test_cards_compare_with_constant_velocity_and_the_expert(report: Path) -> None:
    """FDE of moving targets is 1.90 m beside 3.80 m, the score 81.0 % beside 93.0 %."""
    cards = report.read_text().partition('<div class="cards">')[2].partition("<section")[0]
    assert re.findall(r'class="figure">([\d.]+)', cards) == ["1.90", "1.14", "81.0", "93.9"]
    assert "constant velocity: 3.80 m; ratio 0.50 (0.45 to 0.55)" in cards
    assert "expert: 93.0 %" in cards


def test_the_page_is_self_contained_and_escapes_its_title(report: Path) -> None:
    """The page links no script, style, image or font and is smaller than 15 MB."""
    page = report.read_text()
    own = page.replace(page[page.index("/**\n* plotly.js") :].partition("</script>")[0], "")
    assert len(own) < 2_000_000  # plotly has been removed from the text
    assert "http" not in own
    assert not re.search(r"<(script|link|img|iframe)[^>]*(src|href)=[\"'](?!data:)", own)
    assert "Synthetic &lt;b&gt;&amp;&lt;/b&gt;" in own
    assert "<b>&</b>" not in own
    assert report.stat().st_size < 15e6


def test_rollouts_hold_poses_events_plans_and_forecasts(report: Path) -> None:
    """Poses are in centimetres and thousandths of a radian."""
    rollouts = data_of(report.read_text())["drives"]
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
    assert re.findall(r'<section id="(\w+)"', page) == [
        "forecasts",
        "breakdown",
        "metrics",
        "manifest",
    ]


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


@pytest.mark.parametrize("package", ["plotly", "jinja2"])
def test_a_missing_package_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str
) -> None:
    write_tables(tmp_path, metric_rows()[:1])
    monkeypatch.setattr(
        "asp_env.evaluation.report.page.find_spec", lambda name: None if name == package else name
    )
    with pytest.raises(MissingExtraError, match=rf"'{package}'.*asp-env\[report\]"):
        write_report(tmp_path, title="x")


def requests(browser: webdriver.Chrome) -> list[str]:
    """Addresses that the page requested."""
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    return [
        message["params"]["request"]["url"]
        for message in messages
        if message["method"] == "Network.requestWillBeSent"
    ]


def pixels(browser: webdriver.Chrome, canvas: str) -> str:
    """The present content of a canvas."""
    return browser.execute_script(f"return document.querySelector({canvas!r}).toDataURL()")


def test_the_report_works_in_a_browser(report: Path, browser: webdriver.Chrome) -> None:
    """Plots and pictures are drawn, the replay plays, there are no warnings and no requests."""
    browser.get(report.as_uri())
    assert len(browser.find_elements(By.CSS_SELECTOR, ".js-plotly-plot svg.main-svg")) >= 3
    assert len(browser.find_elements(By.CSS_SELECTOR, ".js-plotly-plot .bars .point")) == 32
    blank = "data:,"
    pictures = browser.find_elements(By.CSS_SELECTOR, "#picture-grid canvas")
    assert len(pictures) == 2 * 3
    drawn = {browser.execute_script("return arguments[0].toDataURL()", each) for each in pictures}
    assert blank not in drawn
    assert len(drawn) == len(pictures)

    play = browser.find_element(By.ID, "replay-play")
    to_middle = "arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})"
    browser.execute_script(to_middle, play)
    before = pixels(browser, "#replay-canvas")
    time.sleep(0.5)
    assert pixels(browser, "#replay-canvas") == before  # the replay starts paused
    play.click()
    WebDriverWait(browser, 10).until(lambda b: b.execute_script("return window.replay.tick") > 2)
    assert play.get_attribute("aria-label") == "Pause"
    assert pixels(browser, "#replay-canvas") != before
    play.click()
    half = browser.execute_script("return (window.replay.rollout.ticks - 1) / 2 | 0")
    browser.execute_script(f"window.replay.seek({half})")
    assert browser.find_element(By.ID, "replay-event").text == "off-road"

    scenario = browser.find_element(By.ID, "replay-scenario")
    chosen = scenario.get_property("selectedIndex")
    before = pixels(browser, "#replay-canvas")
    method = browser.find_element(By.ID, "replay-method")
    assert method.text.split("\n") == METHODS
    browser.execute_script(
        "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('change'))",
        method,
        METHODS[1],
    )
    assert scenario.get_property("selectedIndex") == chosen  # the same scenario at the same time
    assert browser.execute_script("return window.replay.tick") == half
    assert pixels(browser, "#replay-canvas") != before

    panels = browser.find_elements(By.CSS_SELECTOR, "#forecasts [role=tabpanel]")
    assert [panel.is_displayed() for panel in panels] == [True, False, False, False]
    tabs = browser.find_elements(By.CSS_SELECTOR, "#forecasts [role=tab]")
    browser.execute_script("arguments[0].click()", tabs[1])
    assert [panel.is_displayed() for panel in panels] == [False, True, False, False]

    assert [e for e in browser.get_log("browser") if e["level"] in ("SEVERE", "WARNING")] == []
    urls = requests(browser)
    assert report.as_uri() in urls
    assert [url for url in urls if url.startswith(("http", "ws"))] == []


def comparison(predictor: str, metric: str, value: float, **cells: object) -> dict[str, object]:
    """A row of a comparison, like those of `drive`."""
    common = {"data": "d", "planner": "sampling", "predictor": predictor, "subset": "all", "n": 480}
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
    driving = page.partition('<section id="driving">')[2].partition("</section>")[0]
    assert driving.index("score less constant-velocity") < driving.index("<th></th>")
    header, *table = rows_of(driving, "score less constant-velocity")
    assert header[1:] == ["Difference", "MDE", "p", "Verdict", "Oracle share", "Headroom"]
    assert table == [
        ["sampling + oracle", "4.6", "2.8", "&lt; 0.001", "resolved", "&ndash;", "&ndash;"],
        ["sampling + ffw-asp", "1.1", "2.5", "0.200", "not resolved", "40.0", "35.0"],
        ["sampling + mtp", "0.0", "0.0", "1.000", "equal", "&ndash;", "not resolved"],
    ]
    assert "n ≈ 2,500 needed" in driving
    assert "mean of 3 runs" in driving
    assert rows_of(driving, "less constant-velocity")[2] == ["sampling + ffw-asp", "2.0"]
    sentences = re.findall(r'<p class="sentence">(.*?)</p>', driving)
    assert sentences == [
        "sampling + ffw-asp · runs/* · mean of 3 runs drives like a 40 % oracle [25, 55]: "
        "score +1.1 % [-0.2, 2.1] against constant-velocity, not resolved (n ≈ 2,500 needed).",
        "sampling + mtp · a: score +0.0 % [0.0, 0.0] against constant-velocity, equal.",
    ]
    headings = rows_of(driving, "")[0]
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
        "sampling + mtp", "10.0", "&ndash;",
    ]  # fmt: skip

"""The report: what it says, that it works in a browser, and that it asks no network."""

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
from asp_env.evaluation.report import ForecastExamples, write_report
from asp_env.evaluation.report.payload import MapTable, pictures_payload
from tests.builders import make_recording
from tests.evaluation.runs import make_examples, metric_rows, write_run, write_tables

DRIVERS = ["sampling + constant-velocity", "sampling + ffw-asp"]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a made-up run with everything that one can have."""
    out = tmp_path_factory.mktemp("run")
    recording = make_recording(duration_s=30.0)
    write_run(out, [recording])
    return write_report(
        out,
        title="Made up <b>&</b>",
        lead="Two drivers & a fork.",
        maps={recording.name: recording.road_map},
        examples=make_examples([recording], count=2),
    )


def rows_of(page: str, heading: str) -> list[list[str]]:
    """The cells' first words of the first table that carries a heading."""
    table = page[page.index(f"<thead><tr><th>{heading}</th>") :].partition("</table>")[0]
    rows = re.findall(r"<tr[^>]*>(.*?)</tr>", table, re.DOTALL)
    return [
        [re.sub("<[^>]+>", "", re.sub("<(small|i).*", "", cell)) for cell in cells]
        for row in rows
        if (cells := re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row))
    ]


def data_of(page: str) -> dict[str, Any]:
    """What the page's scripts are handed."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page)
    assert found is not None
    return json.loads(found[1])


def test_tables_name_who_knew_the_future_first_and_mark_the_best_of_the_others(
    report: Path,
) -> None:
    """FDE of the `all` subset is 0.7 times the error of each predictor; the expert leads."""
    page = report.read_text()
    table = rows_of(page, "most probable")
    column = table[0].index("FDE")
    assert [row[0] for row in table[1:]] == [
        "oracle", "constant-velocity", "constant-turn-rate", "ffw-asp",
    ]  # fmt: skip
    assert [row[column] for row in table[1:]] == ["0.00", "2.66", "2.17", "1.33"]
    best = page[page.index("<thead><tr><th>most probable</th>") :].partition("</table>")[0]
    assert re.findall(r"<b>([\d.]+)</b>", best) == ["0.27", "0.18", "1.33", "0.53", "26.6", "0.50"]
    driven = rows_of(page, "")
    assert [row[0] for row in driven[1:]] == [
        "expert", "sampling + oracle", "idm", "sampling + constant-velocity", "sampling + ffw-asp",
    ]  # fmt: skip
    assert [row[driven[0].index("Score")] for row in driven[1:]] == [
        "93.0", "90.0", "74.0", "70.0", "81.0",
    ]  # fmt: skip


def test_kinds_of_targets_have_tables_of_their_own(report: Path) -> None:
    """Columns left and right of manoeuvres, FDE 1.2 and 1.1 times the error; no tab, no bar."""
    page = report.read_text()
    section = page.partition('<section id="kinds">')[2].partition("</section>")[0]
    assert "FDE by manoeuvre" in section
    table = rows_of(section, "most probable")
    assert table[0][1:] == ["left", "right"]
    assert table[2] == ["constant-velocity", "4.56", "4.18"]
    assert "manoeuvre:left" not in page.partition('<section id="kinds">')[0]
    bars = data_of(page)["figures"]["final-errors"]["data"]
    assert {x for bar in bars for x in bar["x"]} == {"all", "moving", "left", "straight"}


def test_cards_compare_with_constant_velocity_and_the_expert(report: Path) -> None:
    """FDE of moving targets 1.90 m beside 3.80 m; score 81.0 % beside 93.0 %."""
    cards = report.read_text().partition('<div class="cards">')[2].partition("<section")[0]
    assert re.findall(r'class="figure">([\d.]+)', cards) == ["1.90", "1.14", "81.0", "93.9"]
    assert "constant velocity: 3.80 m; ratio 0.50 (0.45 to 0.55)" in cards
    assert "93.0 % for the logged expert" in cards


def test_the_page_names_nothing_outside_itself_and_escapes_what_it_is_given(report: Path) -> None:
    """No linked script, style, image or font; titles are text, not markup; under 15 MB."""
    page = report.read_text()
    own = page.replace(page[page.index("/**\n* plotly.js") :].partition("</script>")[0], "")
    assert len(own) < 2_000_000  # the library was found and cut out
    assert "http" not in own
    assert not re.search(r"<(script|link|img|iframe)[^>]*(src|href)=[\"'](?!data:)", own)
    assert "Made up &lt;b&gt;&amp;&lt;/b&gt;" in own
    assert "<b>&</b>" not in own
    assert report.stat().st_size < 15e6


def test_drives_hold_what_was_logged(report: Path) -> None:
    """Poses in centimetres and thousandths of a radian; spells of events; both drivers."""
    drives = data_of(report.read_text())["drives"]
    assert [drive["driver"] for drive in drives] == sorted(DRIVERS * 3)
    assert len(drives) == 6
    drive = drives[0]
    half = (drive["ticks"] - 1) // 2
    assert drive["events"][1] == ["off-road", half, half + 3]
    recording = make_recording(duration_s=30.0)
    ego = int(drive["name"].split("-")[1])
    start_tick = int(drive["name"].split("-")[2])
    track = recording.track(int(np.flatnonzero(recording.track_ids == ego)[0]))
    x, y, heading = track[start_tick * 5, :3] * (100, 100, 1000)
    assert np.abs(np.array(drive["log"][0]) - (x, y, heading)).max() <= 0.51
    assert len(drive["plans"]) == drive["ticks"] - 1 == len(drive["log"]) - 1
    told = drive["forecasts"][3]
    assert told
    assert all(sum(p for p, _ in modes) == pytest.approx(1, abs=2e-3) for _, modes in told)


def test_pictures_keep_places_and_final_errors() -> None:
    """Steps add up to the forecast's end to a centimetre; captions' errors are the means."""
    recording = make_recording()
    examples = make_examples([recording], count=1)
    (row,) = pictures_payload(examples, MapTable())
    forecast = examples.forecasts["ffw-asp"]
    for place in range(len(row["targets"])):
        for mode, (p, steps) in enumerate(row["forecasts"]["ffw-asp"]["modes"][place]):
            end = np.array(steps).reshape(-1, 2).sum(axis=0) / 100
            assert np.abs(end - forecast.states[place, mode, -1, :2]).max() < 0.006
            assert p == pytest.approx(np.exp(forecast.log_probs[place, mode]), abs=1e-3)
    straight = examples.forecasts["constant-velocity"].states[:, 0, -1, :2]
    miss = np.linalg.norm(straight - examples.future.states[:, -1, :2], axis=-1)
    assert row["forecasts"]["constant-velocity"]["fde"] == pytest.approx(miss.mean(), abs=0.006)


def test_a_run_without_drives_or_pictures_has_no_such_sections(tmp_path: Path) -> None:
    """Only what there is gets a heading."""
    write_tables(tmp_path, [row for row in metric_rows() if not row["planner"]])
    page = write_report(tmp_path, title="Open loop").read_text()
    assert re.findall(r'<section id="(\w+)"', page) == ["forecasts", "kinds", "metrics", "run"]


def test_names_that_look_like_markup_stay_text(tmp_path: Path) -> None:
    """A predictor called as a closing script tag breaks nothing."""
    rows = [row | {"predictor": "</script><i>x"} for row in metric_rows() if not row["planner"]]
    write_tables(tmp_path, rows[:8])
    page = write_report(tmp_path, title="Odd").read_text()
    assert "</script><i>x" not in page
    assert "&lt;/script&gt;&lt;i&gt;x" in page
    assert any("</script><i>x" in name for name in data_of(page)["colours"])


def test_what_is_missing_or_damaged_is_one_line(tmp_path: Path) -> None:
    """No table, a column less, text for a number, no manifest, a rollout without its map."""
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(DataError, match=r"metrics\.csv: not a table"):
        write_report(tmp_path, title="x")
    (tmp_path / "metrics.csv").write_text("data,predictor\na,b\n")
    with pytest.raises(DataError, match="no column 'trained_on'"):
        write_report(tmp_path, title="x")
    write_tables(tmp_path, [metric_rows()[0] | {"value": "much"}])
    with pytest.raises(DataError, match="metric 'MAE': could not convert"):
        write_report(tmp_path, title="x")
    recording = make_recording(duration_s=30.0)
    write_run(tmp_path, [recording])
    with pytest.raises(DataError, match="no map of recording '00' was given; given were 01"):
        write_report(tmp_path, title="x", maps={"01": recording.road_map})
    (tmp_path / "manifest.json").unlink()
    with pytest.raises(DataError, match=r"manifest\.json: not a manifest"):
        write_report(tmp_path, title="x", maps={"00": recording.road_map})
    assert not [path for path in tmp_path.iterdir() if "report" in path.name]


def test_examples_that_do_not_belong_together_are_refused() -> None:
    """As many captions as situations, as many targets as the scene has."""
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


def test_without_plotly_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One line that says what to install."""
    write_tables(tmp_path, metric_rows()[:1])
    monkeypatch.setattr("asp_env.evaluation.report.page.find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"'plotly'.*asp-env\[report\]"):
        write_report(tmp_path, title="x")


def requests(browser: webdriver.Chrome) -> list[str]:
    """Addresses that the page asked for."""
    told = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    return [
        message["params"]["request"]["url"]
        for message in told
        if message["method"] == "Network.requestWillBeSent"
    ]


def pixels(browser: webdriver.Chrome, canvas: str) -> str:
    """What a canvas shows now."""
    return browser.execute_script(f"return document.querySelector({canvas!r}).toDataURL()")


def test_the_report_works_in_a_browser(report: Path, browser: webdriver.Chrome) -> None:
    """Plots and pictures are drawn, the replay plays, the console is clean, the network unused."""
    browser.get(report.as_uri())
    assert len(browser.find_elements(By.CSS_SELECTOR, ".js-plotly-plot svg.main-svg")) >= 3
    assert len(browser.find_elements(By.CSS_SELECTOR, ".js-plotly-plot .bars .point")) == 32
    blank = "data:,"
    shown = browser.find_elements(By.CSS_SELECTOR, "#picture-grid canvas")
    assert len(shown) == 2 * 3
    drawn = {browser.execute_script("return arguments[0].toDataURL()", each) for each in shown}
    assert blank not in drawn
    assert len(drawn) == len(shown)

    play = browser.find_element(By.ID, "replay-play")
    to_middle = "arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})"
    browser.execute_script(to_middle, play)
    before = pixels(browser, "#replay-canvas")
    time.sleep(0.5)
    assert pixels(browser, "#replay-canvas") == before  # nothing moves by itself
    play.click()
    WebDriverWait(browser, 10).until(lambda b: b.execute_script("return window.replay.tick") > 2)
    assert play.get_attribute("aria-label") == "Pause"
    assert pixels(browser, "#replay-canvas") != before
    play.click()
    half = browser.execute_script("return (window.replay.log.ticks - 1) / 2 | 0")
    browser.execute_script(f"window.replay.seek({half})")
    assert browser.find_element(By.ID, "replay-event").text == "off-road"

    chosen = browser.find_element(By.ID, "replay-drive").get_property("selectedIndex")
    one = pixels(browser, "#replay-canvas")
    driver = browser.find_element(By.ID, "replay-driver")
    assert driver.text.split("\n") == DRIVERS
    browser.execute_script(
        "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('change'))",
        driver,
        DRIVERS[1],
    )
    kept = browser.find_element(By.ID, "replay-drive").get_property("selectedIndex")
    assert kept == chosen  # the same drive and time of the other driver
    assert browser.execute_script("return window.replay.tick") == half
    assert pixels(browser, "#replay-canvas") != one

    panels = browser.find_elements(By.CSS_SELECTOR, "#forecasts [role=tabpanel]")
    assert [panel.is_displayed() for panel in panels] == [True, False, False, False]
    tabs = browser.find_elements(By.CSS_SELECTOR, "#forecasts [role=tab]")
    browser.execute_script("arguments[0].click()", tabs[1])
    assert [panel.is_displayed() for panel in panels] == [False, True, False, False]

    assert [e for e in browser.get_log("browser") if e["level"] in ("SEVERE", "WARNING")] == []
    asked = requests(browser)
    assert report.as_uri() in asked
    assert [url for url in asked if url.startswith(("http", "ws"))] == []

"""The report in headless Chromium: figures, folds, player, links, themes, widths, no network."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import WebDriverWait

from asp_env.data.recording import Recording
from asp_env.evaluation.report import write_report
from tests.builders import make_recording
from tests.evaluation.runs import (
    difference_rows,
    make_examples,
    make_rollout,
    metric_rows,
    write_run,
    write_tables,
)

METHODS = ["sampling + constant-velocity", "sampling + ffw-asp"]
MARKUP = "<script>document.title='x'<_script>"
"""A name that would run as a script if it were not escaped."""


def requests(browser: webdriver.Chrome) -> list[str]:
    """Addresses that the page requested."""
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    return [
        message["params"]["request"]["url"]
        for message in messages
        if message["method"] == "Network.requestWillBeSent"
    ]


def run(browser: webdriver.Chrome, script: str) -> Any:
    """The value of an expression in the page."""
    return browser.execute_script(f"return {script}")


def pixels(browser: webdriver.Chrome, number: int) -> str:
    """The present content of the player's first or second picture."""
    return run(browser, f"window.player.shown[{number}].canvas.toDataURL()")


def wait(browser: webdriver.Chrome, condition: str) -> None:
    """Waits until an expression in the page is true."""
    WebDriverWait(browser, 20).until(lambda b: b.execute_script(f"return Boolean({condition})"))


def resize(browser: webdriver.Chrome, width: int, theme: str) -> None:
    """Sets the width of the page and the system's theme."""
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    scheme = {"name": "prefers-color-scheme", "value": theme}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})


@pytest.fixture(scope="module")
def recording() -> Recording:
    return make_recording(duration_s=30.0)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory, recording: Recording) -> Path:
    """The report of a synthetic run with every section."""
    out = tmp_path_factory.mktemp("run")
    write_run(out, [recording])
    return write_report(
        out,
        title="Synthetic",
        maps={recording.name: recording.road_map},
        examples=make_examples([recording], count=1),
    )


def test_figures_are_drawn_and_can_be_saved(report: Path, browser: webdriver.Chrome) -> None:
    """Each figure is an SVG; a saved one is a file of its own in the light theme."""
    resize(browser, 1280, "dark")
    browser.get(report.as_uri())
    figures = browser.find_elements(By.CSS_SELECTOR, ".chart svg")
    assert len(figures) == len(browser.find_elements(By.CSS_SELECTOR, ".chart")) >= 8
    assert len(browser.find_elements(By.CSS_SELECTOR, "[data-key=ranking] .row .mark")) == 3
    pictures = browser.find_elements(By.CSS_SELECTOR, "#picture-grid canvas")
    drawn = {browser.execute_script("return arguments[0].toDataURL()", each) for each in pictures}
    assert len(drawn) == len(pictures) == 3
    saved = browser.execute_async_script(
        """const done = arguments[0], found = [];
        download = (blob, name) => blob.arrayBuffer().then((bytes) => {
          found.push([name, bytes.byteLength, new TextDecoder().decode(bytes.slice(0, 40000))]);
          if (found.length === 2) done(found);
        });
        document.querySelectorAll("[data-key=ranking] .save").forEach((button) => button.click());
        """
    )
    files = {name: (size, text) for name, size, text in saved}
    size, text = files["Score less that with constant-velocity.svg"]
    assert text.startswith("<svg ")
    assert ' xmlns="http://www.w3.org/2000/svg"' in text
    assert 'fill="rgb(27, 35, 48)"' in text  # the colour of text in the light theme
    assert "var(--" not in text
    assert size > 2000
    size, text = files["Score less that with constant-velocity.png"]
    assert text[1:4] == "PNG"
    assert size > 10_000
    choice = browser.find_element(By.CSS_SELECTOR, "[data-key=tags] select")
    assert choice.text.split("\n") == ["ffw-asp", "oracle", "blind"]
    drawn_text = "document.querySelector('[data-key=tags] svg').textContent"
    before = run(browser, drawn_text)
    choice.send_keys("o")
    assert run(browser, drawn_text) != before


def test_two_methods_play_side_by_side(report: Path, browser: webdriver.Chrome) -> None:
    """Both egos follow their track with another lag; they part by 0.5 m at one tick."""
    browser.get(report.as_uri())
    wait(browser, "window.player?.rollout")
    stages = browser.find_element(By.ID, "replay-stages")
    lists = browser.find_elements(By.CSS_SELECTOR, "a.open")
    browser.execute_script("arguments[0].click()", lists[0])
    wait(browser, "location.hash.includes('drive=')")
    assert run(browser, "window.player.shown.map((s) => s.rollout.driver)") == METHODS[::-1]
    ego = "({rollout}) => rollout.agents[0].poses.slice(0, 70)"
    first, second = (np.array(each) for each in run(browser, f"window.player.shown.map({ego})"))
    apart_cm = np.hypot(*(first - second)[:, :2].T)
    parted = int(np.flatnonzero(apart_cm > 50)[0])
    assert run(browser, "window.player.parted") == parted
    stages.send_keys("d")
    assert run(browser, "window.player.tick") == parted
    stages.send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_LEFT)
    assert run(browser, "window.player.tick") == parted + 1
    assert f"tick={parted + 1}" in browser.current_url
    assert pixels(browser, 0) != pixels(browser, 1)
    stages.send_keys(Keys.HOME)
    before = pixels(browser, 0), pixels(browser, 1)
    stages.send_keys(" ")
    wait(browser, "window.player.tick > 2")
    play = browser.find_element(By.ID, "replay-play")
    assert play.get_attribute("aria-label") == "Pause"
    stages.send_keys(" ")
    assert play.get_attribute("aria-label") == "Play"
    assert pixels(browser, 0) != before[0]
    assert pixels(browser, 1) != before[1]
    half = run(browser, "(window.player.rollout.ticks - 1) / 2 | 0")
    browser.execute_script(f"window.player.seek({half})")
    events = browser.find_elements(By.CSS_SELECTOR, ".stage .event")
    assert [each.text for each in events] == ["off-road", "off-road"]
    name = run(browser, "window.player.scenario.value")
    stages.send_keys("n")
    wait(browser, f"window.player.rollout.name !== '{name}'")
    commands = browser.find_element(By.ID, "replay-commands").text
    chosen = run(browser, "window.player.scenario.value")
    assert f"--scenarios '{report.parent}/scenarios.json#{chosen}'" in commands
    assert f"asp-env watch '{report.parent}/rollouts/sampling + ffw-asp/{chosen}.npz'" in commands
    assert [e for e in browser.get_log("browser") if e["level"] in ("SEVERE", "WARNING")] == []


def test_a_link_opens_an_episode_at_a_tick(report: Path, browser: webdriver.Chrome) -> None:
    """So does a change of the address; wrong names and ticks show what there is."""
    names = sorted(path.stem for path in (report.parent / "rollouts" / METHODS[0]).iterdir())
    link = f"#drive={names[1]}&a=sampling+%2B+constant-velocity&tick=12"
    browser.get(report.as_uri() + link)
    wait(browser, "window.player?.rollout && window.player.tick === 12")
    assert run(browser, "window.player.rollout.name") == names[1]
    assert run(browser, "window.player.shown.map((s) => s.rollout?.driver ?? null)") == [
        METHODS[0], None,
    ]  # fmt: skip
    browser.execute_script(f"location.hash = '#drive={names[2]}&tick=5'")
    wait(browser, f"window.player.rollout.name === '{names[2]}' && window.player.tick === 5")
    browser.execute_script("location.hash = '#drive=none&a=none&tick=x&condition=7'")
    wait(browser, f"window.player.rollout.name === '{names[0]}' && window.player.tick === 0")
    urls = requests(browser)
    assert [url for url in urls if url.startswith(("http", "ws"))] == []


def test_pictures_of_partings_lead_to_their_tick(report: Path, browser: webdriver.Chrome) -> None:
    """They show one gain and one loss; the button plays both drives from where they part."""
    resize(browser, 1280, "light")
    browser.get(report.as_uri())
    wait(browser, "window.player?.rollout")
    pictures = browser.find_elements(By.CSS_SELECTOR, ".chart[data-key=partings] svg")
    assert len(pictures) == 2
    spec = run(browser, "DATA.figures.partings[0]")
    picture = pictures[0]
    names = [each.text for each in picture.find_elements(By.CSS_SELECTOR, "text.name")]
    assert names == [f"{METHODS[1]}: score 0.900", f"{METHODS[0]}: score 0.400"]
    agents = picture.find_elements(By.CSS_SELECTOR, "rect.agent")
    assert len(agents) == len(spec["agents"])
    frame = run(browser, "document.querySelector('.chart[data-key=partings] .ground')"
                ".getBoundingClientRect().toJSON()")  # fmt: skip
    for ego in agents[-2:]:
        box = browser.execute_script("return arguments[0].getBoundingClientRect()", ego)
        assert frame["left"] < box["left"] < frame["right"]
        assert frame["top"] < box["top"] < frame["bottom"]
    button = browser.find_element(By.CSS_SELECTOR, ".chart[data-key=partings] button.open")
    button.send_keys(Keys.ENTER)
    wait(browser, f"window.player.tick === {spec['tick']}")
    assert run(browser, "window.player.parted") == spec["tick"]
    assert run(browser, "window.player.shown.map((s) => s.rollout.driver)") == METHODS[::-1]
    assert f"tick={spec['tick']}" in browser.current_url


def test_nothing_is_cut_off_at_any_width_in_both_themes(
    report: Path, browser: webdriver.Chrome
) -> None:
    """Columns that do not fit are folded; the switch of the theme prevails over the system."""
    hidden = (
        "document.querySelectorAll('#forecasts [role=tabpanel]:not([hidden]) td[hidden]').length"
    )
    grounds = set()
    folded = {}
    browser.get(report.as_uri())
    for width in (390, 1280, 2560):
        for theme in ("light", "dark"):
            resize(browser, width, theme)
            wait(browser, f"innerWidth === {width}")
            browser.execute_script(
                "document.querySelectorAll('details').forEach((d) => { d.open = true; })"
            )
            wait(browser, "[...document.querySelectorAll('.chart svg')].every((svg) => "
                 "svg.clientWidth <= svg.parentElement.clientWidth)")  # fmt: skip
            assert run(browser, "document.documentElement.scrollWidth") <= width
            wait(browser, "[...document.querySelectorAll('.folding')].every((box) => "
                 "box.scrollWidth <= box.clientWidth)")  # fmt: skip
            grounds.add(run(browser, "getComputedStyle(document.body).backgroundColor"))
        folded[width] = run(browser, hidden)
    assert len(grounds) == 2
    assert folded[390] > folded[1280] >= folded[2560]
    more = browser.find_element(By.CSS_SELECTOR, "#ranking .more:not([hidden]), .more")
    resize(browser, 390, "dark")
    wait(browser, "document.querySelector('.more').textContent.includes('more column')")
    browser.execute_script("arguments[0].click()", more)
    assert more.text == "Fewer columns"
    theme = browser.find_element(By.ID, "theme")
    dark = run(browser, "getComputedStyle(document.body).backgroundColor")
    theme.click()
    assert theme.text == "☀ light"
    assert run(browser, "getComputedStyle(document.body).backgroundColor") != dark
    tabs = browser.find_elements(By.CSS_SELECTOR, "#forecasts [role=tab]")
    panels = browser.find_elements(By.CSS_SELECTOR, "#forecasts [role=tabpanel]")
    browser.execute_script("arguments[0].focus()", tabs[0])
    tabs[0].send_keys(Keys.ARROW_RIGHT)
    assert [panel.is_displayed() for panel in panels][:3] == [False, True, False]


def test_names_from_data_stay_text_and_conditions_can_be_chosen(
    tmp_path: Path, recording: Recording, browser: webdriver.Chrome
) -> None:
    """Data, traffic, methods, scenarios and recordings have names that look like scripts."""
    rows: list[dict[str, object]] = []
    for traffic in ("idm", MARKUP):
        rows += [row | {"traffic": traffic, "data": MARKUP} for row in difference_rows()]
    rows += [row | {"data": MARKUP, "predictor": MARKUP} for row in metric_rows()[:8]]
    write_tables(tmp_path, rows)
    alert = "<script>alert(1)</script>"
    rollout = make_rollout(recording, track=0, start_tick=0, length=20, lag=0.2)
    scenario = dataclasses.replace(rollout.scenario, recording_name=alert, tags=(alert,))
    rollout = dataclasses.replace(rollout, scenario=scenario)
    folder = tmp_path / "rollouts" / MARKUP
    folder.mkdir(parents=True)
    rollout.save(folder / f"{MARKUP}-1-2.npz")
    road_map = dataclasses.replace(recording.road_map, name=alert)
    page = write_report(tmp_path, title=MARKUP, lead=MARKUP, maps={alert: road_map})
    assert MARKUP not in page.read_text()
    assert alert not in page.read_text()
    browser.get(page.as_uri())
    wait(browser, "window.player?.rollout")
    assert browser.title == MARKUP
    assert MARKUP in browser.find_element(By.ID, "replay-scenario").text
    assert alert in browser.find_element(By.ID, "replay-scenario").text
    assert MARKUP in browser.find_element(By.CSS_SELECTOR, ".stage .name").text
    assert len(browser.find_elements(By.TAG_NAME, "script")) == 2
    assert browser.find_element(By.ID, "ranking").is_displayed()
    buttons = browser.find_elements(By.CSS_SELECTOR, ".matrix button")
    assert MARKUP in buttons[1].text
    browser.execute_script("arguments[0].click()", buttons[1])
    assert not browser.find_element(By.ID, "ranking").is_displayed()
    assert browser.find_element(By.ID, "ranking-1").is_displayed()
    links = browser.find_elements(By.CSS_SELECTOR, "nav a")
    assert run(browser, "document.querySelector('nav a').hash") == "#ranking-1"
    assert links[0].text == "Ranking"
    assert run(browser, "document.querySelector('[data-key=ranking-1] svg').clientWidth") > 100

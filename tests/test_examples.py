"""The examples and the code in the documentation run."""

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from asp_env import Planner, registry
from asp_env.cli import main
from asp_env.data.classes import AgentClass
from examples import (
    own_predictor,
    own_view,
    picture,
    step_the_environment,
    traffic_that_reacts,
    train_a_policy,
)
from tests.builders import Drive
from tests.data.readers.test_own_readers import write_geo_trax
from tests.planning.situations import STEPS, approach, two_modes

EXAMPLES = sorted(Path(own_predictor.__file__).parent.glob("*.py"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_examples_have_at_most_80_lines(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 80


@pytest.mark.parametrize(
    "page",
    ["environment.md", "guides/own_planner.md", "guides/own_driver.md", "rl.md", "offline.md"],
)
def test_python_code_in_the_documentation_runs(page: str) -> None:
    """The blocks of a page run one after another, trainings at reduced length.

    Those that read a data set run in `tests.policies.test_demonstrations`.
    """
    names: dict[str, object] = {}
    for code in _python_blocks(page):
        if not any(name in code for name in ("minari", "d3rlpy", "load_steps")):
            exec(re.sub(r"\.learn\([\d_]+\)", ".learn(64)", code), names)


README = Path(own_predictor.__file__).parents[1] / "README.md"


def test_python_code_of_the_readme_runs() -> None:
    for code in re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL):
        exec(code, {})


def test_commands_of_the_readme_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those in blocks, and the first steps with the sample, with one scenario each."""
    text = README.read_text()
    commands = [
        line.removeprefix("asp-env ")
        for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
        for line in block.splitlines()
    ]
    commands += re.findall(r"`asp-env ([^`]*sample:[^`]*)`", text)
    assert len(commands) == 3
    monkeypatch.chdir(tmp_path)
    for command in commands:
        assert main(re.sub(r"--max-scenarios \d+", "--max-scenarios 1", command).split()) == 0
    output = capsys.readouterr().out
    assert "oracle" in output
    assert len(list(tmp_path.glob("*/report.html"))) == 3


def test_every_command_is_in_the_readme() -> None:
    """Every command has a line in its table, and every line of it a command."""
    named = set(re.findall(r"^\| `asp-env ([a-z]+(?: [a-z]+)?)", README.read_text(), re.MULTILINE))
    commands = set(registry.names("commands"))
    found = {name for name in commands if any(f"{word} ".startswith(f"{name} ") for word in named)}
    assert commands - found == {"demo", "rl demonstrations"}  # make demo, docs/rl.md


def test_the_planner_of_the_documentation() -> None:
    """At most 30 lines; it brakes by 3 m/s² from a probability of 20 % on."""
    code = _python_blocks("guides/own_planner.md")[0]
    assert len(code.splitlines()) <= 30
    names: dict[str, Any] = {}
    exec(code, names)
    planner = names["Cautious"]()
    assert isinstance(planner, Planner)
    walker = Drive(kind=AgentClass.PEDESTRIAN, start=(-40.0, -9.0, np.pi / 2, 0.0), appears_s=0.2)
    scene = approach(walker).world.scene()
    crossing = np.tile(np.array([-40.0, -1.75, 1.57, 0.0], dtype=np.float32), (STEPS, 1))
    rare, likely = (
        planner.plan(scene, two_modes(scene, crossing, probability)) for probability in (0.1, 0.3)
    )
    assert (likely.actions[0, :, 0] == -3.0).all()
    assert (rare.actions[0, :, 0] > 0.0).all()
    assert likely.states[0, -1, 3] == pytest.approx(10.0 - 3.0 * 0.2 * STEPS, abs=1e-3)


def test_the_reader_of_the_documentation(tmp_path: Path) -> None:
    """It finds the table, and a bus that drives at 10 m/s along +y beside a car that stands."""
    names: dict[str, Any] = {}
    exec(_python_blocks("readers.md")[0], names)
    (found,) = names["find_recordings"](write_geo_trax(tmp_path / "songdo").parent)
    measured = found.read_tables().measurements
    bus = measured.track == 1
    velocity = np.gradient(measured.positions[bus], measured.time_ms[bus] / 1000, axis=0)
    np.testing.assert_allclose(np.median(velocity, axis=0), (0.0, 10.0), atol=0.05)
    assert (measured.classes[bus] == AgentClass.BUS).all()
    assert (np.ptp(measured.positions[~bus], axis=0) == 0).all()


def _python_blocks(page: str) -> list[str]:
    text = (Path(own_predictor.__file__).parents[1] / "docs" / page).read_text()
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


def test_every_episode_of_random_actions_has_a_named_ending() -> None:
    lines = step_the_environment.main()
    assert len(lines) == 3
    assert all(line.split()[1].rstrip(",").isupper() for line in lines)


def test_the_planner_drives_with_an_own_predictor() -> None:
    assert own_predictor.main() > 0.2


def test_the_view_renders_the_sample() -> None:
    """Fifteen channels at full resolution for each target."""
    targets, *shape = own_view.main()
    assert targets > 0
    assert shape == [15, 360, 240]


def test_only_replayed_traffic_hits_a_braking_car(tmp_path: Path) -> None:
    hits = traffic_that_reacts.main(tmp_path / "highway", minutes=1 / 3)
    (replayed, scenarios), (reacting, same) = hits["replayed"], hits["reacting"]
    assert scenarios == same
    assert replayed > scenarios / 2
    assert reacting == 0


def test_the_picture_of_the_readme_is_drawn(tmp_path: Path) -> None:
    """A square frame of 720 pixels beside the raster at 2:3."""
    image = cv2.imread(str(picture.main(tmp_path / "scene.png")))
    assert image is not None
    assert image.shape == (720, 720 + 480, 3)


def test_ppo_learns_to_reach_the_goal() -> None:
    """Coasting along the route reaches it in 21 % of the scenarios."""
    assert train_a_policy.main(steps=30_000)["GOAL"] > 0.5

"""The examples and the code in the documentation of the environments run."""

import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from asp_env import ReplayEnv
from examples import (
    held_out,
    own_predictor,
    picture,
    step_the_environment,
    traffic_that_reacts,
    train_ppo_raster,
    train_ppo_vectors,
)

EXAMPLES = sorted(Path(own_predictor.__file__).parent.glob("*.py"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_examples_have_at_most_80_lines(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 80


@pytest.mark.parametrize("page", ["environment.md", "rl.md"])
def test_python_code_in_the_documentation_runs(page: str) -> None:
    """The blocks of a page run one after another, except the one that trains for long."""
    text = (Path(own_predictor.__file__).parents[1] / "docs" / page).read_text()
    names: dict[str, object] = {}
    for code in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        if "PPO" not in code:
            exec(code, names)


def test_every_episode_of_random_actions_has_a_named_ending() -> None:
    lines = step_the_environment.main()
    assert len(lines) == 3
    assert all(line.split()[1].rstrip(",").isupper() for line in lines)


def test_the_planner_drives_with_an_own_predictor() -> None:
    assert own_predictor.main() > 0.2


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


@pytest.mark.parametrize("example", [train_ppo_vectors, train_ppo_raster])
def test_ppo_trains_and_is_compared(example) -> None:
    """One rollout of 16 environments with its updates, then three scenarios of another place."""
    data = "sample:roundabout"
    scores = example.main("sample:intersection", (data,), steps=16, num_envs=16, count=3)
    assert set(scores) == {(name, data) for name in ("PPO", "zero actions", "random actions")}
    assert all(math.isfinite(mean) for means in scores.values() for mean in means.values())


def test_scores_are_means_over_evenly_spaced_scenarios() -> None:
    """The first, the 36th and the last of 72 scenarios, as in single environments."""
    env = ReplayEnv("sample:roundabout", observations=("state",))
    assert len(env.scenarios) == 72
    rewards, infos = np.zeros(3), []
    for row, scenario in enumerate((0, 35, 71)):
        env.reset(options={"scenario": scenario})
        over, info = False, {}
        while not over:
            _, reward, terminated, truncated, info = env.step(np.array([0.1, 0.0]))
            rewards[row] += reward
            over = terminated or truncated
        infos.append(info)
    assert held_out.score(
        lambda obs: np.tile([0.1, 0.0], (len(obs["state"]), 1)),
        "sample:roundabout",
        3,
        observations=("state",),
    ) == {
        "reward": pytest.approx(rewards.mean(), abs=1e-3),
        "progress": pytest.approx(np.mean([info["progress"] for info in infos]), abs=1e-3),
        "at fault": pytest.approx(np.mean([info["at_fault"] for info in infos]), abs=1e-3),
    }

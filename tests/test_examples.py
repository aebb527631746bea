"""The examples run, and stay short."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from asp_env.envs.replay import ReplayEnv
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
def test_an_example_has_at_most_80_lines(path: Path) -> None:
    """Long examples are not read."""
    assert len(path.read_text().splitlines()) <= 80


def test_random_actions_bring_every_episode_to_a_named_end() -> None:
    """Three seeds give three lines, each with a scenario, an ending and a reward."""
    lines = step_the_environment.main()
    assert len(lines) == 3
    assert all(line.split()[1].rstrip(",").isupper() for line in lines)


def test_an_own_predictor_drives_the_planner() -> None:
    """With forecasts of its own the planner gets somewhere."""
    assert own_predictor.main() > 0.2


def test_a_car_that_stops_is_hit_by_a_replay_alone(tmp_path: Path) -> None:
    """Of highway-env's vehicles those behind brake, as they do not in their recording."""
    hits = traffic_that_reacts.main(tmp_path / "highway", minutes=1 / 3)
    (replayed, scenarios), (reacting, same) = hits["replayed"], hits["reacting"]
    assert scenarios == same
    assert replayed > scenarios / 2
    assert reacting == 0


def test_the_picture_of_the_readme_can_be_drawn(tmp_path: Path) -> None:
    """720 pixels high: a square frame, and the raster at 2:3 beside it."""
    image = cv2.imread(str(picture.main(tmp_path / "scene.png")))
    assert image is not None
    assert image.shape == (720, 720 + 480, 3)


@pytest.mark.parametrize("example", [train_ppo_vectors, train_ppo_raster])
def test_ppo_trains_and_is_compared(example) -> None:
    """A rollout of 16 environments and its updates, then three scenarios of another place."""
    data = "sample:roundabout"
    scores = example.main("sample:intersection", (data,), steps=16, num_envs=16, count=3)
    assert set(scores) == {(name, data) for name in ("PPO", "zero actions", "random actions")}
    assert all(math.isfinite(mean) for means in scores.values() for mean in means.values())


def test_scores_are_means_over_evenly_chosen_scenarios() -> None:
    """Of 72 scenarios the first, the 36th and the last, as single environments drive them."""
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
        lambda seen: np.tile([0.1, 0.0], (len(seen["state"]), 1)),
        "sample:roundabout",
        3,
        observations=("state",),
    ) == {
        "reward": pytest.approx(rewards.mean(), abs=1e-3),
        "progress": pytest.approx(np.mean([info["progress"] for info in infos]), abs=1e-3),
        "at fault": pytest.approx(np.mean([info["at_fault"] for info in infos]), abs=1e-3),
    }

"""The examples run, and stay short."""

from pathlib import Path

import cv2
import pytest

from examples import own_predictor, picture, step_the_environment

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


def test_the_picture_of_the_readme_can_be_drawn(tmp_path: Path) -> None:
    """720 pixels high: a square frame, and the raster at 2:3 beside it."""
    image = cv2.imread(str(picture.main(tmp_path / "scene.png")))
    assert image is not None
    assert image.shape == (720, 720 + 480, 3)

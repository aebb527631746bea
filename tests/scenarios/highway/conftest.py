"""The roads of highway-env's environments."""

from pathlib import Path
from typing import Any

import pytest
from highway_env.envs import IntersectionEnv, RoundaboutEnv
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.vehicle.behavior import IDMVehicle

from tests.scenarios.highway.maps import Place, read_back


@pytest.fixture(autouse=True)
def _as_highway_env_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Restores highway-env's vehicle class as in a new process: its intersection changes it."""
    for name, value in (
        ("DISTANCE_WANTED", 5.0 + IDMVehicle.LENGTH),
        ("COMFORT_ACC_MAX", 3.0),
        ("COMFORT_ACC_MIN", -5.0),
    ):
        monkeypatch.setattr(IDMVehicle, name, value)


def _place(env: AbstractEnv, folder: Path) -> Place:
    road: Any = env.road  # annotated as None
    return Place(network=road.network, road_map=read_back(folder, road.network))


@pytest.fixture(scope="session")
def intersection(tmp_path_factory: pytest.TempPathFactory) -> Place:
    """Four arms with one lane in each direction, and all turns."""
    return _place(IntersectionEnv(), tmp_path_factory.mktemp("intersection"))


@pytest.fixture(scope="session")
def roundabout(tmp_path_factory: pytest.TempPathFactory) -> Place:
    """A ring of two lanes with four entries and four exits."""
    return _place(RoundaboutEnv(), tmp_path_factory.mktemp("roundabout"))


@pytest.fixture(scope="session", params=["intersection", "roundabout"])
def place(request: pytest.FixtureRequest) -> Place:
    """Each of the two."""
    return request.getfixturevalue(request.param)

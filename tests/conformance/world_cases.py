"""Episodes in every world, for the suite of worlds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import pytest

from asp_env.data.scenarios.scenario import Scenario, find_scenarios
from asp_env.sim.simulation import Simulation
from asp_env.sim.world import ReplayWorld, World, world_class
from tests.builders import make_recording
from tests.highway_folders import highway_data, highway_recordings, highway_scenarios
from tests.sim.worlds import DT_S, HISTORY, TRAFFICS, scenario, simulate

OWN_TRAFFICS = (
    *("own", "idm", "log-actions", "policy"),
    *("predictor:constant-turn-rate", "predictor:every=3:mode=sampled:oracle"),
    "default=own,3=policy,20=idm,18=log-actions,4=predictor:constant-velocity",
)
"""Every driver of a self-driving world without a network, and a table of several."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldCase:
    """Four episodes of different lengths with different numbers of agents."""

    data: str | None
    """The scheme that the world is registered under, None for `ReplayWorld`."""
    world_class: Callable[[], type[World]]
    recordings: Callable[[], Sequence[Any]]
    scenarios: Callable[[], list[Scenario]]
    found: Callable[[], list[Scenario]]
    """Scenarios found in the recordings, or some of them."""
    traffics: tuple[str, ...]
    steps: int
    """Ticks after which two of the four episodes are over."""

    def simulate(
        self,
        scenarios: Sequence[Scenario] | Scenario,
        traffic: str | None = None,
        history: int = HISTORY,
    ) -> Simulation:
        """Episodes that have just started, by default with all agents left to the world."""
        name = self.traffics[0] if traffic is None else traffic
        return simulate(self.recordings(), scenarios, name, self.world_class(), history)


@cache
def _recordings() -> list[Any]:
    return [
        make_recording(),
        make_recording(name="01", seed=1, duration_s=16.0),
        make_recording(name="02", seed=2, duration_s=24.0),
    ]


def _replay() -> WorldCase:
    return WorldCase(
        data=None,
        world_class=lambda: ReplayWorld,
        recordings=_recordings,
        scenarios=lambda: [
            scenario(1, start=15, length=24),
            scenario(3, start=20, length=40, recording=1),
            scenario(7, start=36, length=20),
            scenario(2, start=30, length=70, recording=2),
        ],
        found=lambda: list(
            find_scenarios(_recordings(), source="made-up", dt_s=DT_S, history=HISTORY)
        ),
        traffics=TRAFFICS,
        steps=26,
    )


def _highway(site: str, scenarios: Sequence[Scenario], traffics: tuple[str, ...]) -> WorldCase:
    return WorldCase(
        data="highway",
        world_class=lambda: world_class(highway_data(site)),
        recordings=lambda: highway_recordings(site),
        scenarios=lambda: [*scenarios],
        found=lambda: list(highway_scenarios(site))[
            :: len(highway_scenarios(site)) // 5
        ],  # stepping all of them takes long
        traffics=traffics,
        steps=14,
    )


WORLD_CASES = {
    "replay": _replay(),
    "highway intersection": _highway(
        "intersection",
        [
            scenario(18, start=150, length=11),  # turns left and gives way
            scenario(2, start=70, length=20, recording=1),  # among crashes
            scenario(13, start=70, length=12),
            scenario(16, start=125, length=40, recording=1),
        ],
        (OWN_TRAFFICS[0], OWN_TRAFFICS[-1]),
    ),
    "highway roundabout": _highway(
        "roundabout",
        [
            scenario(7, start=115, length=9),
            scenario(4, start=28, length=20, recording=1),  # during a lane change, then a crash
            scenario(2, start=20, length=12),
            scenario(9, start=130, length=40, recording=1),
        ],
        OWN_TRAFFICS,
    ),
}

every_world = pytest.mark.parametrize("case", WORLD_CASES.values(), ids=list(WORLD_CASES))
every_traffic = pytest.mark.parametrize(
    ("case", "traffic"),
    [
        pytest.param(case, traffic, id=f"{name}-{traffic}")
        for name, case in WORLD_CASES.items()
        for traffic in case.traffics
    ],
)

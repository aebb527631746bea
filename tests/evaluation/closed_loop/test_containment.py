"""Faulty predictors and planners are filled in for, and the episodes concerned are marked."""

import dataclasses
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from asp_env.data.predictor import Forecast, Predictor, load_predictor
from asp_env.data.scenarios.scenario import find_scenarios
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.data.source import Recordings, open_data
from asp_env.data.split import TrainedOn
from asp_env.evaluation.closed_loop.episodes import DrivenEpisodes, EpisodeSettings, drive_episodes
from asp_env.metrics.driving.rules import PDMS
from asp_env.metrics.driving.scores import driving_metrics
from asp_env.planning.planner import Plan, Planner, load_planner
from predictors.physical import ConstantVelocity
from tests.crossing_files import write_crossing
from tests.sim.worlds import DT_S, HISTORY, car

EPISODES = 3
Edit = Callable[[Forecast, Scene], object]


@dataclass
class Faulty:
    """Constant velocity, edited before it is returned."""

    edit: Edit
    horizon: int = 15
    privileged: bool = False
    name: str = "faulty"
    dt_s: float = DT_S
    history: int = 0
    trained_on: TrainedOn | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        del future
        made = ConstantVelocity(horizon=self.horizon, dt_s=self.dt_s).predict(scene)
        return self.edit(made, scene)  # pyright: ignore[reportReturnType]


@dataclass
class FaultyPlanner:
    """Another planner, whose plans are edited before they are returned."""

    inner: Planner
    edit: Callable[[Plan, Scene], object]
    name: str = "faulty"
    privileged: bool = False
    uses_forecasts: bool = True

    def plan(self, scene: Scene, forecast: Forecast) -> Plan:
        return self.edit(self.inner.plan(scene, forecast), scene)  # pyright: ignore[reportReturnType]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Recordings:
    folder: Path = tmp_path_factory.mktemp("crossing")
    write_crossing(folder, drives=((car(-95, 8), car(-60, 8), car(-30, 8), car(10, 7)),))
    return open_data(str(folder))


def _drive(
    recordings: Recordings,
    predictor: Predictor,
    planner: Planner | None = None,
    *,
    contain: bool = True,
    budget_ms: float | None = None,
) -> DrivenEpisodes:
    found = list(find_scenarios(recordings, source="", dt_s=DT_S, history=HISTORY))
    return drive_episodes(
        recordings,
        [found[i % len(found)] for i in range(EPISODES)],
        planner or load_planner("contingency"),
        predictor,
        EpisodeSettings(
            rules=PDMS, traffic="log", horizon=15, history=HISTORY, dt_s=DT_S,
            contain_faults=contain, budget_ms=budget_ms,
        ),
    )  # fmt: skip


def _states(driven: DrivenEpisodes) -> list[np.ndarray]:
    return [rollout.states for rollout in driven.rollouts]


def _raise_for(episode: int) -> Edit:
    """Raises whenever the targets of an episode are among those that are asked for."""

    def edit(forecast: Forecast, scene: Scene) -> Forecast:
        if (scene.targets[:, 0] == episode).any():
            raise ZeroDivisionError("of another package")
        return forecast

    return edit


def _nan_in(episode: int) -> Edit:
    def edit(forecast: Forecast, scene: Scene) -> Forecast:
        states = forecast.states.copy()
        states[scene.targets[:, 0] == episode, :, 3] = np.nan
        return dataclasses.replace(forecast, states=states)

    return edit


def _wrong_ids(forecast: Forecast, scene: Scene) -> Forecast:
    del scene
    return dataclasses.replace(forecast, ids=forecast.ids + 1)


def _short(forecast: Forecast, scene: Scene) -> Forecast:
    del scene
    return dataclasses.replace(
        forecast, states=forecast.states[:, :, :-1], actions=forecast.actions[:, :, :-1]
    )


def _objects(forecast: Forecast, scene: Scene) -> Forecast:
    del scene
    forecast = dataclasses.replace(forecast)
    object.__setattr__(forecast, "valid", forecast.valid.astype(object))
    return forecast


def _improbable(forecast: Forecast, scene: Scene) -> Forecast:
    del scene
    return dataclasses.replace(forecast, log_probs=forecast.log_probs + 1)


def _slow(forecast: Forecast, scene: Scene) -> Forecast:
    del scene
    time.sleep(0.02)
    return forecast


@pytest.mark.parametrize(
    ("edit", "cause", "episodes"),
    [
        (_raise_for(1), "raised", [1]),
        (_nan_in(2), "not finite", [2]),
        (_improbable, "not finite", [0, 1, 2]),
        (_wrong_ids, "wrong ids", [0, 1, 2]),
        (_short, "wrong shapes", [0, 1, 2]),
        (_objects, "wrong shapes", [0, 1, 2]),
        (lambda *_: None, "wrong shapes", [0, 1, 2]),
    ],
)
def test_faulty_forecasts_are_filled_in_by_constant_velocity(
    recordings: Recordings, edit: Edit, cause: str, episodes: list[int]
) -> None:
    """The predictor is constant velocity, and so is what is filled in: all drives are the same."""
    driven = _drive(recordings, Faulty(edit))
    expected = _drive(recordings, ConstantVelocity(horizon=15, dt_s=DT_S), contain=False)
    assert [i for i, fault in enumerate(driven.faults) if fault] == episodes
    assert {fault.cause for fault in driven.faults if fault} == {cause}
    assert all(fault.tick == 0 for fault in driven.faults if fault)
    for found, wanted in zip(_states(driven), _states(expected), strict=True):
        np.testing.assert_array_equal(found, wanted)
    assert all(np.isfinite(m.value).all() for m in driving_metrics(driven.drives, PDMS).values())


def test_sound_methods_drive_the_same_with_containment(recordings: Recordings) -> None:
    for name in ("oracle", "noisy-oracle:2"):
        predictor = load_predictor(name, horizon=15, dt_s=DT_S)
        contained = _drive(recordings, predictor)
        assert contained.faults == (None,) * EPISODES
        for found, wanted in zip(
            contained.rollouts, _drive(recordings, predictor, contain=False).rollouts, strict=True
        ):
            np.testing.assert_array_equal(found.states, wanted.states)
            np.testing.assert_array_equal(found.forecast_states, wanted.forecast_states)
            np.testing.assert_array_equal(found.plans, wanted.plans)


def test_slow_predictors_are_over_budget_only_with_one(recordings: Recordings) -> None:
    """20 ms for three episodes are over a budget of 1 ms each."""
    driven = _drive(recordings, Faulty(_slow), budget_ms=1.0)
    assert {fault and fault.cause for fault in driven.faults} == {"over budget"}
    assert _drive(recordings, Faulty(_slow)).faults == (None,) * EPISODES


def _raise_alone(plan: Plan, scene: Scene) -> Plan:
    if len(scene.tick) == EPISODES or scene.tick[0] % 2:
        raise RuntimeError("of another package")
    return plan


def _nan_plan(plan: Plan, scene: Scene) -> Plan:
    del scene
    return Plan(actions=plan.actions * np.nan, states=plan.states)


@pytest.mark.parametrize(
    ("edit", "cause"),
    [
        (_raise_alone, "raised"),
        (_nan_plan, "not finite"),
        (lambda plan, _: plan.actions, "wrong shapes"),
    ],
)
def test_faulty_plans_are_filled_in_by_zero_actions(
    recordings: Recordings, edit: Callable[[Plan, Scene], object], cause: str
) -> None:
    planner = FaultyPlanner(load_planner("contingency"), edit)
    driven = _drive(recordings, ConstantVelocity(horizon=15, dt_s=DT_S), planner)
    assert {fault and (fault.socket, fault.cause) for fault in driven.faults} == {
        ("planner", cause)
    }
    if cause != "raised":  # always faulty: the egos coast, at the speed that they have
        for rollout in driven.rollouts:
            np.testing.assert_allclose(rollout.states[:, 0, 3], rollout.states[0, 0, 3], rtol=1e-6)


def test_without_containment_faults_are_raised(recordings: Recordings) -> None:
    with pytest.raises(ZeroDivisionError):
        _drive(recordings, Faulty(_raise_for(1)), contain=False)

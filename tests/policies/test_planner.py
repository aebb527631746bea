"""A trained policy as a planner."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from asp_env.data.predictor import load_predictor
from asp_env.data.scene import Scene
from asp_env.dynamics import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD, denormalize_actions
from asp_env.errors import AspEnvError
from asp_env.evaluation.closed_loop.episodes import forecast_for_planner
from asp_env.planning.planner import TrainedPlanner, load_planner
from asp_env.sim.action_types import to_physical
from policies.environments import make_environments
from policies.planner import PolicyPlanner
from policies.runs import load_policy
from tests.builders import make_recording
from tests.planning.situations import STEPS, straight_ahead
from tests.sim.worlds import drive, scenario, simulate


def test_the_planner_acts_as_the_policy_in_its_environment(run: Path) -> None:
    trained, planner = load_policy(run), load_planner(f"sb3:{run}")
    envs = make_environments(trained.settings.environment, "sample:roundabout", 5, scenarios="")
    envs.seed(0)
    observations = envs.reset()
    assert isinstance(observations, dict)
    replay = envs.get_attr("unwrapped", 0)[0]
    predictor = load_predictor("constant-velocity", horizon=15, dt_s=0.2)
    for _ in range(4):
        scene = replay.scene()
        plan = planner.plan(scene, forecast_for_planner(predictor, scene, None, 15))
        actions = trained.act(observations)
        episodes = replay._episodes
        expected = to_physical("route", actions, *episodes._action_context())
        np.testing.assert_allclose(plan.actions[:, 0], expected, atol=1e-5)
        observations, _, _, _ = envs.step(actions)
        assert isinstance(observations, dict)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Four situations in two recordings."""
    egos = [scenario(1), scenario(2, start=40), scenario(3, start=25), scenario(4, recording=1)]
    simulation = simulate([make_recording(), make_recording(name="01", seed=3)], egos)
    drive(simulation, [(0.5, 0.01)] * 4)
    return simulation.world.scene()


def test_plans_are_finite_and_within_limits(run: Path, scene: Scene) -> None:
    plan = load_planner(f"sb3:{run}").plan(scene, straight_ahead(scene))
    assert plan.actions.shape == (4, STEPS, 2)
    assert np.isfinite(plan.states).all()
    assert np.abs(plan.actions[..., 0]).max() <= MAX_ACCELERATION_MPS2 + 1e-6
    assert np.abs(plan.actions[..., 1]).max() <= MAX_STEERING_RAD + 1e-6


def test_situations_are_independent_up_to_rounding(run: Path, scene: Scene) -> None:
    planner = load_planner(f"sb3:{run}")
    together = planner.plan(scene, straight_ahead(scene))
    for b in range(4):
        alone = scene.situation(b)
        single = planner.plan(alone, straight_ahead(alone))
        np.testing.assert_allclose(single.actions[0], together.actions[b], atol=1e-5)


def test_arguments_are_not_modified(run: Path, scene: Scene) -> None:
    forecast = straight_ahead(scene)
    before = scene.states.copy(), forecast.states.copy()
    load_planner(f"sb3:{run}").plan(scene, forecast)
    np.testing.assert_array_equal(scene.states, before[0])
    np.testing.assert_array_equal(forecast.states, before[1])


def test_plans_without_other_agents(run: Path, scene: Scene) -> None:
    alone = scene.with_targets(np.zeros((0, 2), dtype=np.int64))
    valid = scene.valid.copy()
    valid[:, 1:] = False
    empty = dataclasses.replace(alone, valid=valid)
    plan = load_planner(f"sb3:{run}").plan(empty, straight_ahead(empty))
    assert np.isfinite(plan.states).all()


def test_forecasts_matter(run: Path, scene: Scene) -> None:
    forecast = straight_ahead(scene)
    moved = dataclasses.replace(forecast, states=forecast.states + np.float32(3.0))
    planner = load_planner(f"sb3:{run}")
    first, second = (planner.plan(scene, each) for each in (forecast, moved))
    assert not np.allclose(first.actions, second.actions, atol=1e-6)


def test_a_scene_without_a_route_is_refused(run: Path, scene: Scene) -> None:
    blank = dataclasses.replace(scene, route_valid=np.zeros_like(scene.route_valid))
    with pytest.raises(AspEnvError, match="route"):
        load_planner(f"sb3:{run}").plan(blank, straight_ahead(blank))


def test_checks(run: Path) -> None:
    planner = load_planner(f"sb3:{run}")
    assert isinstance(planner, TrainedPlanner)
    assert planner.uses_forecasts
    assert not planner.privileged
    with pytest.raises(AspEnvError, match="trained with predictor constant-velocity"):
        planner.check_predictor(load_predictor("constant-turn-rate", horizon=15, dt_s=0.2))


def test_names(tmp_path: Path) -> None:
    with pytest.raises(AspEnvError, match="sb3:RUN"):
        load_planner("sb3")
    with pytest.raises(AspEnvError, match="no run of a policy"):
        load_planner(f"sb3:{tmp_path}")
    with pytest.raises(AspEnvError, match="idm takes no argument"):
        load_planner("idm:fast")


def test_another_time_step(run: Path) -> None:
    trained = load_policy(run)
    envs = make_environments(trained.settings.environment, "sample:roundabout", 1, scenarios="")
    envs.reset()
    scene = envs.get_attr("unwrapped", 0)[0].scene()
    other = dataclasses.replace(scene, dt_s=0.1)
    predictor = load_predictor("constant-velocity", horizon=15, dt_s=0.1)
    with pytest.raises(AspEnvError, match="time step"):
        PolicyPlanner(trained, run).plan(other, forecast_for_planner(predictor, other, None, 15))


def test_denormalized_direct_actions() -> None:
    actions = np.array([[0.5, -1.0]], dtype=np.float32)
    zeros = np.zeros((1, 2), dtype=np.float32)
    physical = to_physical("direct", actions, zeros, np.zeros(1), 0.2)
    np.testing.assert_array_equal(physical, denormalize_actions(actions))

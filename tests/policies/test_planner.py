"""A trained policy as a planner."""

from pathlib import Path

import numpy as np
import pytest

from asp_env.data.predictor import load_predictor
from asp_env.dynamics import denormalize_actions
from asp_env.errors import AspEnvError
from asp_env.evaluation.closed_loop.episodes import forecast_for_planner
from asp_env.planning.planner import TrainedPlanner, load_planner
from asp_env.sim.action_types import to_physical
from policies.environments import make_environments
from policies.planner import PolicyPlanner
from policies.runs import load_policy


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
    import dataclasses

    other = dataclasses.replace(scene, dt_s=0.1)
    predictor = load_predictor("constant-velocity", horizon=15, dt_s=0.1)
    with pytest.raises(AspEnvError, match="time step"):
        PolicyPlanner(trained, run).plan(other, forecast_for_planner(predictor, other, None, 15))


def test_denormalized_direct_actions() -> None:
    actions = np.array([[0.5, -1.0]], dtype=np.float32)
    zeros = np.zeros((1, 2), dtype=np.float32)
    physical = to_physical("direct", actions, zeros, np.zeros(1), 0.2)
    np.testing.assert_array_equal(physical, denormalize_actions(actions))

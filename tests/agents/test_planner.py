"""A trained agent as a planner."""

from pathlib import Path

import numpy as np
import pytest

from agents.environments import make_environments
from agents.planner import AgentPlanner
from agents.runs import load_agent
from asp_env.data.predictor import load_predictor
from asp_env.dynamics import denormalize_actions
from asp_env.errors import AspEnvError
from asp_env.evaluation.closed_loop.episodes import forecast_for_planner
from asp_env.planning.planner import TrainedPlanner, load_planner
from asp_env.sim.action_types import to_physical


def test_the_planner_acts_as_the_agent_in_its_environment(run: Path) -> None:
    agent, planner = load_agent(run), load_planner(f"sb3:{run}")
    envs = make_environments(agent.settings.environment, "sample:roundabout", 5, scenarios="")
    envs.seed(0)
    observations = envs.reset()
    assert isinstance(observations, dict)
    replay = envs.get_attr("unwrapped", 0)[0]
    predictor = load_predictor("constant-velocity", horizon=15, dt_s=0.2)
    for _ in range(4):
        scene = replay.scene()
        plan = planner.plan(scene, forecast_for_planner(predictor, scene, None, 15))
        actions = agent.act(observations)
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
    with pytest.raises(AspEnvError, match="no run of an agent"):
        load_planner(f"sb3:{tmp_path}")
    with pytest.raises(AspEnvError, match="idm takes no argument"):
        load_planner("idm:fast")


def test_another_time_step(run: Path) -> None:
    agent = load_agent(run)
    envs = make_environments(agent.settings.environment, "sample:roundabout", 1, scenarios="")
    envs.reset()
    scene = envs.get_attr("unwrapped", 0)[0].scene()
    import dataclasses

    other = dataclasses.replace(scene, dt_s=0.1)
    predictor = load_predictor("constant-velocity", horizon=15, dt_s=0.1)
    with pytest.raises(AspEnvError, match="time step"):
        AgentPlanner(agent, run).plan(other, forecast_for_planner(predictor, other, None, 15))


def test_denormalized_direct_actions() -> None:
    actions = np.array([[0.5, -1.0]], dtype=np.float32)
    zeros = np.zeros((1, 2), dtype=np.float32)
    physical = to_physical("direct", actions, zeros, np.zeros(1), 0.2)
    np.testing.assert_array_equal(physical, denormalize_actions(actions))

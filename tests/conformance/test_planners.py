"""Laws of every registered planner that needs no argument.

Trained policies (`sb3:RUN`) are tested in `tests.policies.test_planner`: the bits of a network
depend on the size of its batch, and its plans on the probabilities of modes.
"""

import dataclasses

import numpy as np
import pytest

from asp_env import registry
from asp_env.data.predictor import Forecast
from asp_env.data.scene import Scene
from asp_env.data.snippets import gather_scene, index_snippets
from asp_env.dynamics import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD, rollout
from asp_env.errors import AspEnvError
from asp_env.planning.planner import CandidatePlanner, Plan, Planner, load_planner
from tests.builders import make_recording
from tests.planning.situations import STEPS, straight_ahead
from tests.sim.worlds import drive, scenario, simulate

NAMES = [
    name
    for name in registry.names("planners")
    if not hasattr(registry.find("planners", name), "from_name")
]
PLANNERS = [name for name in NAMES if not load_planner(name).privileged]
WITH_CANDIDATES = [name for name in PLANNERS if isinstance(load_planner(name), CandidatePlanner)]
EGOS = [scenario(1), scenario(2, start=40), scenario(3, start=25), scenario(4, recording=1)]


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Four situations in two recordings, a few steps after their start."""
    simulation = simulate([make_recording(), make_recording(name="01", seed=3)], EGOS)
    drive(simulation, [(0.5, 0.01)] * 4)
    return simulation.world.scene()


def _situation(scene: Scene, b: int) -> Scene:
    """One situation on its own, without the padding of the others."""
    agents = int(np.flatnonzero(scene.valid[b].any(axis=-1)).max()) + 1
    points = int(scene.route_valid[b].sum())
    targets = scene.targets[scene.targets[:, 0] == b] * [0, 1]
    return dataclasses.replace(
        scene,
        **{
            name: getattr(scene, name)[b : b + 1, :agents]
            for name in ("states", "actions", "valid", "sizes", "classes", "ids")
        },
        tick=scene.tick[b : b + 1],
        targets=targets,
        route=scene.route[b : b + 1, :points],
        route_valid=scene.route_valid[b : b + 1, :points],
        map_index=scene.map_index[b : b + 1],
    )


def _equal(first: Plan, second: Plan) -> bool:
    same_actions = first.actions.tobytes() == second.actions.tobytes()
    return same_actions and first.states.tobytes() == second.states.tobytes()


@pytest.mark.parametrize("name", NAMES)
def test_is_a_planner(name):
    planner = load_planner(name)
    assert isinstance(planner, Planner)
    assert planner.name == name
    assert isinstance(planner.privileged, bool)
    assert isinstance(planner.uses_forecasts, bool)


@pytest.mark.parametrize("name", set(NAMES) - set(PLANNERS))
def test_privileged_planners_refuse_to_plan(name, scene):
    with pytest.raises(AspEnvError, match="does not plan"):
        load_planner(name).plan(scene, straight_ahead(scene))


@pytest.mark.parametrize("name", PLANNERS)
def test_plans_are_finite_and_within_limits(name, scene):
    """A plan for every situation over the forecast's ticks; ±5 m/s² and ±π/4."""
    plan = load_planner(name).plan(scene, straight_ahead(scene))
    assert plan.actions.shape == (4, STEPS, 2)
    assert plan.states.shape == (4, STEPS, 4)
    assert np.isfinite(plan.actions).all()
    assert np.isfinite(plan.states).all()
    assert np.abs(plan.actions[..., 0]).max() <= MAX_ACCELERATION_MPS2 + 1e-6
    assert np.abs(plan.actions[..., 1]).max() <= MAX_STEERING_RAD + 1e-6


@pytest.mark.parametrize("name", PLANNERS)
def test_states_are_the_rollout_of_the_actions(name, scene):
    """Under the bicycle model, to 1 mm."""
    plan = load_planner(name).plan(scene, straight_ahead(scene))
    states = rollout(scene.states[:, 0, -1], plan.actions, scene.sizes[:, 0, 0], scene.dt_s)
    assert plan.states[..., :2] == pytest.approx(states[..., :2], abs=1e-3)
    assert plan.states[..., 3] == pytest.approx(states[..., 3], abs=1e-3)


@pytest.mark.parametrize("name", PLANNERS)
def test_situations_are_independent(name, scene):
    """Four in a batch are bit for bit the same as each on its own, for a used and a new planner."""
    planner = load_planner(name)
    together = planner.plan(scene, straight_ahead(scene))
    for b in range(len(scene.tick)):
        alone = _situation(scene, b)
        for each in (planner, load_planner(name)):
            single = each.plan(alone, straight_ahead(alone))
            assert single.actions.tobytes() == together.actions[b : b + 1].tobytes()
            assert single.states.tobytes() == together.states[b : b + 1].tobytes()
    assert _equal(planner.plan(scene, straight_ahead(scene)), together)


@pytest.mark.parametrize("name", PLANNERS)
def test_the_order_of_slots_does_not_matter(name, scene):
    """Other agents in reverse order, and forecasts likewise, yield the same plan."""
    agents = scene.ids.shape[1]
    order = np.concatenate([[0], np.arange(agents - 1, 0, -1)])
    slots = np.argsort(order)
    reordered = dataclasses.replace(
        scene,
        **{
            field: getattr(scene, field)[:, order]
            for field in ("states", "actions", "valid", "sizes", "classes", "ids")
        },
        targets=np.stack([scene.targets[:, 0], slots[scene.targets[:, 1]]], axis=-1)[::-1],
    )
    planner = load_planner(name)
    first, second = (planner.plan(each, straight_ahead(each)) for each in (scene, reordered))
    assert second.actions == pytest.approx(first.actions, abs=1e-6)
    assert second.states == pytest.approx(first.states, abs=1e-4)


@pytest.mark.parametrize("name", PLANNERS)
def test_rows_of_absent_agents_do_not_matter(name, scene):
    """Their content does not change the bits of the plan."""
    absent = ~scene.valid[..., -1]
    assert absent.any()
    states, sizes = scene.states.copy(), scene.sizes.copy()
    states[absent] = scene.states[0, 0]
    sizes[absent] = (4.5, 1.8)
    filled = dataclasses.replace(scene, states=states, sizes=sizes)
    planner = load_planner(name)
    assert _equal(
        planner.plan(filled, straight_ahead(filled)), planner.plan(scene, straight_ahead(scene))
    )


@pytest.mark.parametrize("name", PLANNERS)
def test_arguments_are_not_modified(name, scene):
    forecast = straight_ahead(scene)
    before = _bits(scene) | _bits(forecast)
    load_planner(name).plan(scene, forecast)
    assert _bits(scene) | _bits(forecast) == before


@pytest.mark.parametrize("name", PLANNERS)
def test_uses_forecasts_is_correct(name, scene):
    """With all agents forecast 12 m ahead of the ego, only planners that use forecasts differ."""
    forecast = straight_ahead(scene)
    blocking = dataclasses.replace(forecast, states=forecast.states.copy())
    ahead = scene.states[scene.targets[:, 0], 0, -1]
    ahead[:, :2] += 12 * np.stack([np.cos(ahead[:, 2]), np.sin(ahead[:, 2])], axis=-1)
    blocking.states[:] = ahead[:, None, None]
    planner = load_planner(name)
    same = _equal(planner.plan(scene, forecast), planner.plan(scene, blocking))
    assert same == (not planner.uses_forecasts)


@pytest.mark.parametrize("name", WITH_CANDIDATES)
def test_the_first_of_the_cheapest_candidates_is_executed(name, scene):
    """Bit for bit; all continuations of a candidate have its first action and its first state."""
    planner = load_planner(name)
    assert isinstance(planner, CandidatePlanner)
    forecast = straight_ahead(scene)
    candidates = planner.candidates(scene, STEPS)
    costs = planner.costs(scene, forecast, candidates)
    assert costs.shape == candidates.states.shape[:2]
    assert np.isfinite(costs).all()
    rows = np.arange(len(costs)), costs.argmin(axis=1)
    plan = planner.plan(scene, forecast)
    actions = candidates.actions[rows][..., 0, :].reshape(len(costs), -1, 2)
    states = candidates.states[rows][..., 0, :].reshape(len(costs), -1, 4)
    assert (actions == plan.actions[:, :1]).all()
    assert (states == plan.states[:, :1]).all()


@pytest.mark.parametrize("name", PLANNERS)
def test_equal_modes_are_one_mode(name, scene):
    """Four equally probable modes that are alike yield the plan of one."""
    planner = load_planner(name)
    one, four = (planner.plan(scene, straight_ahead(scene, modes=modes)) for modes in (1, 4))
    assert four.actions == pytest.approx(one.actions, abs=1e-5)
    assert four.states == pytest.approx(one.states, abs=1e-4)


@pytest.mark.parametrize("name", PLANNERS)
def test_plans_are_as_long_as_the_forecast(name, scene):
    """Horizons of 2 and 7 ticks."""
    whole = straight_ahead(scene)
    for steps in (2, 7):
        forecast = dataclasses.replace(
            whole, states=whole.states[:, :, :steps], actions=whole.actions[:, :, :steps]
        )
        plan = load_planner(name).plan(scene, forecast)
        assert plan.actions.shape == (4, steps, 2)
        assert np.isfinite(plan.states).all()


@pytest.mark.parametrize("name", PLANNERS)
def test_a_scene_without_a_route_is_refused(name):
    """Scenes of snippets have no routes."""
    recordings = [make_recording()]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    scene = gather_scene(recordings, index.select(np.arange(3)))
    with pytest.raises(AspEnvError, match="route"):
        load_planner(name).plan(scene, straight_ahead(scene))


@pytest.mark.parametrize("name", PLANNERS)
def test_plans_without_other_agents(name, scene):
    """The scene has no targets, the forecast no rows."""
    alone = scene.with_targets(np.zeros((0, 2), dtype=np.int64))
    valid = scene.valid.copy()
    valid[:, 1:] = False
    empty = dataclasses.replace(alone, valid=valid)
    plan = load_planner(name).plan(empty, straight_ahead(empty))
    assert np.isfinite(plan.states).all()


def test_an_unknown_planner_is_refused():
    with pytest.raises(AspEnvError, match=r"unknown planner 'sampeling' \(did you mean 'sampling'"):
        load_planner("sampeling")


def _bits(value: Scene | Forecast) -> dict[str, bytes]:
    names = [field.name for field in dataclasses.fields(value)]
    arrays = {name: getattr(value, name) for name in names}
    return {
        f"{type(value).__name__}.{name}": array.tobytes()
        for name, array in arrays.items()
        if isinstance(array, np.ndarray)
    }

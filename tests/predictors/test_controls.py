"""Controls, against numbers derived by hand and the forecasts that they lie between."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.classes import AgentClass
from asp_env.data.predictor import Forecast, load_predictor, needs_simulation
from asp_env.data.scene import Scene
from asp_env.data.snippets import (
    Future,
    SnippetIndex,
    gather_future,
    gather_scene,
    index_snippets,
)
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError
from asp_env.geometry import wrap_angle
from asp_env.sim.traffic.assignment import make_traffic
from predictors.controls import persistent_noise
from tests.builders import Drive, make_recording
from tests.real_data import real_data

EAST = Drive(kind=AgentClass.CAR, start=(-50.0, 2.0, 0.0, 10.0))
BRAKING = Drive(
    kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, 16.0), phases=((3.0, 0.0, 0.0), (5.0, -2.0, 0.0))
)
NORTH = Drive(kind=AgentClass.CAR, start=(5.0, -20.0, math.pi / 2, 4.0))
STANDING = Drive(kind=AgentClass.CAR, start=(20.0, 8.0, math.pi, 0.0))
PINNED = (-1.231454937690794, 0.027050875127566498)
"""Noise of track 5 at tick 0."""
WALKER = Drive(kind=AgentClass.PEDESTRIAN, start=(0.0, 5.0, 0.0, 1.0))


def scene_at_3_s(*drives: Drive) -> tuple[Scene, Future]:
    """The scene of all agents 3 s after the start, each a target, and their next 3 s."""
    recordings = [make_recording(drives=drives, duration_s=8.0)]
    index = SnippetIndex(
        recording=np.zeros(len(drives), dtype=np.int64),
        track=np.arange(len(drives)),
        tick=np.full(len(drives), 15),
        dt_s=0.2,
        history=15,
        horizon_ticks=15,
    )
    return gather_scene(recordings, index), gather_future(recordings, index)


def forecast_by(name: str, scene: Scene, future: Future) -> Forecast:
    """The forecast for 3 s."""
    predictor = load_predictor(name, horizon=15, dt_s=0.2)
    return predictor.predict(scene, future if predictor.privileged else None)


def copies(scene: Scene, future: Future, count: int) -> tuple[Scene, Future]:
    """A scene of one agent as several situations, in which it has the ids 1 to `count`."""
    many: dict[str, Any] = {
        name: np.repeat(getattr(scene, name), count, axis=0)
        for name in ("states", "actions", "valid", "sizes", "classes", "tick", "route")
    }
    targets = np.stack([np.arange(count), np.zeros(count, dtype=int)], axis=-1)
    larger = Scene(
        **many,
        ids=np.arange(1, count + 1)[:, None],
        targets=targets,
        route_valid=np.repeat(scene.route_valid, count, axis=0),
        maps=scene.maps,
        map_index=np.zeros(count, dtype=np.int64),
        dt_s=scene.dt_s,
    )
    return larger, Future(
        states=np.repeat(future.states, count, axis=0), valid=np.repeat(future.valid, count, axis=0)
    )


BRAKING_AND_NORTH = scene_at_3_s(BRAKING, NORTH)
MANY_NORTH = copies(*scene_at_3_s(NORTH), 100)


def test_blind_places_all_agents_1_km_ahead() -> None:
    """Pedestrians as well; they stand there at all ticks, and no actions lead there."""
    scene, future = scene_at_3_s(EAST, NORTH, WALKER)
    forecast = forecast_by("blind", scene, future)
    assert forecast.valid.all()
    assert not forecast.actions_valid.any()
    moved = forecast.states[:, 0, 0] - scene.target_states
    expected = [[1000, 0, 0, -10], [0, 1000, 0, -4], [1000, 0, 0, -1]]
    np.testing.assert_allclose(moved, expected, atol=1e-3)
    np.testing.assert_array_equal(forecast.states, forecast.states[:, :, :1].repeat(15, axis=2))


def test_a_quarter_of_the_way_to_a_braking_car() -> None:
    """From 16 m/s at -2 m/s², 39 m in 3 s instead of 48 m: 45.75 m, at 14.5 m/s."""
    scene, future = scene_at_3_s(BRAKING)
    forecast = forecast_by("blend:0.25", scene, future)
    expected = scene.target_states[0] + np.array([45.75, 0.0, 0.0, -1.5])
    np.testing.assert_allclose(forecast.states[0, 0, -1], expected, atol=0.02)
    np.testing.assert_allclose(forecast.actions[0, 0, :, 0], -0.5, atol=0.01)


def test_headings_are_blended_through_the_smaller_angle() -> None:
    """Half-way from 3.1 rad to -3.1 rad is ±π."""
    scene, future = scene_at_3_s(STANDING)
    scene.states[:, :, -1, 2], future.states[..., 2] = 3.1, -3.1
    forecast = forecast_by("blend:0.5", scene, future)
    np.testing.assert_allclose(np.abs(forecast.states[..., 2]), math.pi, atol=1e-6)


def assert_ends_of_the_ladder(scene: Scene, future: Future) -> None:
    """`blend:0` is constant velocity, `blend:1` the oracle, and so is an oracle without noise."""
    straight = forecast_by("constant-velocity", scene, future)
    assert straight.valid.any()
    rows = straight.valid
    lowest, oracle = forecast_by("blend:0", scene, future), forecast_by("oracle", scene, future)
    np.testing.assert_array_equal(lowest.states[rows], straight.states[rows])
    np.testing.assert_allclose(lowest.actions[rows], 0, atol=1e-2)
    for name in ("blend:1", "noisy-oracle:0"):
        highest = forecast_by(name, scene, future)
        np.testing.assert_array_equal(highest.valid, oracle.valid)
        np.testing.assert_array_equal(highest.states[..., [0, 1, 3]], oracle.states[..., [0, 1, 3]])
        turned = wrap_angle(highest.states[..., 2] - oracle.states[..., 2])
        np.testing.assert_allclose(turned, 0, atol=1e-6)


def test_ends_of_the_ladder() -> None:
    recordings = [make_recording()]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    assert_ends_of_the_ladder(gather_scene(recordings, index), gather_future(recordings, index))


@pytest.mark.data
def test_ends_of_the_ladder_on_real_recordings() -> None:
    recordings = open_data(str(real_data("karlsruhe")))
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    assert len(index) > 100
    assert_ends_of_the_ladder(gather_scene(recordings, index), gather_future(recordings, index))


@given(share=st.floats(0, 1))
def test_errors_shrink_linearly_along_the_ladder(share: float) -> None:
    """The error of `blend:SHARE` is 1 - SHARE times that of constant velocity, at every tick."""
    scene, future = BRAKING_AND_NORTH

    def error_m(name: str) -> np.ndarray:
        states = forecast_by(name, scene, future).states[:, 0]
        return np.linalg.norm(states[..., :2] - future.states[..., :2], axis=-1)

    expected = (1 - share) * error_m("constant-velocity")
    np.testing.assert_allclose(error_m(f"blend:{share}"), expected, atol=1e-4)


def test_noise_has_the_stated_size_at_the_horizon() -> None:
    """Over 4000 agents that drive 30 m in 3 s, `noisy-oracle:2` is off by 2 m (root mean square).

    √2 m are along and √2 m across; the two are uncorrelated and the error grows linearly.
    """
    scene, future = copies(*scene_at_3_s(EAST), 4000)
    forecast = forecast_by("noisy-oracle:2", scene, future)
    error_m = (forecast.states[:, 0] - future.states)[..., :2].astype(np.float64)
    last = error_m[:, -1]
    assert math.sqrt((last**2).sum(axis=1).mean()) == pytest.approx(2.0, rel=0.03)
    np.testing.assert_allclose(np.sqrt((last**2).mean(axis=0)), math.sqrt(2), rtol=0.04)
    np.testing.assert_allclose(last.mean(axis=0), np.zeros(2), atol=0.08)
    np.testing.assert_allclose((last[:, 0] * last[:, 1]).mean(), 0, atol=0.1)
    share = np.arange(1, 16)[:, None] / 15
    np.testing.assert_allclose(error_m, last[:, None] * share, atol=1e-3)


def test_noisy_headings_and_speeds_fit_the_positions() -> None:
    """On a straight road the heading is the course of the forecast, the speed its rate."""
    scene, future = copies(*scene_at_3_s(EAST), 50)
    states = forecast_by("noisy-oracle:2", scene, future).states[:, 0].astype(np.float64)
    step = np.diff(states[..., :2], axis=1)
    np.testing.assert_allclose(np.hypot(*step.T).T / 0.2, states[:, 1:, 3], atol=1e-3)
    np.testing.assert_allclose(np.arctan2(*step.T[::-1]).T, states[:, 1:, 2], atol=1e-4)


def test_noise_is_smaller_for_slow_agents() -> None:
    """2 m · (3 / 6)² = 0.5 m for an agent that moves 3 m in 3 s, 0 for one that stands."""
    slow = Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, 1.0))
    scene, future = copies(*scene_at_3_s(slow), 4000)
    error_m = (forecast_by("noisy-oracle:2", scene, future).states[:, 0] - future.states)[:, -1, :2]
    assert math.sqrt((error_m**2).sum(axis=1).mean()) == pytest.approx(0.5, rel=0.03)
    scene, future = copies(*scene_at_3_s(STANDING), 10)
    found = forecast_by("noisy-oracle:2", scene, future).states[:, 0]
    np.testing.assert_allclose(found, future.states, atol=1e-6)


@given(metres=st.floats(0, 1e6))
def test_noise_never_moves_an_agent_backwards(metres: float) -> None:
    """However large METRES is, the error along is at most 3 / (3√2) of the distance, 71 %."""
    scene, future = MANY_NORTH
    states = forecast_by(f"noisy-oracle:{metres}", scene, future).states[:, 0]
    ahead = states[..., 1] - scene.target_states[:, None, 1]
    assert (np.diff(ahead, axis=1) > 0).all()


def test_noise_persists_for_about_2_s() -> None:
    """It is standard, nearly the same after one tick, and independent after twice 2.4 s."""
    ids, tick = np.arange(1, 3001).repeat(25), np.tile(np.arange(25), 3000)
    noise = persistent_noise(ids, tick, 0.2).reshape(3000, 25, 2)
    assert np.abs(noise).max() == 3.0
    np.testing.assert_allclose(noise.mean(axis=(0, 1)), 0, atol=0.05)
    np.testing.assert_allclose(noise.std(axis=0), 1, atol=0.05)

    def correlation(lag: int) -> float:
        return float(np.corrcoef(noise[:, 0, 0], noise[:, lag, 0])[0, 1])

    assert correlation(1) > 0.97
    assert 0.4 < correlation(9) < 0.6
    assert abs(correlation(24)) < 0.06
    assert abs(np.corrcoef(noise[:-1, 0, 0], noise[1:, 0, 0])[0, 1]) < 0.06  # other agents


def test_noise_is_a_function_of_id_and_tick_alone() -> None:
    """Alone and among others, now and in any later version."""
    ids, tick = np.array([5, 1, 5, 12345678901]), np.array([0, 7, 31, -3])
    together = persistent_noise(ids, tick, 0.2)
    for row in range(4):
        alone = persistent_noise(ids[[row]], tick[[row]], 0.2)
        np.testing.assert_array_equal(alone, together[[row]])
    np.testing.assert_allclose(together[0], PINNED, rtol=1e-12)


def test_shuffled_motions_go_round_in_the_order_of_ids() -> None:
    """1 drives like 2, 2 like 3 and 3 like 1; a pedestrian among cars continues straight.

    East at 10 m/s, north at 4 m/s and standing, heading west: after 3 s 1 is 12 m further east,
    2 stands where it is, and 3 is 30 m further west.
    """
    scene, future = scene_at_3_s(EAST, NORTH, STANDING, WALKER)
    forecast = forecast_by("shuffled-oracle", scene, future)
    assert forecast.ids.tolist() == [1, 2, 3, 4]
    moved = forecast.states[:, 0, -1] - scene.target_states
    expected = [[12, 0, 0, -6], [0, 0, 0, -4], [-30, 0, 0, 10], [3, 0, 0, 0]]
    moved[:, 2] = wrap_angle(moved[:, 2])
    np.testing.assert_allclose(moved, expected, atol=1e-3)


def test_shuffled_motions_stay_within_their_situation() -> None:
    """Two agents of two situations continue straight, although both brake."""
    scene, future = copies(*scene_at_3_s(BRAKING), 2)
    shuffled = forecast_by("shuffled-oracle", scene, future)
    straight = forecast_by("constant-velocity", scene, future)
    np.testing.assert_array_equal(shuffled.states, straight.states)


def test_shuffled_forecasts_are_distributed_like_the_oracle() -> None:
    """Distances covered and speeds of a situation are the same numbers in another order."""
    scene, future = scene_at_3_s(EAST, NORTH, BRAKING, STANDING)
    shuffled, oracle = (forecast_by(name, scene, future) for name in ("shuffled-oracle", "oracle"))
    for found in (shuffled, oracle):
        np.testing.assert_array_equal(found.valid, True)
    now = scene.target_states[:, None, None, :2]
    covered_m = [np.linalg.norm(each.states[..., :2] - now, axis=-1) for each in (shuffled, oracle)]
    found, expected = (np.sort(each, axis=0) for each in covered_m)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    found, expected = (np.sort(each.states[..., 3], axis=0) for each in (shuffled, oracle))
    np.testing.assert_array_equal(found, expected)


def test_the_interactive_oracle_equals_the_oracle_at_logged_states() -> None:
    """There the ego carries out its log, so that the future is the recorded one."""
    scene, future = scene_at_3_s(EAST, BRAKING, WALKER)
    oracle, interactive = (
        forecast_by(name, scene, future) for name in ("oracle", "interactive-oracle")
    )
    np.testing.assert_array_equal(interactive.states, oracle.states)
    np.testing.assert_array_equal(interactive.valid, True)


def test_only_the_interactive_oracle_needs_a_simulation() -> None:
    """Also behind a delay; a driver of traffic does not know the ego's plan and refuses it."""
    needing = ("interactive-oracle", "delayed:2:interactive-oracle")
    for name in (*needing, "oracle", "blend:0.5", "constant-velocity", "delayed:2:oracle"):
        predictor = load_predictor(name, horizon=15, dt_s=0.2)
        assert needs_simulation(predictor) == (name in needing)
        if name in needing:
            with pytest.raises(AspEnvError, match="simulates the ego's plan, which drivers do not"):
                make_traffic(f"predictor:{name}")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("blend", "predictor blend: expected blend:SHARE"),
        ("blend:2", r"predictor blend:2: .* from 0 \(constant velocity\) to 1 \(oracle\)"),
        ("blend:-0.1", "predictor blend:-0.1: expected"),
        ("blend:nan", "predictor blend:nan: expected"),
        ("blend:25%", "such as blend:0.25"),
        ("noisy-oracle", "predictor noisy-oracle: expected noisy-oracle:METRES"),
        ("noisy-oracle:-1", "predictor noisy-oracle:-1: .* at least 0, such as noisy-oracle:2"),
        ("noisy-oracle:inf", "predictor noisy-oracle:inf: expected"),
        ("blind:1", "predictor blind takes no argument, '1' was given: use blind"),
        ("shuffled-oracle:1", "predictor shuffled-oracle takes no argument"),
        ("interactive-oracle:1", "predictor interactive-oracle takes no argument"),
    ],
)
def test_bad_arguments_are_refused(name: str, message: str) -> None:
    with pytest.raises(AspEnvError, match=message) as caught:
        load_predictor(name, horizon=15, dt_s=0.2)
    assert "\n" not in str(caught.value)


def test_a_missing_future_is_reported_by_the_name_as_given() -> None:
    scene, _ = scene_at_3_s(EAST)
    for name in ("blend:0.25", "noisy-oracle:2", "shuffled-oracle", "delayed:2:oracle"):
        predictor = load_predictor(name, horizon=15, dt_s=0.2)
        inner = name.replace("delayed:2:", "")
        with pytest.raises(AspEnvError, match=f"{inner} needs the recorded future of 1[57] ticks"):
            predictor.predict(scene)

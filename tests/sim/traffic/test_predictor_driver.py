"""Agents that follow forecasts."""

from types import MappingProxyType

import numpy as np
import pytest

from asp_env.data.classes import AgentClass
from asp_env.data.predictor import load_predictor, make_forecast
from asp_env.errors import AspEnvError
from asp_env.sim.traffic.predictor import PredictorDriver
from tests.builders import DRIVES, Drive, make_recording
from tests.sim.worlds import DT_S, car, now, on_road, replay, scenario, simulate

STEPS = 10


class Oracles:
    """Speaks of two modes: accelerate by 1 m/s² with probability 1/4, brake by 2 with 3/4."""

    name = "two-minds"
    privileged = False
    dt_s = DT_S
    history = 15
    horizon = STEPS
    trained_on = None
    metadata = MappingProxyType[str, str]({})

    def __init__(self, *, actions: bool = True, first_mps2: float = 1.0) -> None:
        """Forecasts actions, or states alone."""
        self.actions, self.first_mps2 = actions, first_mps2
        self.asked: list[list[tuple[int, int]]] = []

    def predict(self, scene, future=None):
        """Remembers of whom it was asked."""
        assert future is None
        self.asked.append([tuple(each) for each in scene.targets.tolist()])
        now, count = scene.target_states, len(scene.targets)
        wanted = np.array([self.first_mps2, -2.0], dtype=np.float32)
        actions = np.zeros((count, 2, STEPS, 2), dtype=np.float32)
        actions[..., 0] = wanted[:, None]
        t = DT_S * np.arange(1, STEPS + 1, dtype=np.float32)
        speed = now[:, None, None, 3] + wanted[:, None] * t
        way = now[:, None, None, 3] * t + 0.5 * wanted[:, None] * t**2
        heading = np.broadcast_to(now[:, None, None, 2], speed.shape)
        x = now[:, None, None, 0] + way * np.cos(heading)
        y = now[:, None, None, 1] + way * np.sin(heading)
        return make_forecast(
            scene,
            states=np.stack([x, y, heading, speed], axis=-1),
            actions=actions if self.actions else None,
            log_probs=np.log(np.tile(np.array([[0.25, 0.75]]), (count, 1))),
            valid=scene.predictable,
        )


def _speed(simulation, track_id: int, episode: int = 0) -> float:
    state = now(simulation, track_id, episode)
    assert state is not None
    return float(state[3])


@pytest.mark.parametrize("actions", [True, False])
def test_the_most_probable_mode_is_followed(actions):
    """8 m/s braked by 2 m/s² for a second are 6, whether actions are forecast or states alone."""
    driver = PredictorDriver(Oracles(actions=actions))
    simulation = simulate(on_road(car(-50, 8)), scenario(), driver)
    replay(simulation, 5)
    assert now(simulation, 2) == pytest.approx([-50 + 24 + 7, -1.75, 0, 6], abs=1e-3)


def test_actions_stay_within_the_limits():
    """A forecast of 60 m/s² is followed at 5."""
    driver = PredictorDriver(_only_first(60.0))
    simulation = simulate(on_road(car(-50, 8)), scenario(), driver)
    replay(simulation, 5)
    assert _speed(simulation, 2) == pytest.approx(13.0, abs=1e-3)


def _only_first(acceleration_mps2: float) -> Oracles:
    class Sure(Oracles):
        def predict(self, scene, future=None):
            forecast = super().predict(scene, future)
            forecast.log_probs[:] = np.log([0.9, 0.1])
            return forecast

    return Sure(first_mps2=acceleration_mps2)


def test_one_call_speaks_of_all_agents_of_all_episodes_every_k_ticks():
    """Every 4 ticks of its own episode, and only of the driver's agents."""
    predictor = Oracles()
    table = {"default": "log", "car": PredictorDriver(predictor, every=4)}
    recording = on_road(car(-50, 8), car(-80, 8), car(-20, 8, kind=AgentClass.TRUCK))
    simulation = simulate(recording, [scenario(), scenario(length=10)], table)
    cars = [(0, 1), (0, 2), (1, 1), (1, 2)]
    replay(simulation, 9)
    assert predictor.asked == [cars, cars, cars]
    predictor.asked.clear()
    where = np.array([False, True])
    simulation.reset([scenario()] * 2, [np.random.default_rng(0)] * 2, where)
    replay(simulation, 4)
    # episode 1 is at its ticks 0 and then 4, episode 0 at 9 and then 12
    assert predictor.asked == [[(1, 1), (1, 2)], [(0, 1), (0, 2)]]
    replay(simulation, 1)
    assert predictor.asked[2:] == [[(1, 1), (1, 2)]]


def test_episodes_that_are_over_are_not_asked_about():
    """Of the two only the longer one goes on."""
    predictor = Oracles()
    driver = PredictorDriver(predictor, every=1)
    simulation = simulate(on_road(car(-50, 8)), [scenario(length=3), scenario()], driver)
    replay(simulation, 5)
    assert predictor.asked == [[(0, 1), (1, 1)]] * 3 + [[(1, 1)]] * 2


def test_without_enough_history_an_agent_goes_straight_on():
    """One that came a second ago is not forecast by a predictor that wants 3 s."""
    simulation = simulate(
        on_road(car(-50, 8, appears_s=2.0)), scenario(), PredictorDriver(Oracles())
    )
    replay(simulation, 5)
    assert now(simulation, 2) == pytest.approx([-50 + 16, -1.75, 0, 8], abs=1e-3)


def test_an_agent_that_comes_is_forecast_at_once():
    """It appears at tick 3, between the forecasts of ticks 0 and 5, and then keeps their beat."""
    predictor = Oracles()
    driver = PredictorDriver(predictor)
    simulation = simulate(on_road(car(-50, 8, appears_s=3.6)), scenario(), driver)
    replay(simulation, 11)
    assert predictor.asked == [[(0, 1)]] * 3
    assert now(simulation, 2) == pytest.approx([-50 + 8 * 1.6, -1.75, 0, 8], abs=1e-3)


def test_modes_are_drawn_with_their_probabilities():
    """Of 400 agents about 3/4 brake; the draws come from the episodes' own generators."""
    driver = PredictorDriver(Oracles(), sampled=True)
    recording = on_road(*(car(x, 8) for x in (-90, -70, -50, -30)))
    seeds = [scenario(length=5)] * 100
    simulation = simulate(recording, seeds, driver)
    simulation.reset(seeds, [np.random.default_rng(i) for i in range(100)])
    replay(simulation, 5)
    speeds = simulation.world.episodes.states[:, simulation.world.now[0], 1:, 3]
    assert set(np.round(speeds.ravel(), 2).tolist()) == {6.0, 9.0}
    assert 0.68 < (speeds < 8).mean() < 0.82
    # the same seed draws the same, alone or among others
    alone = simulate(recording, scenario(length=5), PredictorDriver(Oracles(), sampled=True))
    alone.reset([scenario(length=5)], [np.random.default_rng(37)])
    replay(alone, 5)
    assert alone.world.episodes.states[0, -1, 1:].tobytes() == (
        simulation.world.episodes.states[37, -1, 1:].tobytes()
    )


def test_the_oracle_leads_along_the_log():
    """It is handed the recorded future; tracks made by the bicycle come back within 1 cm in 4 s."""
    drives = tuple(each for each in DRIVES if each.start[3] > 4.5 and each.kind != AgentClass.TRUCK)
    recording = make_recording(frame_rate_hz=5.0, drives=drives)
    simulation = simulate(recording, scenario(1, start=25, length=20), "predictor:oracle")
    replay(simulation, 20)
    episodes = simulation.world.episodes
    both = episodes.valid[0] & episodes.log_valid[0]
    away = episodes.states[0, ..., :2] - episodes.log_states[0, ..., :2]
    assert both[-1].sum() >= 4
    assert np.linalg.norm(away[both], axis=-1).max() < 0.01


def test_an_agent_leaves_beyond_all_recorded_positions():
    """Its log ends at 92 m and so does the recorded area; 10 m further on it is gone."""
    leaver = Drive(kind=AgentClass.CAR, start=(60.0, -1.75, 0.0, 8.0), leaves_s=4.0)
    simulation = simulate(on_road(leaver), scenario(length=60), "predictor:constant-velocity")
    edge = simulation.world.recordings[0].extent_m[2]
    before = int((edge + 10 - 84) / 1.6)
    replay(simulation, before)
    assert now(simulation, 2) == pytest.approx([84 + 1.6 * before, -1.75, 0, 8], abs=0.01)
    replay(simulation, 2)
    assert now(simulation, 2) is None


@pytest.mark.parametrize("every", [0, STEPS + 1])
def test_forecasts_must_reach_to_the_next_ones(every):
    """Between 1 tick and the horizon."""
    with pytest.raises(AspEnvError, match="expected 1 to 10 ticks, the horizon of two-minds"):
        PredictorDriver(Oracles(), every=every)


def test_another_time_step_is_refused():
    """Before anything is driven."""
    predictor = load_predictor("constant-velocity", horizon=5, dt_s=0.4)
    with pytest.raises(AspEnvError, match=r"time step of 0\.4 s, the world has 0\.2 s"):
        simulate(on_road(car(-50, 8)), scenario(), PredictorDriver(predictor))

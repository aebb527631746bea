"""The driver `predictor`."""

from types import MappingProxyType

import numpy as np
import pytest

from asp_env.data.classes import AgentClass
from asp_env.data.predictor import load_predictor, make_forecast
from asp_env.dynamics import rollout
from asp_env.errors import AspEnvError
from asp_env.sim.traffic.predictor import PredictorDriver
from tests.builders import DRIVES, Drive, make_recording
from tests.sim.worlds import DT_S, car, now, on_road, replay, scenario, simulate

STEPS = 10


class TwoModes:
    """Forecasts two modes: accelerating by 1 m/s² with probability 1/4, braking by 2 with 3/4."""

    name = "two-modes"
    privileged = False
    dt_s = DT_S
    history = 15
    horizon = STEPS
    trained_on = None
    metadata = MappingProxyType[str, str]({})

    def __init__(self, *, actions: bool = True, first_mps2: float = 1.0) -> None:
        self.actions, self.first_mps2 = actions, first_mps2
        self.calls: list[list[tuple[int, int]]] = []

    def predict(self, scene, future=None):
        """Stores the targets."""
        assert future is None
        self.calls.append([tuple(each) for each in scene.targets.tolist()])
        now, count = scene.target_states, len(scene.targets)
        accelerations = np.array([self.first_mps2, -2.0], dtype=np.float32)
        actions = np.zeros((count, 2, STEPS, 2), dtype=np.float32)
        actions[..., 0] = accelerations[:, None]
        t = DT_S * np.arange(1, STEPS + 1, dtype=np.float32)
        speed = now[:, None, None, 3] + accelerations[:, None] * t
        distance = now[:, None, None, 3] * t + 0.5 * accelerations[:, None] * t**2
        heading = np.broadcast_to(now[:, None, None, 2], speed.shape)
        x = now[:, None, None, 0] + distance * np.cos(heading)
        y = now[:, None, None, 1] + distance * np.sin(heading)
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
    """8 m/s and -2 m/s² for 1 s yield 6 m/s, with and without forecast actions."""
    driver = PredictorDriver(TwoModes(actions=actions))
    simulation = simulate(on_road(car(-50, 8)), scenario(), driver)
    replay(simulation, 5)
    assert now(simulation, 2) == pytest.approx([-50 + 24 + 7, -1.75, 0, 6], abs=1e-3)


class Turning:
    """Forecasts one mode, the rollout of 1.5 m/s² and 0.1 rad by an integrator."""

    name = "turning"
    privileged = False
    dt_s = DT_S
    history = 15
    horizon = STEPS
    trained_on = None
    metadata = MappingProxyType[str, str]({})

    def __init__(self, integrator) -> None:
        self.integrator = integrator

    def predict(self, scene, future=None):
        """The rollouts."""
        assert future is None
        at = (scene.targets[:, 0], scene.targets[:, 1])
        actions = np.tile(np.array([1.5, 0.1], dtype=np.float32), (len(at[0]), STEPS, 1))
        states = rollout(
            scene.target_states, actions, scene.sizes[at][:, 0], DT_S, integrator=self.integrator
        )
        return make_forecast(
            scene,
            states=states[:, None],
            actions=actions[:, None],
            log_probs=np.zeros((len(states), 1)),
            valid=scene.predictable,
        )


@pytest.mark.parametrize("integrator", ["heun", "euler"])
@pytest.mark.parametrize("speed_mps", [8, -2])
@pytest.mark.parametrize("beside", ["alone", "in a table"])
def test_forecast_states_are_reproduced(integrator, speed_mps, beside):
    """To 1 mm over 1 s, with Heun's and with Euler's method, also driving backwards."""
    driver = PredictorDriver(Turning(integrator))
    traffic = driver if beside == "alone" else {"default": "log", "car": driver}
    other = car(-20, 8, kind=AgentClass.TRUCK)
    simulation = simulate(on_road(car(-50, speed_mps), other), scenario(), traffic)
    start, lengths = simulation.world.scene().states[0, 1, -1], simulation.world.episodes.sizes
    actions = np.tile(np.array([1.5, 0.1], dtype=np.float32), (5, 1))
    expected = rollout(start, actions, lengths[0, 1, 0], DT_S, integrator=integrator)
    for state in expected:
        replay(simulation, 1)
        assert now(simulation, 2) == pytest.approx(state, abs=1e-3)
    other_integrator = "heun" if integrator == "euler" else "euler"
    away = rollout(start, actions, lengths[0, 1, 0], DT_S, integrator=other_integrator)[-1, :2]
    assert np.linalg.norm(away - expected[-1, :2]) > 0.1  # the wrong method would be off by this


def test_actions_stay_within_the_limits():
    """A forecast of 60 m/s² is followed at 5 m/s²."""
    driver = PredictorDriver(_first_mode_probable(60.0))
    simulation = simulate(on_road(car(-50, 8)), scenario(), driver)
    replay(simulation, 5)
    assert _speed(simulation, 2) == pytest.approx(13.0, abs=1e-3)


def _first_mode_probable(acceleration_mps2: float) -> TwoModes:
    class FirstMode(TwoModes):
        def predict(self, scene, future=None):
            forecast = super().predict(scene, future)
            forecast.log_probs[:] = np.log([0.9, 0.1])
            return forecast

    return FirstMode(first_mps2=acceleration_mps2)


def test_one_call_covers_all_due_agents_of_all_episodes():
    """Agents of the driver are due every 4 ticks of their own episode."""
    predictor = TwoModes()
    table = {"default": "log", "car": PredictorDriver(predictor, every=4)}
    recording = on_road(car(-50, 8), car(-80, 8), car(-20, 8, kind=AgentClass.TRUCK))
    simulation = simulate(recording, [scenario(), scenario(length=10)], table)
    cars = [(0, 1), (0, 2), (1, 1), (1, 2)]
    replay(simulation, 9)
    assert predictor.calls == [cars, cars, cars]
    predictor.calls.clear()
    where = np.array([False, True])
    simulation.reset([scenario()] * 2, [np.random.default_rng(0)] * 2, where)
    replay(simulation, 4)
    # episode 1 is at its ticks 0 and then 4, episode 0 at 9 and then 12
    assert predictor.calls == [[(1, 1), (1, 2)], [(0, 1), (0, 2)]]
    replay(simulation, 1)
    assert predictor.calls[2:] == [[(1, 1), (1, 2)]]


def test_episodes_that_are_over_are_not_forecast():
    predictor = TwoModes()
    driver = PredictorDriver(predictor, every=1)
    simulation = simulate(on_road(car(-50, 8)), [scenario(length=3), scenario()], driver)
    replay(simulation, 5)
    assert predictor.calls == [[(0, 1), (1, 1)]] * 3 + [[(1, 1)]] * 2


def test_an_agent_with_too_short_a_history_continues_at_constant_velocity():
    """It appeared 1 s ago; the predictor needs 3 s."""
    simulation = simulate(
        on_road(car(-50, 8, appears_s=2.0)), scenario(), PredictorDriver(TwoModes())
    )
    replay(simulation, 5)
    assert now(simulation, 2) == pytest.approx([-50 + 16, -1.75, 0, 8], abs=1e-3)


def test_an_agent_that_appears_is_forecast_at_once():
    """It appears at tick 3, and is then forecast at ticks 5 and 10 with the others."""
    predictor = TwoModes()
    driver = PredictorDriver(predictor)
    simulation = simulate(on_road(car(-50, 8, appears_s=3.6)), scenario(), driver)
    replay(simulation, 11)
    assert predictor.calls == [[(0, 1)]] * 3
    assert now(simulation, 2) == pytest.approx([-50 + 8 * 1.6, -1.75, 0, 8], abs=1e-3)


def test_modes_are_drawn_with_their_probabilities():
    """Of 400 agents about 3/4 brake; each episode draws from its own generator."""
    driver = PredictorDriver(TwoModes(), sampled=True)
    recording = on_road(*(car(x, 8) for x in (-90, -70, -50, -30)))
    scenarios = [scenario(length=5)] * 100
    simulation = simulate(recording, scenarios, driver)
    simulation.reset(scenarios, [np.random.default_rng(i) for i in range(100)])
    replay(simulation, 5)
    speeds = simulation.world.episodes.states[:, simulation.world.now[0], 1:, 3]
    assert set(np.round(speeds.ravel(), 2).tolist()) == {6.0, 9.0}
    assert 0.68 < (speeds < 8).mean() < 0.82
    # the same seed draws the same modes, alone and in a batch
    alone = simulate(recording, scenario(length=5), PredictorDriver(TwoModes(), sampled=True))
    alone.reset([scenario(length=5)], [np.random.default_rng(37)])
    replay(alone, 5)
    assert alone.world.episodes.states[0, -1, 1:].tobytes() == (
        simulation.world.episodes.states[37, -1, 1:].tobytes()
    )


def test_the_oracle_follows_the_tracks():
    """Tracks of the bicycle model are reproduced within 1 cm in 4 s."""
    drives = tuple(each for each in DRIVES if each.start[3] > 4.5 and each.kind != AgentClass.TRUCK)
    recording = make_recording(frame_rate_hz=5.0, drives=drives)
    simulation = simulate(recording, scenario(1, start=25, length=20), "predictor:oracle")
    replay(simulation, 20)
    episodes = simulation.world.episodes
    both = episodes.valid[0] & episodes.log_valid[0]
    away = episodes.states[0, ..., :2] - episodes.log_states[0, ..., :2]
    assert both[-1].sum() >= 4
    assert np.linalg.norm(away[both], axis=-1).max() < 0.01


def test_an_agent_leaves_outside_the_recorded_area():
    """Its track and the recorded area end at 92 m; 10 m farther it has left."""
    leaver = Drive(kind=AgentClass.CAR, start=(60.0, -1.75, 0.0, 8.0), leaves_s=4.0)
    simulation = simulate(on_road(leaver), scenario(length=60), "predictor:constant-velocity")
    edge = simulation.world.recordings[0].extent_m[2]
    before = int((edge + 10 - 84) / 1.6)
    replay(simulation, before)
    assert now(simulation, 2) == pytest.approx([84 + 1.6 * before, -1.75, 0, 8], abs=0.01)
    replay(simulation, 2)
    assert now(simulation, 2) is None


@pytest.mark.parametrize("every", [0, STEPS + 1])
def test_an_interval_beyond_the_horizon_is_refused(every):
    with pytest.raises(AspEnvError, match="expected 1 to 10 ticks, the horizon of two-modes"):
        PredictorDriver(TwoModes(), every=every)


def test_another_time_step_is_refused():
    predictor = load_predictor("constant-velocity", horizon=5, dt_s=0.4)
    with pytest.raises(AspEnvError, match=r"time step of 0\.4 s, the world has 0\.2 s"):
        simulate(on_road(car(-50, 8)), scenario(), PredictorDriver(predictor))

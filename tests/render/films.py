"""A synthetic film that is small enough to compute its frames by hand."""

import numpy as np

from asp_env.data.classes import AgentClass
from asp_env.data.rollout import Rollout
from asp_env.data.scenarios.scenario import Scenario
from asp_env.render.film import Film
from tests.builders import make_map

MAP = make_map()
STEPS = 5


def make_rollout() -> Rollout:
    """One second of an ego and a car.

    The ego drives east at 10 m/s, 4 m ahead of the recorded ego; its plans at ticks 0 to 4 go
    straight on. The car drives west and leaves after tick 3; at ticks 0 and 2 it has a forecast of
    two modes of 10 steps: straight on, and to the south. The ego has a collision at ticks 2 and 3
    and is off the road at tick 5.
    """
    ticks = np.arange(STEPS + 1, dtype=np.float32)
    states = np.zeros((STEPS + 1, 2, 4), dtype=np.float32)
    states[:, 0, 0], states[:, 0, 1], states[:, 0, 3] = 2 * ticks, -1.75, 10.0
    states[:, 1, 0], states[:, 1, 1], states[:, 1, 2] = 20 - 2 * ticks, 1.75, np.pi
    valid = np.ones((STEPS + 1, 2), dtype=bool)
    valid[4:, 1] = False
    states[4:, 1] = 0
    log = states.copy()
    log[:, 0, 0] -= 4
    ahead = np.arange(1, 11, dtype=np.float32)
    plans = np.zeros((STEPS, 10, 2), dtype=np.float32)
    plans[..., 0], plans[..., 1] = 2 * (ticks[:STEPS, None] + ahead), -1.75
    forecast_ticks = np.array([0, 2])
    forecast = np.zeros((2, 2, 10, 2), dtype=np.float32)
    forecast[:] = states[forecast_ticks, 1, None, None, :2]
    forecast[:, 0, :, 0] -= 2 * ahead
    forecast[:, 1, :, 1] -= 2 * ahead
    events = np.zeros((STEPS + 1, 3), dtype=bool)
    events[2:4, :2], events[5, 2] = True, True
    return Rollout(
        scenario=Scenario(
            source="synthetic",
            recording=0,
            recording_name="00",
            start_tick=15,
            length=STEPS,
            ego_id=7,
            tags=("straight",),
        ),
        dt_s=0.2,
        states=states,
        valid=valid,
        log_states=log,
        log_valid=np.ones((STEPS + 1, 2), dtype=bool),
        sizes=np.tile(np.array([4, 2], dtype=np.float32), (2, 1)),
        classes=np.array([AgentClass.CAR, AgentClass.CAR]),
        ids=np.array([7, 8]),
        route=np.zeros((0, 2), dtype=np.float32),
        plans=plans,
        forecast_states=forecast,
        forecast_log_probs=np.log(np.array([(0.75, 0.25)] * 2, dtype=np.float32)),
        forecast_slots=np.array([1, 1]),
        forecast_ticks=forecast_ticks,
        events=events,
        event_names=("collision", "at-fault collision", "off-road"),
    )


def make_film(rollout: Rollout | None = None, title: str = "synthetic") -> Film:
    """A film of the rollout at a crossing without a background image."""
    rollout = make_rollout() if rollout is None else rollout
    return Film(rollout=rollout, road_map=MAP, background=None, title=title)

"""Forecasts measured while episodes are driven."""

import numpy as np
import pytest

from asp_env.data.predictor import Forecast
from asp_env.evaluation.closed_loop.forecast_quality import FORECAST_METRICS, forecast_quality

STEPS = 2
SPEED_MPS = 5.0


def _forecast(tick: int, offsets_m: list[float], probabilities: list[float]) -> Forecast:
    """Of agent 1 of one episode, whose x is `tick`, with modes that are off by some metres in y."""
    modes = len(offsets_m)
    states = np.zeros((1, modes, STEPS, 4), dtype=np.float32)
    states[0, :, :, 0] = tick + 1 + np.arange(STEPS)
    states[0, :, :, 1] = np.array(offsets_m)[:, None]
    return Forecast(
        states=states,
        actions=np.zeros((1, modes, STEPS, 2), dtype=np.float32),
        actions_valid=np.zeros(1, dtype=bool),
        log_probs=np.log(np.array([probabilities], dtype=np.float32)),
        ids=np.array([7]),
        targets=np.array([[0, 1]]),
        tick=np.array([tick]),
        valid=np.ones(1, dtype=bool),
        dt_s=0.2,
    )


def _track(ticks: int) -> tuple[np.ndarray, np.ndarray]:
    """Two agents of one episode: the ego stands, agent 1 drives along x by 1 m per tick."""
    states = np.zeros((1, ticks, 2, 4), dtype=np.float32)
    states[0, :, 1, 0] = np.arange(ticks)
    states[0, :, 1, 3] = SPEED_MPS
    return states, np.ones((1, ticks, 2), dtype=bool)


def test_measures_by_hand() -> None:
    """Four ticks and a horizon of two: the forecasts of ticks 0 and 1 are measured.

    The most probable mode (0.6) is off by 3 m at tick 0 and by 1 m at tick 1, the other one by 2
    and 4 m. So FDE is 2 m, that of the best 1.5 m; the most probable mode is the nearest at tick 1
    alone, and its probability exceeds that share by 0.1. The Brier scores are 0.6² + 0.6² and
    0.4² + 0.4². From tick 0 to 1 the most probable mode changes by 2 m, then by 1 m (to an offset
    of 0), then not.
    """
    offsets_m = [[3.0, 2.0], [1.0, 4.0], [0.0, 0.0], [0.0, 0.0]]
    forecasts = [_forecast(tick, each, [0.6, 0.4]) for tick, each in enumerate(offsets_m)]
    found = forecast_quality(forecasts, *_track(4))
    assert set(found) == set(FORECAST_METRICS)
    expected = {
        "forecast ADE": 2.0, "forecast FDE": 2.0, "forecast minADE": 1.5, "forecast minFDE": 1.5,
        "forecast Brier": 0.52, "overconfidence": 0.1, "forecast change": 1.0,
    }  # fmt: skip
    for name, value in expected.items():
        assert found[name].valid.all()
        assert found[name].value[0] == pytest.approx(value, abs=1e-6), name


def test_missing_where_the_horizon_is_not_known_or_nothing_moves() -> None:
    states, valid = _track(4)
    forecasts = [_forecast(tick, [1.0], [1.0]) for tick in range(4)]
    single = forecast_quality(forecasts, states, valid)
    assert single["forecast FDE"].value[0] == 1.0
    assert not single["forecast Brier"].valid[0]
    assert not single["overconfidence"].valid[0]
    valid[0, 2:] = False  # the episode ends
    assert not forecast_quality(forecasts, states, valid)["forecast FDE"].valid[0]
    standing = np.zeros_like(states)
    alone = forecast_quality(forecasts, standing, np.ones_like(valid))
    assert not alone["forecast FDE"].valid[0]
    assert alone["forecast change"].valid[0]
    assert not forecast_quality([], states, valid)["forecast change"].valid[0]

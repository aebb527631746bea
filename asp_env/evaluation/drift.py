"""How far inferred actions lead away from the log: the floor of every action-space predictor."""

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.clock import frames_per_tick
from asp_env.data.recording import Recording
from asp_env.data.scene import infer_actions
from asp_env.dynamics import rollout
from asp_env.metrics.open_loop import moving

_CHUNK = 10_000


def drift_m(
    recording: Recording,
    tracks: Int[np.ndarray, " n"],
    ticks: Int[np.ndarray, " n"],
    *,
    dt_s: float,
    horizon: int,
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Distance between the log and the rollout of its own actions after `horizon` ticks.

    From the logged state at each (track, tick) the actions inferred from the following states
    are rolled out (Heun), and the positions at the end compared. The tracks must last that long.

    Returns:
        Metres, and which of the vehicles move: over 1 m/s at the start, or displaced over 2 m.
    """
    stride = frames_per_tick(recording.frame_rate_hz, dt_s)
    metres, moves = [np.zeros(0)], [np.zeros(0, dtype=bool)]
    for start in range(0, len(tracks), _CHUNK):
        some = slice(start, start + _CHUNK)
        track = tracks[some]
        begin = recording.starts[track] - recording.first_frames[track] + ticks[some] * stride
        rows = begin[:, None] + np.arange(horizon + 1) * stride
        states = recording.states[rows].astype(np.float64)
        lengths_m = recording.sizes[track, 0].astype(np.float64)
        known = np.ones(rows.shape, dtype=bool)
        actions = infer_actions(states, known, lengths_m, dt_s)
        driven = rollout(states[:, 0], actions, lengths_m, dt_s, reverse=True)
        metres.append(np.hypot(*(driven[:, -1, :2] - states[:, -1, :2]).T))
        moves.append(moving(states[:, 0], states[:, 1:, :2], known[:, 1:]))
    return np.concatenate(metres), np.concatenate(moves)

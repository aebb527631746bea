"""The compiled inner loops of a replay world: writing a tick, and reading the last few."""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from asp_env.sim.episodes import Episodes


@njit(cache=True)
@no_type_check
def _read_obeying(states, sizes, actions, rows, now, obeys, out):
    at = 0
    for i in range(len(rows)):
        b, k = rows[i], now[i]
        for a in range(obeys.shape[1]):
            if obeys[i, a]:
                for field in range(4):
                    out[field, at] = states[b, k, a, field]
                out[4, at], out[5, at] = actions[b, a, 0], actions[b, a, 1]
                out[6, at] = max(sizes[b, a, 0], 0.1)
                at += 1


def read_obeying(
    data: Episodes,
    rows: Int[np.ndarray, " r"],
    now: Int[np.ndarray, " r"],
    actions: Float[np.ndarray, "b a 2"],
    obeys: Bool[np.ndarray, "r a"],
) -> tuple[
    Float[np.ndarray, "n 4"],
    Float[np.ndarray, "n 2"],
    Float[np.ndarray, " n"],
]:
    """States, actions and lengths of those who obey, row by row.

    Each field lies together in memory, which halves the time of what is computed of them.
    """
    fields = np.empty((7, np.count_nonzero(obeys)), dtype=np.float32)
    _read_obeying(data.states, data.sizes, actions, rows, now, obeys, fields)
    return fields[:4].T, fields[4:6].T, fields[6]


@njit(cache=True)
@no_type_check
def _write_tick(states, valid, log_states, log_valid, gone, rows, now, driven, obeys, moved):
    at = -1
    for i in range(len(rows)):
        b, k = rows[i], now[i] + 1
        for a in range(valid.shape[2]):
            mine = obeys[i, a]
            at += mine
            there = mine or (log_valid[b, k, a] and not driven[i, a])
            if gone[b, a] or not there:
                valid[b, k, a] = False
                states[b, k, a, :] = 0.0
                continue
            valid[b, k, a] = True
            if mine:
                for field in range(4):
                    states[b, k, a, field] = moved[at, field]
            else:
                for field in range(4):
                    states[b, k, a, field] = log_states[b, k, a, field]


def write_tick(
    data: Episodes,
    rows: Int[np.ndarray, " r"],
    now: Int[np.ndarray, " r"],
    driven: Bool[np.ndarray, "r a"],
    obeys: Bool[np.ndarray, "r a"],
    moved: Float[np.ndarray, "n 4"],
) -> None:
    """Writes the tick after `now` of some episodes.

    Args:
        data: the episodes.
        rows: which of them.
        now: the present tick of each.
        driven: who is not replayed.
        obeys: which of those are there to be moved.
        moved: where to, row by row.
    """
    _write_tick(
        *(data.states, data.valid, data.log_states, data.log_valid, data.gone),
        *(rows, now, driven, obeys, moved),
    )


@njit(cache=True)
@no_type_check
def _last_ticks(states, valid, now, rows, out_states, out_valid):
    """Copies the ticks up to now of some episodes, time by agent to agent by time."""
    agents, ticks = out_valid.shape[1:]
    for i in range(len(rows)):
        b = rows[i]
        first = now[b] + 1 - ticks
        for k in range(ticks):
            for a in range(agents):
                there = valid[b, first + k, a]
                out_valid[i, a, k] = there
                for field in range(4):
                    out_states[i, a, k, field] = states[b, first + k, a, field] if there else 0.0


def last_ticks(
    data: Episodes, now: Int[np.ndarray, " b"], rows: Int[np.ndarray, " r"], history: int
) -> tuple[Float[np.ndarray, "r a ticks 4"], Bool[np.ndarray, "r a ticks"]]:
    """States and presence in some episodes at the last `history` ticks and now, agent by agent."""
    shape = (len(rows), data.ids.shape[1], history + 1)
    states, valid = np.empty((*shape, 4), dtype=np.float32), np.empty(shape, dtype=bool)
    _last_ticks(data.states, data.valid, now, rows, states, valid)
    return states, valid

"""How an episode begins: what a recording holds of a scenario."""

import numpy as np
from jaxtyping import Int

from asp_env.data.clock import frames_per_tick
from asp_env.data.geometry import path_length, route_along
from asp_env.data.recording import Recording
from asp_env.data.scenario import Scenario
from asp_env.data.scene import infer_actions
from asp_env.data.snippets import gather_window
from asp_env.errors import AspEnvError
from asp_env.metrics.boxes import ego_contacts, touching_trailers
from asp_env.metrics.route import route_coordinates
from asp_env.sim.episodes import Episodes
from asp_env.sim.world import EGO

BEYOND_M = 60.0
"""How far a route goes on straight behind the last recorded position."""


def begin(recording: Recording, scenario: Scenario, *, dt_s: float, history: int) -> Episodes:
    """A single episode at its first tick.

    Raises:
        AspEnvError: the scenario does not fit the recording.
    """
    stride = frames_per_tick(recording.frame_rate_hz, dt_s)
    first_tick = scenario.start_tick - history
    tracks = _tracks(recording, scenario, first_tick, stride)
    ego = tracks[0]
    states, valid = gather_window(
        recording,
        tracks,
        first_tick=first_tick,
        num_ticks=history + 1 + scenario.length,
        stride=stride,
    )
    past = infer_actions(
        states[:, : history + 1], valid[:, : history + 1], recording.sizes[tracks, 0], dt_s
    )
    states, valid = states.swapaxes(0, 1)[None], valid.swapaxes(0, 1)[None]
    actions = np.zeros((*valid.shape, 2), dtype=np.float32)
    actions[0, :history] = past.swapaxes(0, 1)
    start_row = scenario.start_tick * stride - recording.first_frames[ego]
    route = route_along(recording.track(int(ego))[start_row::stride], beyond_m=BEYOND_M)[None]
    route_valid = np.ones(route.shape[:2], dtype=bool)
    first = np.ascontiguousarray(states[:, history])
    sizes = recording.sizes[tracks][None]
    classes = recording.classes[tracks][None].astype(np.int32)
    own_trailer = touching_trailers(first, sizes, classes, valid[:, history])
    driven_m = np.full(1, path_length(states[0, history:, EGO, :2]))
    goal = route_coordinates(route, route_valid, states[:, -1, EGO], driven_m)[:, 0]
    simulated, present = states.copy(), valid.copy()
    simulated[:, history + 1 :], present[:, history + 1 :] = 0, False
    return Episodes(
        states=simulated,
        valid=present,
        actions=actions,
        inferred=np.full(1, history),
        log_states=states,
        log_valid=valid,
        gone=np.zeros((1, len(tracks)), dtype=bool),
        sizes=sizes,
        classes=classes,
        ids=recording.track_ids[tracks][None].astype(np.int64),
        parked=recording.parked[tracks][None],
        tracks=tracks[None],
        route=route,
        route_valid=route_valid,
        on_route=route_coordinates(route, route_valid, first[:, EGO], np.zeros(1)),
        contacts=ego_contacts(first, sizes, valid[:, history] & ~own_trailer),
        own_trailer=own_trailer,
        goal_m=goal,
        recording=np.full(1, scenario.recording),
        start_tick=np.full(1, scenario.start_tick),
        elapsed=np.zeros(1, dtype=np.int64),
        length=np.full(1, scenario.length),
    )


def _tracks(
    recording: Recording, scenario: Scenario, first_tick: int, stride: int
) -> Int[np.ndarray, " a"]:
    """Everybody seen in the scenario or its history, the ego first."""
    found = np.flatnonzero(recording.track_ids == scenario.ego_id)
    if not len(found):
        raise AspEnvError(
            f"scenario {scenario.name}: recording {recording.name} has no track {scenario.ego_id}"
        )
    ego = int(found[0])
    last_tick = scenario.start_tick + scenario.length
    if (
        scenario.length < 1
        or first_tick * stride < recording.first_frames[ego]
        or last_tick * stride > recording.last_frames[ego]
    ):
        raise AspEnvError(
            f"scenario {scenario.name}: ticks {first_tick} to {last_tick} are needed, the "
            f"track of the ego spans {-(-int(recording.first_frames[ego]) // stride)} to "
            f"{int(recording.last_frames[ego]) // stride}"
        )
    seen = recording.tracks_between(first_tick * stride, last_tick * stride)
    return np.concatenate([[ego], seen[seen != ego]])

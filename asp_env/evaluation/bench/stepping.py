"""As many vehicles at once as asked for: the traffic of a recording laid over itself.

MERGED: Rates of simulated episodes: one tick of everybody, with contacts and corners off the road.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from asp_env.data.recording import Recording, frames_per_tick
from asp_env.data.scenarios.scenario import Scenario
from asp_env.dynamics import forward, inverse
from asp_env.evaluation.bench.timing import Rate, median_s
from asp_env.evaluation.selection import no_data_error
from asp_env.geometry import box_corners
from asp_env.metrics.drivable import CELL_M, MARGIN_M, drivable_field
from asp_env.sim.simulation import Simulation
from asp_env.sim.traffic.assignment import make_traffic

MIN_TRACK_S = 4.0
"""Shorter tracks would make a crowd that comes and goes."""


def crowd(recording: Recording, *, agents: int, duration_s: float) -> Recording:
    """A recording in which `agents` vehicles drive at every moment.

    Each follows a track of the given recording, on the same map, and when that ends another one
    takes its place. They do not heed each other: this is for measuring speeds, not driving.

    Raises:
        AspEnvError: the recording has no vehicle of 4 s.
    """
    frames = round(duration_s * recording.frame_rate_hz)
    lengths = recording.last_frames - recording.first_frames + 1
    enough = lengths >= MIN_TRACK_S * recording.frame_rate_hz
    pool = np.flatnonzero(recording.predicted & enough)
    if not len(pool):
        raise no_data_error("vehicle seen for 4 s")
    tracks, first_frames, taken = [], [], []
    number = 0
    for _ in range(agents):
        frame = 0
        while frame < frames:
            track = int(pool[number % len(pool)])
            number += 1
            states = recording.track(track)[: frames - frame]
            tracks.append(states)
            first_frames.append(frame)
            taken.append(track)
            frame += len(states)
    return dataclasses.replace(
        recording,
        num_frames=frames,
        track_ids=np.arange(len(tracks)).astype(recording.track_ids.dtype),
        classes=recording.classes[taken],
        sizes=recording.sizes[taken],
        first_frames=np.array(first_frames, dtype=recording.first_frames.dtype),
        starts=np.concatenate([[0], np.cumsum([len(each) for each in tracks])]),
        states=np.concatenate(tracks),
        background=None,
    )


def crowd_scenarios(
    recording: Recording, *, count: int, start_tick: int, length: int, stride: int
) -> list[Scenario]:
    """Scenarios of a crowd, each vehicle that lasts long enough being the ego in turn."""
    last = (start_tick + length) * stride
    egos = np.flatnonzero((recording.first_frames == 0) & (recording.last_frames >= last))
    if not len(egos):
        raise no_data_error(f"vehicle seen for {start_tick + length} ticks")
    return [
        Scenario(
            source="crowd",
            recording=0,
            recording_name=recording.name,
            start_tick=start_tick,
            length=length,
            ego_id=int(recording.track_ids[egos[i % len(egos)]]),
        )
        for i in range(count)
    ]


HISTORY = 15
LENGTH = 40
CROWD_S = 12.0
STATE_BYTES = 4 * np.dtype(np.float32).itemsize
TRAFFIC = ("log", "log-actions", "idm", "hybrid")
UNIT = "episode-steps/s"


def stepping(
    recordings: Sequence[Recording],
    scenarios: Sequence[Scenario],
    *,
    agents: int,
    dt_s: float,
) -> list[Rate]:
    """Steps and resets of a crowd and of the recorded traffic, under every kind of traffic.

    Args:
        recordings: what the scenarios are of; the crowd is made of the first.
        scenarios: one for each episode.
        agents: of the crowd, in every episode.
        dt_s: the time step.
    """
    episodes = len(scenarios)
    dense, crowded = _crowd(recordings[0], episodes, agents, dt_s)
    found = [
        Rate(
            what=f"plain NumPy, {episodes} episodes, {agents} driven agents",
            per_s=_plain_numpy(dense, episodes, agents, dt_s),
            unit=UNIT,
            bytes_each=agents * STATE_BYTES,
        )
    ]
    for traffic in TRAFFIC:
        rate, _ = simulated(dense, crowded, traffic, dt_s)
        beside = {"beside": found[0].per_s, "beside_what": "plain NumPy"}
        found.append(
            Rate(
                what=f"{traffic}, {episodes} episodes, crowd of {agents}",
                per_s=rate,
                unit=UNIT,
                bytes_each=agents * STATE_BYTES,
                **(beside if traffic == "log-actions" else {}),
            )
        )
    for traffic in TRAFFIC:
        rate, resets = simulated(recordings, scenarios, traffic, dt_s)
        found.append(
            Rate(what=f"{traffic}, {episodes} episodes, as recorded", per_s=rate, unit=UNIT)
        )
        found.append(
            Rate(what=f"reset, {traffic}, {episodes} episodes", per_s=resets, unit="resets/s")
        )
    return found


def scaling(
    recording: Recording, *, episodes: Sequence[int], agents: Sequence[int], dt_s: float
) -> list[tuple[int, int, float]]:
    """(episodes, agents, episode-steps/s) of `log-actions` along both axes.

    The number of episodes varies at the middle number of agents, and the other way round.
    """
    usual = episodes[len(episodes) // 2], agents[len(agents) // 2]
    pairs = [(count, usual[1]) for count in episodes] + [(usual[0], count) for count in agents]
    found = []
    for count, each in pairs:
        dense, crowded = _crowd(recording, count, each, dt_s)
        found.append((count, each, simulated(dense, crowded, "log-actions", dt_s)[0]))
    return found


def simulated(
    recordings: Sequence[Recording], scenarios: Sequence[Scenario], traffic: str, dt_s: float
) -> tuple[float, float]:
    """Episode-steps and resets per second; contacts and corners off the road included."""
    count = len(scenarios)
    simulation = Simulation(
        recordings, make_traffic(traffic), num_episodes=count, dt_s=dt_s, history=HISTORY
    )
    generators = [np.random.default_rng(0)] * count
    reset_s = median_s(lambda: simulation.reset(scenarios, generators))
    start = simulation.snapshot()
    actions = np.zeros((count, 2), dtype=np.float32)
    controlled = np.ones(count, dtype=bool)
    steps = min(scenario.length for scenario in scenarios)

    def drive() -> None:
        for _ in range(steps):
            simulation.step(actions, controlled)
            simulation.world.events()

    step_s = median_s(drive, prepare=lambda: simulation.restore(start))
    return steps * count / step_s, count / reset_s


def _crowd(
    recording: Recording, episodes: int, agents: int, dt_s: float
) -> tuple[list[Recording], list[Scenario]]:
    dense = crowd(recording, agents=agents, duration_s=CROWD_S)
    stride = frames_per_tick(recording.frame_rate_hz, dt_s)
    length = min(LENGTH, int(CROWD_S / dt_s + 1e-6) - HISTORY - 1)
    return [dense], crowd_scenarios(
        dense, count=episodes, start_tick=HISTORY, length=length, stride=stride
    )


def _plain_numpy(recordings: Sequence[Recording], episodes: int, agents: int, dt_s: float) -> float:
    """The same work in plain NumPy: everybody moved, the ego's contacts and corners looked up."""
    recording = recordings[0]
    stride = frames_per_tick(recording.frame_rate_hz, dt_s)
    there = recording.tracks_between(HISTORY * stride, HISTORY * stride)[:agents]
    rows = recording.starts[there] + HISTORY * stride - recording.first_frames[there]
    states = np.tile(recording.states[rows], (episodes, 1, 1))
    after = np.tile(recording.states[rows + stride], (episodes, 1, 1))
    sizes = np.tile(recording.sizes[there], (episodes, 1, 1))
    field = drivable_field(recording.road_map)

    def step() -> None:
        actions = inverse(states, after, sizes[..., 0], dt_s)
        moved = forward(states, actions, sizes[..., 0], dt_s)
        corners = box_corners(moved, sizes)
        touching(moved, corners)
        cells = (corners[:, 0] - np.array(field.origin_m)) / CELL_M + 0.5
        column, row = np.floor(np.moveaxis(cells, -1, 0)).astype(int)
        rows, columns = field.outside_m.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        looked_up = field.outside_m[np.where(inside, row, 0), np.where(inside, column, 0)]
        np.where(inside, looked_up, MARGIN_M).max(axis=-1)

    return episodes / median_s(step)


def touching(
    states: Float[np.ndarray, "b a 4"], corners: Float[np.ndarray, "b a 4 2"]
) -> Bool[np.ndarray, "b a"]:
    """Whether each box overlaps the first one: no axis of either keeps them apart."""
    angles = np.stack([np.broadcast_to(states[:, :1, 2], states.shape[:2]), states[..., 2]], -1)
    ahead = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    left = np.stack([-ahead[..., 1], ahead[..., 0]], axis=-1)
    axes = np.concatenate([ahead, left], axis=-2)
    mine = np.einsum("bcd,bakd->bakc", corners[:, 0], axes)
    theirs = np.einsum("bacd,bakd->bakc", corners, axes)
    apart = (mine.max(-1) <= theirs.min(-1)) | (theirs.max(-1) <= mine.min(-1))
    return ~apart.any(axis=-1)

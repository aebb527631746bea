"""Rates of the simulation without an environment, in dense and in recorded traffic."""

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
from asp_env.metrics.drivable import CELL_M, MARGIN_M, TILE_CELLS, drivable_field
from asp_env.sim.simulation import Simulation
from asp_env.sim.traffic.assignment import make_traffic

MIN_TRACK_S = 4.0
"""Tracks shorter than this are not used in dense traffic: its agents would change too often."""
HISTORY = 15
LENGTH = 40
DENSE_S = 12.0
"""Duration of dense traffic."""
STATE_BYTES = 4 * np.dtype(np.float32).itemsize
TRAFFIC = ("log", "log-actions", "idm", "hybrid")
UNIT = "episode-steps/s"


def stepping_rates(
    recordings: Sequence[Recording],
    scenarios: Sequence[Scenario],
    *,
    agents: int,
    dt_s: float,
) -> list[Rate]:
    """Steps and resets per second in dense and in recorded traffic, for each kind of driver.

    Args:
        recordings: The recordings of the scenarios; dense traffic is made from the first one.
        scenarios: A scenario for each episode.
        agents: Number of agents in each episode with dense traffic.
        dt_s: Length of a tick.
    """
    episodes = len(scenarios)
    dense, starts = _dense(recordings[0], episodes, agents, dt_s)
    rates = [
        Rate(
            name=f"plain NumPy, {episodes} episodes, {agents} controlled agents",
            per_s=_plain_numpy(dense, episodes, agents, dt_s),
            unit=UNIT,
            bytes_each=agents * STATE_BYTES,
        )
    ]
    for traffic in TRAFFIC:
        steps_per_s, _ = simulation_rates(dense, starts, traffic, dt_s)
        reference = {"reference_per_s": rates[0].per_s, "reference": "plain NumPy"}
        rates.append(
            Rate(
                name=f"{traffic}, {episodes} episodes, {agents} agents",
                per_s=steps_per_s,
                unit=UNIT,
                bytes_each=agents * STATE_BYTES,
                **(reference if traffic == "log-actions" else {}),
            )
        )
    for traffic in TRAFFIC:
        steps_per_s, resets_per_s = simulation_rates(recordings, scenarios, traffic, dt_s)
        rates += [
            Rate(
                name=f"{traffic}, {episodes} episodes, recorded agents",
                per_s=steps_per_s,
                unit=UNIT,
            ),
            Rate(
                name=f"reset, {traffic}, {episodes} episodes", per_s=resets_per_s, unit="resets/s"
            ),
        ]
    return rates


def scaling_rates(
    recording: Recording, *, episodes: Sequence[int], agents: Sequence[int], dt_s: float
) -> list[tuple[int, int, float]]:
    """Rates of `log-actions` in dense traffic by number of episodes and by number of agents.

    Args:
        recording: The recording that dense traffic is made from.
        episodes: Numbers of episodes, with the middle number of agents.
        agents: Numbers of agents per episode, with the middle number of episodes.
        dt_s: Length of a tick.

    Returns:
        (episodes, agents, episode-steps per second).
    """
    middle = episodes[len(episodes) // 2], agents[len(agents) // 2]
    sizes = [(count, middle[1]) for count in episodes] + [(middle[0], count) for count in agents]
    rates = []
    for num_episodes, num_agents in sizes:
        dense, scenarios = _dense(recording, num_episodes, num_agents, dt_s)
        steps_per_s, _ = simulation_rates(dense, scenarios, "log-actions", dt_s)
        rates.append((num_episodes, num_agents, steps_per_s))
    return rates


def simulation_rates(
    recordings: Sequence[Recording], scenarios: Sequence[Scenario], traffic: str, dt_s: float
) -> tuple[float, float]:
    """Episode-steps and resets per second; steps include contacts and off-road events.

    Args:
        recordings: The recordings of the scenarios.
        scenarios: A scenario for each episode.
        traffic: The driver of the other agents.
        dt_s: Length of a tick.
    """
    count = len(scenarios)
    simulation = Simulation(
        recordings, make_traffic(traffic), num_episodes=count, dt_s=dt_s, history=HISTORY
    )
    generators = [np.random.default_rng(0)] * count
    reset_s = median_s(lambda: simulation.reset(scenarios, generators))
    start = simulation.snapshot()
    actions = np.zeros((count, 2), dtype=np.float32)
    active = np.ones(count, dtype=bool)
    steps = min(scenario.length for scenario in scenarios)

    def drive() -> None:
        for _ in range(steps):
            simulation.step(actions, active)
            simulation.world.events()

    step_s = median_s(drive, prepare=lambda: simulation.restore(start))
    return steps * count / step_s, count / reset_s


def make_dense_recording(recording: Recording, *, agents: int, duration_s: float) -> Recording:
    """A recording with a constant number of vehicles, for measurements of speed only.

    Each vehicle follows tracks of the given recording one after the other, on the same map. The
    vehicles do not react to each other and may overlap.

    Args:
        recording: The recording that provides map and tracks.
        agents: Number of vehicles at every frame.
        duration_s: Duration of the new recording.

    Raises:
        AspEnvError: The recording has no vehicle track of 4 s.
    """
    frames = round(duration_s * recording.frame_rate_hz)
    lengths = recording.last_frames - recording.first_frames + 1
    long_enough = lengths >= MIN_TRACK_S * recording.frame_rate_hz
    pool = np.flatnonzero(recording.predicted & long_enough)
    if not len(pool):
        raise no_data_error("vehicle seen for 4 s")
    tracks, first_frames, sources = [], [], []
    number = 0
    for _ in range(agents):
        frame = 0
        while frame < frames:
            track = int(pool[number % len(pool)])
            number += 1
            states = recording.track(track)[: frames - frame]
            tracks.append(states)
            first_frames.append(frame)
            sources.append(track)
            frame += len(states)
    return dataclasses.replace(
        recording,
        num_frames=frames,
        track_ids=np.arange(len(tracks)).astype(recording.track_ids.dtype),
        classes=recording.classes[sources],
        sizes=recording.sizes[sources],
        first_frames=np.array(first_frames, dtype=recording.first_frames.dtype),
        starts=np.concatenate([[0], np.cumsum([len(each) for each in tracks])]),
        states=np.concatenate(tracks),
        accelerations=None,
        background=None,
    )


def make_dense_scenarios(
    recording: Recording, *, count: int, start_tick: int, length: int, stride: int
) -> list[Scenario]:
    """Scenarios of dense traffic; the vehicles with long enough tracks take turns as the ego.

    Args:
        recording: The dense recording.
        count: Number of scenarios.
        start_tick: First tick.
        length: Number of ticks.
        stride: Frames per tick.

    Raises:
        AspEnvError: No track is long enough.
    """
    last_frame = (start_tick + length) * stride
    egos = np.flatnonzero((recording.first_frames == 0) & (recording.last_frames >= last_frame))
    if not len(egos):
        raise no_data_error(f"vehicle seen for {start_tick + length} ticks")
    return [
        Scenario(
            source="dense",
            recording=0,
            recording_name=recording.name,
            start_tick=start_tick,
            length=length,
            ego_id=int(recording.track_ids[egos[i % len(egos)]]),
        )
        for i in range(count)
    ]


def _dense(
    recording: Recording, episodes: int, agents: int, dt_s: float
) -> tuple[list[Recording], list[Scenario]]:
    dense = make_dense_recording(recording, agents=agents, duration_s=DENSE_S)
    stride = frames_per_tick(recording.frame_rate_hz, dt_s)
    length = min(LENGTH, int(DENSE_S / dt_s + 1e-6) - HISTORY - 1)
    return [dense], make_dense_scenarios(
        dense, count=episodes, start_tick=HISTORY, length=length, stride=stride
    )


def _plain_numpy(recordings: Sequence[Recording], episodes: int, agents: int, dt_s: float) -> float:
    """Episode-steps per second of a NumPy implementation of the same step.

    It moves all agents and computes the contacts of the ego and the corners off the road.
    """
    recording = recordings[0]
    stride = frames_per_tick(recording.frame_rate_hz, dt_s)
    present = recording.tracks_between(HISTORY * stride, HISTORY * stride)[:agents]
    rows = recording.starts[present] + HISTORY * stride - recording.first_frames[present]
    states = np.tile(recording.states[rows], (episodes, 1, 1))
    after = np.tile(recording.states[rows + stride], (episodes, 1, 1))
    sizes = np.tile(recording.sizes[present], (episodes, 1, 1))
    field = drivable_field(recording.road_map)

    def step() -> None:
        actions = inverse(states, after, sizes[..., 0], dt_s)
        moved = forward(states, actions, sizes[..., 0], dt_s)
        corners = box_corners(moved, sizes)
        overlaps_first(moved, corners)
        cells = (corners[:, 0] - np.array(field.origin_m)) / CELL_M + 0.5
        column, row = np.floor(np.moveaxis(cells, -1, 0)).astype(int)
        rows, columns = field.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        row, column = np.where(inside, row, 0), np.where(inside, column, 0)
        tiles = field.tile_of[row // TILE_CELLS, column // TILE_CELLS]
        looked_up = field.tiles[tiles, row % TILE_CELLS, column % TILE_CELLS]
        np.where(inside, looked_up, MARGIN_M).max(axis=-1)

    return episodes / median_s(step)


def overlaps_first(
    states: Float[np.ndarray, "b a 4"], corners: Float[np.ndarray, "b a 4 2"]
) -> Bool[np.ndarray, "b a"]:
    """Whether each box overlaps the first box, by the separating axis theorem.

    Args:
        states: States of the boxes.
        corners: Corners of the boxes, m.
    """
    headings = np.stack([np.broadcast_to(states[:, :1, 2], states.shape[:2]), states[..., 2]], -1)
    ahead = np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    left = np.stack([-ahead[..., 1], ahead[..., 0]], axis=-1)
    axes = np.concatenate([ahead, left], axis=-2)
    first = np.einsum("bcd,bakd->bakc", corners[:, 0], axes)
    each = np.einsum("bacd,bakd->bakc", corners, axes)
    separated = (first.max(-1) <= each.min(-1)) | (each.max(-1) <= first.min(-1))
    return ~separated.any(axis=-1)

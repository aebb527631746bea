"""Rounds: highway-env's episodes without an ego, with the internal states of their vehicles.

The internal state is what highway-env's vehicles hold besides their motion. With it a road is
restored exactly: the same vehicles in the same order continue in the same way.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped

from asp_env.data.recording import Recording
from asp_env.errors import DataError
from asp_env.stored import read_arrays
from scenarios.highway.road_map import mirror_states
from scenarios.highway.sites import (
    SITES,
    STEP_S,
    STEPS_PER_S,
    Site,
    network,
    populated_road,
    remove_exited,
    spawn_vehicle,
)
from scenarios.highway.vehicles import Network, Road, TrafficVehicle

LONGEST_ROUTE = 16
"""Roads; a route through the roundabout has at most 11."""

ANY_LANE = -1
"""In a route: any lane of the road."""

HIDDEN = np.dtype(
    [
        ("track", np.int32),
        ("x", np.float64),
        ("y", np.float64),
        ("heading", np.float64),
        ("speed", np.float64),
        ("target_lane", np.int16),
        ("target_speed", np.float64),
        ("timer", np.float64),
        ("delta", np.float64),
        ("route", np.int16, (LONGEST_ROUTE, 2)),
        ("route_length", np.int16),
        ("crashed", np.bool_),
        ("pushed", np.bool_),
        ("impact", np.float64, (2,)),
        ("yielding", np.bool_),
        ("yield_timer", np.int32),
        ("steered", np.bool_),
    ]
)
"""Internal state of a vehicle: number in the recording; x m, y m, heading rad and speed m/s in
highway-env's axes; target lane; desired speed, m/s; seconds since the last decision about a lane
change; exponent of the driver model; (road, lane) of the remaining route; whether it has crashed,
and its displacement at the next step, m; whether it yields, and for how many checks; whether it is
controlled."""

Rows = Shaped[np.ndarray, " _"]
"""Rows of `HIDDEN`, in the order of the road's vehicles."""

FOLDER = "hidden"
"""Folder beside `data` and `maps`."""

FARTHEST = {
    **{"x": 1e4, "y": 1e4, "heading": 1e3, "speed": 100.0, "target_speed": 100.0},
    "delta": 10.0,
}
"""Largest absolute values of fields of `HIDDEN`; others up to 1e6. Chosen by hand: far above those
of the sites; `delta` is an exponent of about 4."""

WANTED = "made by `asp-env synthesize OUT --site highway:…`"

ROUND_S = 20
"""Length of a round. highway-env's own episodes last 11 s and 13 s; by 20 s its roundabout is
nearly empty."""

HIDDEN_EVERY_FRAMES = 3
"""Frames between two stored internal states: 0.2 s."""


def read_vehicles(road: Road) -> Rows:
    """The internal states of all vehicles on a road."""
    rows = np.zeros(len(road.vehicles), dtype=HIDDEN)
    for row, vehicle in zip(rows, road.vehicles, strict=True):
        _read(row, vehicle, road.network)
    return rows


def _read(row: Any, vehicle: Any, network: Network) -> None:
    row["track"] = vehicle.track
    row["x"], row["y"] = vehicle.position
    row["heading"], row["speed"] = vehicle.heading, vehicle.speed
    start, end, number = vehicle.target_lane_index
    row["target_lane"] = network.indices.index((start, end, int(number)))
    row["target_speed"], row["timer"], row["delta"] = (
        vehicle.target_speed,
        vehicle.timer,
        vehicle.DELTA,
    )
    route = vehicle.route or []
    row["route_length"] = len(route)
    for k, (start, end, lane) in enumerate(route):
        row["route"][k] = network.roads.index((start, end)), ANY_LANE if lane is None else lane
    row["crashed"] = vehicle.crashed
    if vehicle.impact is not None:
        row["pushed"], row["impact"] = True, vehicle.impact
    row["yielding"] = getattr(vehicle, "is_yielding", False)
    row["yield_timer"] = getattr(vehicle, "yield_timer", 0)
    row["steered"] = vehicle.steered


def restore(rows: Rows, road: Road, kind: type[TrafficVehicle]) -> list[TrafficVehicle]:
    """Creates the vehicles of some rows; they are not yet on the road."""
    return [_restore(row, road, kind) for row in rows]


def _restore(row: Any, road: Road, kind: type[TrafficVehicle]) -> TrafficVehicle:
    network: Network = road.network
    vehicle: Any = kind(
        road, [float(row["x"]), float(row["y"])], float(row["heading"]), float(row["speed"])
    )
    vehicle.track = int(row["track"])
    vehicle.target_lane_index = network.indices[int(row["target_lane"])]
    # Set afterwards, since the constructor treats zero as missing.
    vehicle.target_speed = float(row["target_speed"])
    vehicle.timer = float(row["timer"])
    vehicle.DELTA = float(row["delta"])
    vehicle.route = [
        (*network.roads[int(road_number)], None if lane == ANY_LANE else int(lane))
        for road_number, lane in row["route"][: int(row["route_length"])]
    ]
    vehicle.crashed = bool(row["crashed"])
    vehicle.impact = row["impact"].copy() if row["pushed"] else None
    if row["yielding"]:
        vehicle.is_yielding, vehicle.color = True, None
    vehicle.yield_timer = int(row["yield_timer"])
    vehicle.steered = bool(row["steered"])
    return vehicle


@dataclass(frozen=True, slots=True, kw_only=True)
class HiddenHistory:
    """The internal states of all vehicles of a recording, every 0.2 s."""

    site: Site
    rows: Shaped[np.ndarray, " n"]
    """Rows of `HIDDEN`, sorted by time."""
    steps: Int[np.ndarray, " times"]
    """Step count of the road at each time."""
    starts: Int[np.ndarray, " times+1"]
    """Time i has the rows `starts[i]:starts[i + 1]`."""

    def __deepcopy__(self, memo: dict[int, Any]) -> "HiddenHistory":
        """Returns the object itself, since it is immutable."""
        del memo
        return self

    def at(self, frame: int) -> tuple[Rows, int]:
        """The internal states of the vehicles at a frame, and the step count of the road."""
        time = frame // HIDDEN_EVERY_FRAMES
        return self.rows[self.starts[time] : self.starts[time + 1]], int(self.steps[time])

    def coming(self, frame: int) -> Rows:
        """The vehicles that are present at a frame and absent before; none after the last frame."""
        time = frame // HIDDEN_EVERY_FRAMES
        if frame % HIDDEN_EVERY_FRAMES or not 0 < time < len(self.steps):
            return self.rows[:0]
        now, _ = self.at(frame)
        before, _ = self.at(frame - HIDDEN_EVERY_FRAMES)
        return now[~np.isin(now["track"], before["track"])]

    def fits(self, recording: Recording) -> bool:
        """Whether the history describes the vehicles of a recording at the same times."""
        frames = np.repeat(np.arange(len(self.steps)), np.diff(self.starts)) * HIDDEN_EVERY_FRAMES
        tracks, last = self.rows["track"], recording.last_frames
        if len(self.steps) < -(
            -recording.num_frames // HIDDEN_EVERY_FRAMES
        ):  # more: all left before the end
            return False
        if len(tracks) and not 0 <= tracks.min() <= tracks.max() < len(recording):
            return False
        there = (recording.first_frames[tracks] <= frames) & (frames <= last[tracks])
        times = last // HIDDEN_EVERY_FRAMES - (recording.first_frames - 1) // HIDDEN_EVERY_FRAMES
        return bool(there.all() and len(tracks) == times.sum())

    def save(self, path: Path) -> None:
        """Writes an `.npz` file without pickles."""
        np.savez_compressed(
            path,
            site=np.array(self.site.name),
            rows=self.rows,
            starts=self.starts,
            steps=self.steps,
        )


def load_history(path: Path) -> HiddenHistory:
    """Reads a file that `HiddenHistory.save` wrote.

    Raises:
        DataError: the file is missing, damaged, or of another version.
    """
    try:
        found = read_arrays(path)
        site, rows = str(found["site"]), found["rows"]
        starts, steps = found["starts"], found["steps"]
    except FileNotFoundError:
        raise DataError(f"{path} is missing: expected a folder {WANTED}") from None
    except (ValueError, KeyError) as error:
        raise DataError(f"{path} is damaged ({error}): expected a folder {WANTED}") from error
    if site not in SITES or rows.dtype != HIDDEN or not _whole(rows, starts, steps):
        raise DataError(f"{path}: of another version; expected a folder {WANTED} of this version")
    if not _possible(rows, network(site)):
        raise DataError(
            f"{path} is damaged (its vehicles cannot be on the roads of {site}): expected a folder "
            f"{WANTED}"
        )
    return HiddenHistory(site=SITES[site], rows=rows, starts=starts, steps=steps)


def _possible(rows: Rows, roads: Network) -> bool:
    """Whether all numbers are in range and all lanes and roads exist."""
    for name in rows.dtype.names or ():
        if (
            rows[name].dtype.kind == "f"
            and not (np.abs(rows[name]) <= FARTHEST.get(name, 1e6)).all()
        ):
            return False
    lanes_of = np.bincount([roads.roads.index(index[:2]) for index in roads.indices])
    road, lane = rows["route"][..., 0], rows["route"][..., 1]
    used = np.arange(LONGEST_ROUTE) < rows["route_length"][:, None]
    known = used & (road >= 0) & (road < len(lanes_of))
    exists = known & (lane >= ANY_LANE) & (lane < lanes_of[np.where(known, road, 0)])
    lengths, targets = rows["route_length"], rows["target_lane"]
    return bool(
        (exists == used).all()
        and ((lengths >= 0) & (lengths <= LONGEST_ROUTE)).all()
        and ((targets >= 0) & (targets < len(roads.indices))).all()
        and (rows["delta"] > 0).all()
    )


def _whole(rows: np.ndarray, starts: np.ndarray, steps: np.ndarray) -> bool:
    if not (rows.ndim == starts.ndim == steps.ndim == 1 and starts.dtype.kind == "i"):
        return False
    if len(starts) != len(steps) + 1 or steps.dtype.kind != "i":
        return False
    return bool(starts[0] == 0 and starts[-1] == len(rows) and (np.diff(starts) >= 0).all())


def hidden_path(tracks_path: Path) -> Path:
    """Path of the hidden history of a recording, from the path of its tracks."""
    name = tracks_path.name.partition("_")[0]
    return tracks_path.parent.parent / FOLDER / f"{name}_hidden.npz"


@dataclass(slots=True, kw_only=True)
class Seen:
    """The states of one vehicle while it is on the road."""

    first_frame: int
    states: list[Float[np.ndarray, " 4"]] = field(default_factory=list)
    """[x m, y m, heading rad, speed m/s] at each frame, in the axes of this package."""
    slips: list[float] = field(default_factory=list)
    """Slip angle of the step before each frame, rad, left positive."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Round:
    """One simulated round; vehicles are numbered as in `seen`."""

    seen: list[Seen]
    hidden: list[Rows]
    """Internal states every `HIDDEN_EVERY_FRAMES` frames, from the first frame on."""
    steps: Int[np.ndarray, " kept"]
    """Step count of the road at each time."""


def step_road(road: Road) -> None:
    """Advances a road by one of highway-env's steps of 1/15 s."""
    road.act()
    road.step(STEP_S)


def simulate_round(site: Site, rng: np.random.Generator, *, frames: int) -> Round:
    """Simulates one of highway-env's episodes, in which the ego is an ordinary vehicle."""
    road = populated_road(site, rng)
    seen: list[Seen] = []
    hidden: list[Rows] = []
    steps: list[int] = []
    for frame in range(frames):
        if frame:
            step_road(road)
            if frame % STEPS_PER_S == 0:
                remove_exited(site, road)
                spawn_vehicle(site, road, rng)
        _look(road.vehicles, seen, frame)
        if frame % HIDDEN_EVERY_FRAMES == 0:
            hidden.append(read_vehicles(road))
            steps.append(road.steps)
    return Round(seen=seen, hidden=hidden, steps=np.array(steps, dtype=np.int64))


def _look(vehicles: list[TrafficVehicle], seen: list[Seen], frame: int) -> None:
    for vehicle in vehicles:
        if vehicle.track < 0:
            vehicle.track = len(seen)
            seen.append(Seen(first_frame=frame))
        state = np.array([*vehicle.position, vehicle.heading, vehicle.speed])
        seen[vehicle.track].states.append(mirror_states(state))
        slip = np.arctan(0.5 * np.tan(vehicle.action["steering"]))
        seen[vehicle.track].slips.append(-float(slip))

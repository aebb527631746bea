"""Recordings of SUMO's traffic: simulation, tracks in view, files, and the source `synthetic:`."""

import shutil
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from asp_env.data.cache import get_or_create
from asp_env.errors import AspEnvError, unknown_name
from asp_env.files import atomic_folder
from asp_env.geometry import boxes_overlap
from scenarios.noise import measure
from scenarios.processes import run_with_progress
from scenarios.sumo.demand import RoadUser, Traffic, demand
from scenarios.sumo.motion import FRAME_RATE_HZ, Motion, reconstruct
from scenarios.sumo.network import Movements, simulate
from scenarios.sumo.place import METRES_PER_ORTHO_PIXEL, SITES, Place, draw_site, make_place
from scenarios.sumo.tracker import Tracker, draw_tracker, observe
from scenarios.tables import (
    Meta,
    Track,
    check_numbers,
    write_recording_meta,
    write_tracks,
    write_tracks_meta,
)

CHECKS_PER_S = 5.0
"""Overlaps are checked at 5 Hz."""

WARM_UP_S = 80.0
"""Simulated before the recording starts, so that traffic fills the location by then."""

_AFTER_S = 4.0

_LEAST_S = 1.0

_EDGE_M = 1.0

_MOST_ATTEMPTS = 12

_MOST_MPS2 = 14.0
"""Agents of varied traffic with a larger acceleration are left out. Chosen by hand: above emergency
braking and the sharpest corners of pedestrians, far below a jump."""

MAX_SECONDS = 24 * 3600.0

RECORDINGS_PER_LOCATION = 3
"""A split by recording needs at least three recordings of each location."""

_DAYS = ("monday", "tuesday", "wednesday", "thursday", "friday")

SOURCE_RECORDINGS, SOURCE_MINUTES, SOURCE_SEED = 8, 5.0, 90_521
"""Content of `synthetic:SITE`. The seed is reserved for it."""

SOURCE_VERSION = 2
"""Raised when the same seed gives other bytes, so that cached folders are not reused."""


def overlapping(
    motions: dict[str, Motion],
    users: dict[str, RoadUser],
    frame_rate_hz: float = FRAME_RATE_HZ,
) -> set[tuple[str, str]]:
    """Pairs of agents whose boxes overlap at some time; pedestrians may overlap each other.

    SUMO prevents collisions within lanes, but not between the corners of boxes that cut across
    lanes.

    Args:
        motions: of all agents, by name.
        users: size and class, by the same names.
        frame_rate_hz: frames per second of the motions.
    """
    every = round(frame_rate_hz / CHECKS_PER_S)
    names = [name for name in sorted(motions) if len(motions[name].xy)]
    rows: list[np.ndarray] = []
    for number, name in enumerate(names):
        motion, user = motions[name], users[name]
        first = -motion.first_frame % every
        xy, heading = motion.xy[first::every], motion.heading_rad[first::every]
        table = np.empty((len(xy), 7))
        table[:, 0] = (motion.first_frame + first) // every + np.arange(len(xy))
        table[:, 1] = number
        table[:, 2:4], table[:, 4] = xy, heading
        table[:, 5:] = user.length_m, user.width_m
        rows.append(table)
    if not rows:
        return set()
    table = np.concatenate(rows)
    table = table[np.argsort(table[:, 0], kind="stable")]
    reach = 0.5 * np.hypot(table[:, 5], table[:, 6])
    crowd = int(np.unique(table[:, 0], return_counts=True)[1].max())
    pairs: list[np.ndarray] = []
    for apart in range(1, crowd):
        near = table[:-apart, 0] == table[apart:, 0]
        distance = np.hypot(*(table[apart:, 2:4] - table[:-apart, 2:4]).T)
        near &= distance < reach[:-apart] + reach[apart:]
        first = np.flatnonzero(near)
        pairs.append(np.column_stack([first, first + apart]))
    a, b = np.concatenate([np.empty((0, 2), dtype=np.int64), *pairs]).T
    touching = boxes_overlap(table[a, 2:], table[b, 2:])
    found = {
        (names[int(one)], names[int(other)])
        for one, other in np.column_stack([table[a, 1], table[b, 1]])[touching]
    }
    pedestrians = {"pedestrian"}
    return {pair for pair in found if {users[name].kind for name in pair} != pedestrians}


def record(
    rng: np.random.Generator,
    place: Place,
    *,
    num_frames: int,
    frame_rate_hz: float = FRAME_RATE_HZ,
) -> tuple[dict[str, Motion], dict[str, RoadUser]]:
    """Simulates traffic at a location without overlapping agents.

    SUMO moves the front bumpers of vehicles along their lanes; the reconstructed boxes may still
    overlap. The agent of each such pair that departs later is removed and the same traffic is
    simulated again, which changes nothing before its departure.

    Args:
        rng: draws the demand and SUMO's seed.
        place: the location.
        num_frames: length of the recording.
        frame_rate_hz: frames per second of the recording.

    Returns:
        All motions in the recording's frame and all agents, both by name.
    """
    seconds = WARM_UP_S + num_frames / frame_rate_hz + _AFTER_S
    wanted = demand(rng, place.site, seconds, place.mix)
    seed = int(rng.integers(1, 2**31 - 1))
    motions: dict[str, Motion] = {}
    late: set[str] = set()
    for _ in range(_MOST_ATTEMPTS):
        moved = simulate(
            place.folder,
            wanted.routes,
            seconds=seconds,
            seed=seed,
            impatient=place.mix.impatient,
            lenient=place.mix.lenient,
        )
        motions = _motions(moved, place, wanted.users, frame_rate_hz)
        departs = {name: depart for depart, name, _ in wanted.entries}
        late = {
            max(pair, key=lambda name: (departs[name], name))
            for pair in overlapping(motions, wanted.users, frame_rate_hz)
        }
        if place.mix.lenient:
            late |= {name for name in motions if _jumps(motions[name], frame_rate_hz)}
        if not late:
            break
        wanted = wanted.without(late)
    else:  # not observed so far: the agents that still overlap are left out
        motions = {name: motion for name, motion in motions.items() if name not in late}
    return motions, wanted.users


def _jumps(motion: Motion, frame_rate_hz: float) -> bool:
    """Whether an agent accelerates as none can; some of netconvert's sidewalks have gaps."""
    acceleration = np.diff(motion.xy, 2, axis=0) * frame_rate_hz**2
    return bool(np.hypot(*acceleration.T).max(initial=0.0) > _MOST_MPS2)


def _motions(
    moved: Movements, place: Place, users: dict[str, RoadUser], frame_rate_hz: float
) -> dict[str, Motion]:
    motions: dict[str, Motion] = {}
    for number, name in enumerate(moved.names):
        rows = slice(moved.starts[number], moved.starts[number + 1])
        motion = reconstruct(
            moved.times_s[rows],
            moved.points[rows] + place.shift_m,
            kind=users[name].kind,
            length_m=users[name].length_m,
            style=users[name].style,
            frame_rate_hz=frame_rate_hz,
        )
        if motion is not None:
            motions[name] = motion
    return motions


def tracks_in_view(
    place: Place,
    motions: dict[str, Motion],
    users: dict[str, RoadUser],
    *,
    num_frames: int,
    frame_rate_hz: float = FRAME_RATE_HZ,
    noise: np.random.Generator | None = None,
) -> list[Track]:
    """The tracks that a camera above the location sees, in the order of appearance.

    Args:
        place: the location.
        motions: of all agents, by name; frame 0 is the start of the simulation.
        users: class and size, by the same names.
        num_frames: length of the recording.
        frame_rate_hz: frames per second of the recording.
        noise: draws measurement errors; without it the true tracks are returned.
    """
    tracks: list[tuple[int, str, Track]] = []
    for name in sorted(motions):
        motion, user = motions[name], users[name]
        window = _seen(motion, place, num_frames, frame_rate_hz)
        if window is None:
            continue
        xy, heading = motion.xy, motion.heading_rad
        if noise is not None:
            xy, heading = measure(noise, xy, heading)
        track = make_track(user, xy, heading, motion.first_frame, window, frame_rate_hz)
        tracks.append((track.first_frame, name, track))
    tracks.sort(key=lambda entry: entry[:2])
    return [track for _, _, track in tracks]


def make_track(
    user: RoadUser,
    xy: Float[np.ndarray, "frames 2"],
    heading_rad: Float[np.ndarray, " frames"],
    first_frame: int,
    window: slice,
    frame_rate_hz: float = FRAME_RATE_HZ,
) -> Track:
    """Derives velocities and accelerations of a motion and selects the rows of `window`."""
    velocity = np.gradient(xy, 1.0 / frame_rate_hz, axis=0)
    acceleration = np.gradient(velocity, 1.0 / frame_rate_hz, axis=0)
    return Track(
        kind=user.kind,
        length_m=user.length_m,
        width_m=user.width_m,
        first_frame=first_frame + window.start - round(WARM_UP_S * frame_rate_hz),
        xy=xy[window],
        heading_rad=heading_rad[window],
        velocity_mps=velocity[window],
        acceleration_mps2=acceleration[window],
    )


def _seen(motion: Motion, place: Place, num_frames: int, frame_rate_hz: float) -> slice | None:
    """The longest uninterrupted span in which a motion is inside the image."""
    frames = motion.first_frame + np.arange(len(motion.xy)) - round(WARM_UP_S * frame_rate_hz)
    half = np.array(place.site.half_size_m) - _EDGE_M
    seen = np.all(np.abs(motion.xy - place.shift_m) < half, axis=1)
    seen &= (frames >= 0) & (frames < num_frames)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(np.int8), [0]])))
    if not len(edges):
        return None
    begins, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - begins))
    if ends[longest] - begins[longest] < _LEAST_S * frame_rate_hz:
        return None
    return slice(int(begins[longest]), int(ends[longest]))


def parked_cars(rng: np.random.Generator, place: Place, num_frames: int) -> list[Track]:
    """Tracks of parked cars in the parking lots; they stand still in all frames."""
    tracks = []
    still = np.zeros((num_frames, 2))
    for lot in place.parking:
        along, deep = lot[1] - lot[0], lot[3] - lot[0]
        stalls = max(1, round(float(np.hypot(*along)) / 2.6))
        taken = rng.random(stalls) < 0.7
        taken[rng.integers(stalls)] = True
        for stall in np.flatnonzero(taken):
            middle = lot[0] + (stall + 0.5) / stalls * along + 0.5 * deep
            heading = float(np.arctan2(deep[1], deep[0])) + np.pi * float(rng.integers(2))
            heading += float(rng.normal(0.0, 0.02))
            tracks.append(
                Track(
                    kind="car",
                    length_m=round(float(rng.uniform(3.9, 4.8)), 2),
                    width_m=round(float(rng.uniform(1.7, 1.9)), 2),
                    first_frame=0,
                    xy=np.tile(middle, (num_frames, 1)),
                    heading_rad=np.full(num_frames, heading),
                    velocity_mps=still,
                    acceleration_mps2=still,
                )
            )
    return tracks


@dataclass(frozen=True, slots=True, kw_only=True)
class _Content:
    """What `synthesize` writes. It writes one location at a time, in any process and order."""

    folder: Path
    site: str
    recordings: int
    locations: int
    minutes: float
    seed: int
    noise: bool
    traffic: Traffic
    compress: bool

    def write_location(self, location: int) -> None:
        """Writes the map of a location and its recordings."""
        # Within the folder, which is removed as a whole if this process is killed.
        with tempfile.TemporaryDirectory(prefix=".", dir=self.folder) as scratch:
            place = self._place(location, Path(scratch))
            mine = [
                recording
                for recording in range(self.recordings)
                if recording * self.locations // self.recordings == location
            ]
            for recording in mine:
                rng = self._rng(1, recording)
                varied = self.traffic == "varied"
                _write_recording(
                    self,
                    place,
                    rng,
                    recording=recording,
                    location=location,
                    tracker=draw_tracker(self._rng(2, recording)) if varied else None,
                )

    def _place(self, location: int, scratch: Path) -> Place:
        rng = self._rng(0, location)
        site = draw_site(rng, self.site, self.traffic, location, scratch)
        place = make_place(rng, site, scratch / str(location), traffic=self.traffic)
        maps = self.folder / "maps" / "lanelets" / f"{location:02d}_{place.site.kind}"
        maps.mkdir(parents=True)
        place.write_map(maps / f"location{location}.osm")
        place.write_picture(place.folder / "background.png")
        return place

    def _rng(self, purpose: int, number: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, list(SITES).index(self.site), purpose, number])


def synthesize(
    out: Path,
    *,
    site: str,
    recordings: int,
    minutes: float,
    seed: int,
    noise: bool = False,
    locations: int | None = None,
    traffic: Traffic = "normal",
    compress: bool = False,
    jobs: int = 1,
    progress: bool = False,
) -> None:
    """Generates traffic in the inD layout.

    Args:
        out: folder to create; may exist if it is empty.
        site: `intersection` or `roundabout`.
        recordings: number of recordings.
        minutes: length of each recording.
        seed: the same seed gives the same bytes; another seed gives other locations and other
            traffic.
        noise: whether to write measured instead of true tracks; the true tracks go to
            `truth/XX_trueTracks.csv`, which readers ignore.
        locations: number of locations; by default one for three recordings.
        traffic: `normal`, `dense` or `varied`.
        compress: whether to write tracks as `.csv.xz`.
        jobs: number of processes; the bytes do not depend on it.
        progress: whether to show a progress bar.

    Raises:
        AspEnvError: the site is unknown, a number is out of range, or the folder cannot be written.
        MissingExtraError: SUMO is not installed.
    """
    if site not in SITES:
        raise unknown_name("site", site, SITES)
    places = max(1, recordings // RECORDINGS_PER_LOCATION) if locations is None else locations
    check_numbers(recordings=recordings, seed=seed)
    if not 1.0 <= minutes * 60.0 < MAX_SECONDS:
        raise AspEnvError(
            f"--minutes {minutes:g}: expected at least a second, 0.0167, and less than "
            f"{MAX_SECONDS / 60.0:g}"
        )
    if not 1 <= places <= recordings:
        raise AspEnvError(
            f"--locations {places}: expected 1 to {recordings}, the number of recordings"
        )
    with atomic_folder(out) as folder:
        content = _Content(
            folder=folder.absolute(),
            site=site,
            recordings=recordings,
            locations=places,
            minutes=minutes,
            seed=seed,
            noise=noise,
            traffic=traffic,
            compress=compress,
        )
        run_with_progress(
            content.write_location, places, f"{site} traffic", jobs=jobs, progress=progress
        )


def _write_recording(
    content: _Content,
    place: Place,
    rng: np.random.Generator,
    *,
    recording: int,
    location: int,
    tracker: Tracker | None,
) -> None:
    folder = content.folder
    suffix = ".csv.xz" if content.compress else ".csv"
    rate_hz = FRAME_RATE_HZ if tracker is None else tracker.frame_rate_hz
    num_frames = round(content.minutes * 60.0 * rate_hz)
    motions, users = record(rng, place, num_frames=num_frames, frame_rate_hz=rate_hz)
    parked = parked_cars(rng, place, num_frames)
    view = partial(
        tracks_in_view, place, motions, users, num_frames=num_frames, frame_rate_hz=rate_hz
    )
    true = parked + view()
    seen = true
    if content.noise:
        seen = parked + view(noise=rng) if tracker is None else observe(tracker, true)
        (folder / "truth").mkdir(exist_ok=True)
        write_tracks(folder / "truth" / f"{recording:02d}_trueTracks{suffix}", recording, true)
    lat, lon = place.lat_lon_deg
    meta = Meta(
        recording=recording,
        location=location,
        frame_rate_hz=rate_hz,
        speed_limit_mps=place.site.speed_limit_mps,
        weekday=str(rng.choice(_DAYS)),
        start_hour=int(rng.integers(7, 19)),
        num_frames=num_frames,
        lat_deg=lat,
        lon_deg=lon,
        utm_origin_m=place.origin_utm_m,
        metres_per_ortho_pixel=METRES_PER_ORTHO_PIXEL,
    )
    stem = str(folder / "data" / f"{recording:02d}_")
    (folder / "data").mkdir(exist_ok=True)
    shutil.copyfile(place.folder / "background.png", f"{stem}background.png")
    write_recording_meta(Path(f"{stem}recordingMeta.csv"), meta, seen)
    write_tracks_meta(Path(f"{stem}tracksMeta.csv"), recording, seen)
    write_tracks(Path(f"{stem}tracks{suffix}"), recording, seen)


def open_source(argument: str) -> Path:
    """The folder of the source `synthetic:ARGUMENT`, created on first use in the cache folder.

    Args:
        argument: `intersection` or `roundabout`.

    Raises:
        AspEnvError: the site is unknown, or the cache folder cannot be written.
    """
    if argument not in SITES:
        raise unknown_name("synthetic site", argument, SITES)
    return get_or_create(
        "synthetic",
        f"{argument}-{SOURCE_VERSION}",
        lambda folder: synthesize(
            folder,
            site=argument,
            recordings=SOURCE_RECORDINGS,
            minutes=SOURCE_MINUTES,
            seed=SOURCE_SEED,
            progress=True,
        ),
    )

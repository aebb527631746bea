"""Recordings of highway-env's traffic with internal states, and the source `highway:`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from asp_env.data.cache import get_or_create
from asp_env.errors import AspEnvError, unknown_name
from asp_env.files import atomic_folder
from scenarios.highway.road_map import ORIGIN_LAT_LON_DEG, ORIGIN_UTM_M, write_road_map
from scenarios.highway.rounds import (
    FOLDER,
    HIDDEN_EVERY_FRAMES,
    ROUND_S,
    HiddenHistory,
    Round,
    Seen,
    simulate_round,
)
from scenarios.highway.sites import SITES, STEP_S, STEPS_PER_S, Site, network
from scenarios.noise import measure
from scenarios.processes import run_with_progress
from scenarios.tables import (
    Meta,
    Track,
    check_numbers,
    write_recording_meta,
    write_tracks,
    write_tracks_meta,
)

MOST_MINUTES = 60.0
SMOOTHED_FRAMES = 13
"""Window of the smoothing filter: 0.87 s, as in the traffic of SUMO."""
NO_IMAGE_M = 0.1
"""Metres per pixel. There is no image, but the layout requires a number."""

SOURCE_RECORDINGS, SOURCE_MINUTES, SOURCE_SEED = 6, 2.0, 90_521
"""Content of `highway:SITE`."""

SOURCE_VERSION = 1
"""Raised when the same seed gives other bytes, so that cached folders are not reused."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Recorded:
    """The rounds of one recording, one after the other."""

    vehicles: list[Seen]
    hidden: HiddenHistory


@dataclass(frozen=True, slots=True, kw_only=True)
class _Content:
    """What `synthesize` writes. It writes one recording at a time, in any process and order."""

    folder: Path
    sites: tuple[str, ...]
    rounds: int
    seed: int
    noise: bool

    def write_map(self, location: int) -> None:
        site = self.sites[location]
        maps = self.folder / "maps" / "lanelets" / f"{location:02d}_{site}"
        maps.mkdir(parents=True)
        write_road_map(maps / f"location{location}.osm", network(site), origin_utm_m=ORIGIN_UTM_M)

    def write_recording(self, number: int) -> None:
        location = number % len(self.sites)
        site = self.sites[location]
        rng = np.random.default_rng([self.seed, [*SITES].index(site), number])
        recorded = _record(SITES[site], rng, self.rounds)
        _write(self, SITES[site], recorded, rng, number=number, location=location)


def synthesize(
    out: Path,
    *,
    site: str | tuple[str, ...],
    recordings: int,
    minutes: float,
    seed: int,
    noise: bool = False,
    jobs: int = 1,
    progress: bool = False,
) -> None:
    """Generates highway-env's traffic in the inD layout, 15 frames per second.

    Each recording is a sequence of rounds of 20 s, which are highway-env's own episodes with the
    ego as an ordinary vehicle; the vehicles of different rounds are different agents.

    Args:
        out: folder to create; may exist if it is empty.
        site: `intersection` or `roundabout`; or several sites, which the recordings have in turn.
        recordings: number of recordings.
        minutes: length of each recording, rounded up to whole rounds.
        seed: the same seed gives the same bytes on the same machine.
        noise: whether to write measured instead of true tracks; the true tracks go to
            `truth/XX_trueTracks.csv`, which readers ignore.
        jobs: number of processes; the bytes do not depend on it.
        progress: whether to show a progress bar.

    Raises:
        AspEnvError: the site is unknown, a number is out of range, or the folder cannot be written.
    """
    sites = (site,) if isinstance(site, str) else site
    for each in sites:
        if each not in SITES:
            raise unknown_name("site", f"highway:{each}", [f"highway:{name}" for name in SITES])
    check_numbers(recordings=recordings, seed=seed)
    if not 0.0 < minutes <= MOST_MINUTES:
        raise AspEnvError(
            f"--minutes {minutes:g}: expected more than 0, and at most {MOST_MINUTES:g}"
        )
    with atomic_folder(out) as folder:
        content = _Content(
            folder=folder.absolute(),
            sites=sites,
            rounds=int(np.ceil(minutes * 60.0 / ROUND_S - 1e-9)),
            seed=seed,
            noise=noise,
        )
        for location in range(len(sites)):
            content.write_map(location)
        for name in ("data", FOLDER):
            (folder / name).mkdir()
        run_with_progress(
            content.write_recording,
            recordings,
            f"highway-env {' and '.join(sites)} traffic",
            jobs=jobs,
            progress=progress,
        )


def _record(site: Site, rng: np.random.Generator, rounds: int) -> _Recorded:
    frames = ROUND_S * STEPS_PER_S
    vehicles: list[Seen] = []
    rows, counts, steps = [], [], []
    for number in range(rounds):
        found: Round = simulate_round(site, rng, frames=frames)
        for each in found.hidden:
            each["track"] += len(vehicles)
        for seen in found.seen:
            seen.first_frame += number * frames
        vehicles += found.seen
        rows += found.hidden
        counts += [len(each) for each in found.hidden]
        steps.append(found.steps)
    assert frames % HIDDEN_EVERY_FRAMES == 0
    return _Recorded(
        vehicles=vehicles,
        hidden=HiddenHistory(
            site=site,
            rows=np.concatenate(rows),
            starts=np.concatenate([[0], np.cumsum(counts)]),
            steps=np.concatenate(steps),
        ),
    )


def _write(
    content: _Content,
    site: Site,
    recorded: _Recorded,
    rng: np.random.Generator,
    *,
    number: int,
    location: int,
) -> None:
    folder, noise = content.folder, content.noise
    stem = f"{number:02d}"
    true = [_track(site, seen) for seen in recorded.vehicles]
    shown = [_measured(rng, track) for track in true] if noise else true
    lat, lon = ORIGIN_LAT_LON_DEG
    meta = Meta(
        recording=number,
        location=location,
        frame_rate_hz=float(STEPS_PER_S),
        speed_limit_mps=site.speed_limit_mps,
        weekday="monday",
        start_hour=8,
        num_frames=content.rounds * ROUND_S * STEPS_PER_S,
        lat_deg=lat,
        lon_deg=lon,
        utm_origin_m=ORIGIN_UTM_M,
        metres_per_ortho_pixel=NO_IMAGE_M,
    )
    if noise:
        (folder / "truth").mkdir(exist_ok=True)
        write_tracks(folder / "truth" / f"{stem}_trueTracks.csv", number, true)
    write_recording_meta(folder / "data" / f"{stem}_recordingMeta.csv", meta, shown)
    write_tracks_meta(folder / "data" / f"{stem}_tracksMeta.csv", number, shown)
    write_tracks(folder / "data" / f"{stem}_tracks.csv", number, shown)
    recorded.hidden.save(folder / FOLDER / f"{stem}_hidden.npz")


def _track(site: Site, seen: Seen) -> Track:
    """The track of a vehicle; its velocity points along its course, not along its heading."""
    states, slips = np.array(seen.states), np.array(seen.slips)
    course = states[:, 2] + np.append(slips[1:], slips[-1])  # the slip of the step that follows
    velocity = states[:, 3:] * np.stack([np.cos(course), np.sin(course)], axis=1)
    return Track(
        kind="car",
        length_m=site.vehicle.LENGTH,
        width_m=site.vehicle.WIDTH,
        first_frame=seen.first_frame,
        xy=states[:, :2],
        heading_rad=states[:, 2],
        velocity_mps=velocity,
        acceleration_mps2=_derivative(velocity),
    )


def _measured(rng: np.random.Generator, track: Track) -> Track:
    xy, heading = measure(rng, track.xy, np.unwrap(track.heading_rad), SMOOTHED_FRAMES)
    velocity = _derivative(xy)
    return Track(
        kind=track.kind,
        length_m=track.length_m,
        width_m=track.width_m,
        first_frame=track.first_frame,
        xy=xy,
        heading_rad=heading,
        velocity_mps=velocity,
        acceleration_mps2=_derivative(velocity),
    )


def _derivative(values: np.ndarray) -> np.ndarray:
    """Derivative by time at each frame; zero for a single frame."""
    if len(values) < 2:
        return np.zeros_like(values)
    return np.gradient(values, STEP_S, axis=0)


def open_source(argument: str) -> Path:
    """The folder of the source `highway:ARGUMENT`.

    Args:
        argument: `intersection` or `roundabout`, created on first use in the cache folder; or a
            folder that `asp-env synthesize OUT --site highway:…` wrote.

    Raises:
        AspEnvError: the site is unknown, the folder has another origin, or the cache folder cannot
            be written.
    """
    if argument in SITES:
        return get_or_create(
            "highway",
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
    folder = Path(argument).expanduser()
    if not argument or not folder.is_dir():
        raise unknown_name("highway site or folder", argument, SITES)
    if not (folder / FOLDER).is_dir():
        raise AspEnvError(
            f"highway:{argument}: {folder / FOLDER} is missing; expected a folder made by `asp-env "
            "synthesize OUT --site highway:…`; without the internal states of the vehicles it can "
            f"only be replayed: use {argument} itself"
        )
    return folder.absolute()

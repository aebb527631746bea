"""A folder of recordings in the inD layout."""

import shutil
import tempfile
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track as with_progress

from asp_env.errors import AspEnvError, unknown_name
from scenarios.synthetic.motion import FRAME_RATE_HZ
from scenarios.synthetic.picture import METRES_PER_ORTHO_PIXEL
from scenarios.synthetic.place import SITES, Place, make_place
from scenarios.synthetic.traffic import parked_cars, record, tracks_in_view
from scenarios.tables import (
    Meta,
    write_recording_meta,
    write_tracks,
    write_tracks_meta,
)
from scenarios.written import written_aside

MAX_SECONDS = 24 * 3600.0
RECORDINGS_PER_LOCATION = 3
"""At least so many, where there are enough: a split by recording needs three at each location."""
_DAYS = ("monday", "tuesday", "wednesday", "thursday", "friday")


def synthesize(
    out: Path,
    *,
    site: str,
    recordings: int,
    minutes: float,
    seed: int,
    noise: bool = False,
    locations: int | None = None,
    compress: bool = False,
    progress: bool = False,
) -> None:
    """Writes synthetic traffic in the inD layout.

    Args:
        out: folder to make; may exist if it is empty.
        site: `intersection` or `roundabout`.
        recordings: how many.
        minutes: length of each.
        seed: same seed, same bytes; another seed, other places and other traffic.
        noise: whether to write measured instead of true tracks; the truth goes to
            `truth/XX_trueTracks.csv`, which no reader takes for a recording.
        locations: how many places; by default one for three recordings.
        compress: whether to write tracks as `.csv.gz`.
        progress: whether to show a progress bar.

    Raises:
        AspEnvError: an unknown site, an impossible number, or a folder that cannot be written.
        MissingExtraError: SUMO is not installed.
    """
    if site not in SITES:
        raise unknown_name("site", site, SITES)
    places = max(1, recordings // RECORDINGS_PER_LOCATION) if locations is None else locations
    if not 1 <= places <= recordings or not 1.0 <= minutes * 60.0 < MAX_SECONDS or seed < 0:
        raise AspEnvError(
            f"{recordings} recordings of {minutes} minutes at {places} locations with seed {seed} "
            "cannot be made: at least one recording of a second and more, at least one location "
            "and no more than recordings, and a seed of 0 or above"
        )
    with written_aside(out) as folder, tempfile.TemporaryDirectory() as scratch:
        made: dict[int, Place] = {}
        for recording in with_progress(
            range(recordings),
            f"{site} traffic",
            console=Console(stderr=True),
            disable=not progress,
        ):
            location = recording * places // recordings
            if location not in made:
                made[location] = _make_location(folder, Path(scratch), site, seed, location)
            _write_recording(
                folder,
                made[location],
                _rng(seed, site, 1, recording),
                recording=recording,
                location=location,
                num_frames=round(minutes * 60.0 * FRAME_RATE_HZ),
                noise=noise,
                suffix=".csv.gz" if compress else ".csv",
            )


def _rng(seed: int, site: str, purpose: int, number: int) -> np.random.Generator:
    return np.random.default_rng([seed, list(SITES).index(site), purpose, number])


def _make_location(folder: Path, scratch: Path, site: str, seed: int, location: int) -> Place:
    rng = _rng(seed, site, 0, location)
    kinds = SITES[site]
    place = make_place(rng, kinds[location % len(kinds)](rng), scratch / str(location))
    maps = folder / "maps" / "lanelets" / f"{location:02d}_{place.site.kind}"
    maps.mkdir(parents=True)
    place.write_map(maps / f"location{location}.osm")
    place.write_picture(place.folder / "background.png")
    return place


def _write_recording(
    folder: Path,
    place: Place,
    rng: np.random.Generator,
    *,
    recording: int,
    location: int,
    num_frames: int,
    noise: bool,
    suffix: str,
) -> None:
    motions, users = record(rng, place, num_frames=num_frames)
    parked = parked_cars(rng, place, num_frames)
    true = parked + tracks_in_view(place, motions, users, num_frames=num_frames)
    seen = true
    if noise:
        moving = tracks_in_view(place, motions, users, num_frames=num_frames, noise=rng)
        seen = parked + moving
        (folder / "truth").mkdir(exist_ok=True)
        write_tracks(folder / "truth" / f"{recording:02d}_trueTracks{suffix}", recording, true)
    lat, lon = place.lat_lon_deg
    meta = Meta(
        recording=recording,
        location=location,
        frame_rate_hz=FRAME_RATE_HZ,
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

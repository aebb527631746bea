"""`asp-env watch`: saved rollouts in a window or as a video."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.progress import track
from rich.table import Table

from asp_env.console import text_console
from asp_env.data.recording import Recording, frames_per_tick
from asp_env.data.rollout import Rollout
from asp_env.data.snippets import gather_window
from asp_env.data.source import Recordings, open_readable
from asp_env.errors import AspEnvError, DataError
from asp_env.render.film import MAX_SIDE_PX, Film, check_video_possible, frames_of, write_video
from asp_env.render.window import PlayerState, play

SAME_PLACE_M = 1.0
"""Largest distance between the first position of a logged ego in its rollout and in DATA. Chosen by
hand, to distinguish recordings of the same name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Watch:
    """Show rollouts of `asp-env drive` in a window, or write them as a video."""

    rollout: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="ROLLOUT")]
    """File of a rollout (.npz), or a folder: all rollouts below it, one after the other."""
    video: Path | None = None
    """Write this video instead: FILE.mp4 (H.264) or FILE.webm (VP9). It must not exist."""
    list: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only list the rollouts."""
    map: tyro.conf.FlagCreatePairsOff[bool] = False
    """Show the whole map instead of following the ego."""
    follow: float = 110.0
    """Width of the shown area around the ego in metres."""
    size: tuple[int, int] = (1280, 720)
    """Width and height in pixels."""
    fps: float = 25.0
    """Frames per second of a video; positions between ticks are interpolated."""
    speed: float = 1.0
    """Playback speed: seconds of the episode per second."""
    data: str | None = None
    """DATA of the drive, if it has been moved since."""

    def run(self) -> None:
        """Plays the rollouts, writes the video, or prints the list.

        Raises:
            AspEnvError: an option is out of range, there is no screen, or the video cannot be
                written.
            DataError: there is no rollout, or a rollout or its DATA cannot be read.
        """
        self._check()
        rollouts = load_rollouts(self.rollout)
        console = text_console()
        if self.list:
            console.print(_table(self.rollout, rollouts))
            return
        films = make_films(rollouts, self.data)
        if self.video is None:
            playing = PlayerState(films=films, speed=self.speed, whole_map=self.map)
            play(playing, size_px=self.size, extent_m=self.follow)
            return
        extent_m = None if self.map else self.follow
        frames = frames_of(
            films, size_px=self.size, extent_m=extent_m, fps=self.fps, speed=self.speed
        )
        total = sum(len(film.times_s(self.fps, self.speed)) for film in films)
        shown = track(frames, "drawing", total=total, console=console, transient=True)
        count = write_video(self.video, shown, fps=self.fps)
        console.print(f"wrote {self.video}: {count / self.fps:.1f} s", soft_wrap=True)

    def _check(self) -> None:
        if not all(1 <= side <= MAX_SIDE_PX for side in self.size):
            raise AspEnvError(
                f"--size {self.size[0]} {self.size[1]}: expected a width and a height from 1 to "
                f"{MAX_SIDE_PX}"
            )
        for name, value in (("follow", self.follow), ("speed", self.speed)):
            if not 0.01 <= value <= 10_000:
                raise AspEnvError(f"--{name} {value:g}: expected a number from 0.01 to 10000")
        if self.video is not None:
            check_video_possible(self.video, self.size, self.fps)
            if self.video.exists():
                raise AspEnvError(f"{self.video}: exists already; choose another or remove it")


def load_rollouts(path: Path) -> dict[Path, Rollout]:
    """The rollout of a file, or all rollouts below a folder, by path in alphabetical order.

    Raises:
        DataError: there is none, or one cannot be read.
    """
    if not path.exists():
        raise DataError(
            f"{path} does not exist; expected a rollout (.npz), or a folder of asp-env drive"
        )
    if not path.is_dir():
        return {path: Rollout.load(path)}
    files = sorted(each for each in path.rglob("*.npz") if not each.name.startswith("."))
    if not files:
        raise DataError(f"{path}: no rollouts (.npz) below it; asp-env drive writes them")
    return {each: Rollout.load(each) for each in files}


def make_films(rollouts: Mapping[Path, Rollout], data: str | None) -> list[Film]:
    """Rollouts with the maps and background images of their recordings.

    Args:
        rollouts: rollouts by path.
        data: DATA that all of them were driven on; None for the DATA that each rollout names.

    Raises:
        DataError: DATA cannot be opened, or is not what a rollout was driven on.
    """
    sources: dict[tuple[str, float], Recordings] = {}
    films = []
    for path, rollout in rollouts.items():
        source = rollout.scenario.source if data is None else data
        key = (source, rollout.dt_s)
        if key not in sources:
            sources[key] = _open_source(path, *key)
        recording = _find_recording(path, rollout, sources[key])
        try:
            films.append(
                Film(
                    rollout=rollout,
                    road_map=recording.road_map,
                    background=recording.background,
                    title=_title(path, rollout),
                )
            )
        except DataError as error:
            raise DataError(f"{path}: {error}") from error
    return films


def _open_source(path: Path, source: str, dt_s: float) -> Recordings:
    try:
        return open_readable(source, dt_s=dt_s)
    except AspEnvError as error:
        raise DataError(
            f"{path}: was driven on DATA that cannot be opened ({error}); name it with --data"
        ) from error


def _find_recording(path: Path, rollout: Rollout, recordings: Recordings) -> Recording:
    """The recording that a rollout was driven on.

    Raises:
        DataError: no recording has its name, or the ego starts at another position there.
    """
    scenario = rollout.scenario
    problem = f"{path}: was driven on other DATA than {recordings.source!r}"
    if scenario.recording_name not in recordings.names:
        raise DataError(
            f"{problem}, which has no recording {scenario.recording_name!r}; name the "
            "right one with --data"
        )
    recording = recordings[recordings.names.index(scenario.recording_name)]
    track_number = np.flatnonzero(recording.track_ids == scenario.ego_id)
    states, valid = gather_window(
        recording,
        track_number[:1],
        first_tick=scenario.start_tick,
        num_ticks=1,
        stride=frames_per_tick(recording.frame_rate_hz, rollout.dt_s),
    )
    distance_m = np.hypot(*(states[valid] - rollout.log_states[:1, 0])[:, :2].T)
    if not (len(distance_m) and distance_m[0] < SAME_PLACE_M):
        raise DataError(
            f"{problem}, where track {scenario.ego_id} of recording {recording.name} is at another "
            f"position at tick {scenario.start_tick}; name the right one with --data"
        )
    return recording


def _title(path: Path, rollout: Rollout) -> str:
    """Scenario and tags, after the name of the method if the folder is named after it."""
    tags = f" ({', '.join(rollout.scenario.tags)})" if rollout.scenario.tags else ""
    scenario = rollout.scenario.name + tags
    folder = path.absolute().parent
    return f"{folder.name}: {scenario}" if folder.parent.name == "rollouts" else scenario


def _table(folder: Path, rollouts: Mapping[Path, Rollout]) -> Table:
    table = Table(box=None)
    for name in ("rollout", "seconds", "tags", "events"):
        table.add_column(name, overflow="fold")
    for path, rollout in rollouts.items():
        events = np.flatnonzero(rollout.events.any(axis=0)).tolist()
        table.add_row(
            str(path.relative_to(folder) if path != folder else path),
            f"{(len(rollout.states) - 1) * rollout.dt_s:.1f}",
            ", ".join(rollout.scenario.tags),
            ", ".join(rollout.event_names[kind] for kind in events),
        )
    return table

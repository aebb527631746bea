"""A rollout as a picture for every time, between its ticks too.

MERGED: Pictures become a video that browsers play.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

from asp_env.data.recording import Background
from asp_env.data.road_map import RoadMap
from asp_env.data.rollout import Rollout
from asp_env.errors import AspEnvError, DataError, MissingExtraError
from asp_env.files import atomic_file
from asp_env.geometry import between_states
from asp_env.render.canvas import Colour
from asp_env.render.frames import (
    EGO,
    EGO_COLOUR,
    FORECAST,
    GHOST,
    PLAN,
    FrameContents,
    draw_contents,
    draw_hint,
    draw_legend,
    draw_time_line,
)

ALARM: Colour = (255, 84, 104)
WARNING: Colour = (255, 193, 69)
TRAIL_S = 3.0
STILL_S = 1.0
"""A film ends with its last picture for so long: what ended the episode is seen."""
_NEAR = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Film:
    """A rollout with the place where it happened."""

    rollout: Rollout
    road_map: RoadMap
    background: Background | None
    title: str

    def __post_init__(self) -> None:
        """Checks that all that is drawn has a place.

        Raises:
            DataError: a position is not a finite number.
        """
        for name in ("states", "log_states", "sizes", "route", "plans", "forecast_states"):
            if not np.isfinite(getattr(self.rollout, name)).all():
                raise DataError(f"{name}: expected finite numbers")

    @property
    def duration_s(self) -> float:
        """From the first tick to the last."""
        return (len(self.rollout.states) - 1) * self.rollout.dt_s

    def times_s(self, fps: float, speed: float = 1.0) -> Float[np.ndarray, " frames"]:
        """The times to show at a frame rate: evenly from the first tick, the last one repeated."""
        moving = int(np.ceil(self.duration_s * fps / speed - _NEAR))
        times = np.arange(moving) * (speed / fps)
        return np.concatenate([times, np.full(1 + round(STILL_S * fps), self.duration_s)])

    def frame(
        self, time_s: float, *, size_px: tuple[int, int], extent_m: float | None, hint: str = ""
    ) -> UInt8[np.ndarray, "height width 3"]:
        """The picture at a time in RGB; the same arguments give the same bits.

        Args:
            time_s: since the first tick. Positions between two ticks are interpolated; forecast
                and plan are the last ones said.
            size_px: width and height.
            extent_m: width of what is shown about the ego; None shows the whole map.
            hint: words to the user, below in the middle.

        Raises:
            AspEnvError: a size is not positive.
            DataError: the background picture cannot be read.
        """
        moment = self.moment(time_s)
        canvas = draw_contents(moment, size_px=size_px, extent_m=extent_m)
        entries = [("ego", EGO_COLOUR), ("recorded ego", GHOST)]
        if len(self.rollout.plans):
            entries.append(("plan", PLAN))
        if len(self.rollout.forecast_ticks):
            entries.append(("forecasts", FORECAST))
        draw_legend(canvas, entries)
        draw_hint(canvas, hint)
        whole_s = max(self.duration_s, self.rollout.dt_s)
        draw_time_line(canvas, min(time_s / whole_s, 1.0), self._spells())
        return canvas.image

    def moment(self, time_s: float) -> FrameContents:
        """What is shown at a time."""
        rollout = self.rollout
        last = len(rollout.states) - 1
        at = float(np.clip(time_s / rollout.dt_s, 0, last))
        tick = min(int(at + _NEAR), last)
        share = max(at - tick, 0.0)
        first = max(tick - round(TRAIL_S / rollout.dt_s), 0)
        now, present = _between(rollout.states, rollout.valid, tick, share)
        past, seen = rollout.states[first : tick + 1], rollout.valid[first : tick + 1]
        log, logged = _between(rollout.log_states[:, :1], rollout.log_valid[:, :1], tick, share)
        rows, gone = self._forecast_rows(tick)
        plan_tick = min(tick, len(rollout.plans) - 1)
        plan = rollout.plans[plan_tick, tick - plan_tick :] if plan_tick >= 0 else past[:0, EGO, :2]
        return FrameContents(
            road_map=self.road_map,
            background=self.background,
            states=np.concatenate([past, now[None]]).swapaxes(0, 1),
            valid=np.concatenate([seen, present[None]]).swapaxes(0, 1),
            sizes=rollout.sizes,
            classes=rollout.classes,
            route=rollout.route,
            modes=rollout.forecast_states[rows],
            probabilities=np.exp(rollout.forecast_log_probs[rows]),
            slots=rollout.forecast_slots[rows],
            steps_gone=gone,
            plan=plan,
            logged_ego=log[EGO] if logged[EGO] else None,
            words=(
                f"{time_s:.1f} / {self.duration_s:.1f} s   {now[EGO, 3]:.1f} m/s",
                self.title,
            ),
            alarms=_alarms(rollout.event_names, rollout.events[tick]),
        )

    def _forecast_rows(
        self, tick: int
    ) -> tuple[Shaped[np.ndarray, " rows"], Shaped[np.ndarray, " rows"]]:
        """The rows of the last tick at which anything was forecast, and how many steps ago."""
        ticks = self.rollout.forecast_ticks
        said = ticks[ticks <= tick]
        rows = np.flatnonzero(ticks == said.max()) if len(said) else np.zeros(0, dtype=np.int64)
        return rows, tick - ticks[rows]

    def _spells(self) -> list[tuple[float, float, Colour]]:
        """When something was wrong, the gravest last."""
        steps = max(len(self.rollout.states) - 1, 1)
        spells = []
        for kind, name in enumerate(self.rollout.event_names):
            edges = np.diff(self.rollout.events[:, kind].astype(np.int8), prepend=0, append=0)
            begins, ends = np.flatnonzero(edges > 0) / steps, np.flatnonzero(edges < 0) / steps
            for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
                spells.append((begin, min(end, 1.0), _colour(name)))
        return sorted(spells, key=lambda spell: spell[2] == ALARM)


def _between(
    states: Shaped[np.ndarray, "ticks a 4"],
    valid: Bool[np.ndarray, "ticks a"],
    tick: int,
    share: float,
) -> tuple[Shaped[np.ndarray, "a 4"], Bool[np.ndarray, " a"]]:
    """Who is there at a share of the way to the next tick; who leaves stays in place till then."""
    following = min(tick + 1, len(states) - 1)
    moved = between_states(states[tick], states[following], share)
    both = valid[tick] & valid[following]
    return np.where(both[:, None], moved, states[tick]), valid[tick]


def _colour(event: str) -> Colour:
    return ALARM if event.endswith("collision") else WARNING


def _alarms(
    names: Sequence[str], holds: Bool[np.ndarray, " kinds"]
) -> tuple[tuple[str, Colour], ...]:
    """What is wrong, the gravest first; a name within another one, as "collision", is left out."""
    wrong = [name for name, held in zip(names, holds, strict=True) if held]
    told = [name for name in wrong if not any(name in other for other in wrong if other != name)]
    return tuple(
        sorted(((name, _colour(name)) for name in told), key=lambda alarm: alarm[1] != ALARM)
    )


def frames_of(
    films: Sequence[Film],
    *,
    size_px: tuple[int, int],
    extent_m: float | None,
    fps: float,
    speed: float,
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """The pictures of films, one after the other."""
    for film in films:
        shown: tuple[float, UInt8[np.ndarray, "height width 3"]] | None = None
        for time_s in film.times_s(fps, speed).tolist():
            if shown is None or shown[0] != time_s:
                shown = (time_s, film.frame(time_s, size_px=size_px, extent_m=extent_m))
            yield shown[1]


MAX_SIDE_PX = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class _Kind:
    container: str
    container_options: Mapping[str, str]
    codec: str
    codec_options: Mapping[str, str]


KINDS: Mapping[str, _Kind] = {
    ".mp4": _Kind(
        container="mp4",
        # The index stands first, so that a browser can play before it has read everything.
        container_options={"movflags": "+faststart", "fflags": "+bitexact"},
        codec="libx264",
        # With its macroblock tree x264 gives other bytes each time, for some sizes of picture.
        codec_options={"crf": "21", "preset": "medium", "x264-params": "mbtree=0"},
    ),
    ".webm": _Kind(
        container="webm",
        container_options={"fflags": "+bitexact"},
        codec="libvpx-vp9",
        codec_options={"crf": "30", "b": "0", "deadline": "good", "cpu-used": "4"},
    ),
}
"""By the ending of the file's name."""
BT709 = 1
"""The number of these primaries, transfer curve and matrix: without it browsers guess by size."""
LIMITED_RANGE = 1


def check_video_possible(path: Path, size_px: tuple[int, int], fps: float) -> None:
    """Refuses a video that cannot be written, before its first picture is drawn.

    Raises:
        AspEnvError: the name's ending, the size or the frame rate is not possible.
        MissingExtraError: the package that encodes is not installed.
    """
    if path.suffix.lower() not in KINDS:
        known = " or ".join(KINDS)
        raise AspEnvError(f"video {path}: expected a name that ends in {known}")
    if not all(16 <= side <= MAX_SIDE_PX and side % 2 == 0 for side in size_px):
        raise AspEnvError(
            f"size {size_px[0]} {size_px[1]}: a video's width and height are even numbers from 16 "
            f"to {MAX_SIDE_PX}"
        )
    if not 1 <= fps <= 240:
        raise AspEnvError(f"frame rate {fps}: expected 1 to 240 a second")
    if find_spec("av") is None:
        raise MissingExtraError("av", "render", "a video")


def write_video(
    path: Path, frames: Iterable[UInt8[np.ndarray, "height width 3"]], *, fps: float
) -> int:
    """Writes RGB pictures of equal, even size as H.264 (`.mp4`) or VP9 (`.webm`).

    The file is written aside and then renamed: it is there whole or not at all, and replaces one
    that was there. One thread encodes, so that the same pictures give the same bytes.

    Args:
        path: the video.
        frames: pictures, drawn as they are needed.
        fps: pictures a second.

    Returns:
        How many pictures there were.

    Raises:
        AspEnvError: the file cannot be written, or there are no pictures or such of different
            sizes.
        MissingExtraError: the package that encodes is not installed.
    """
    pictures = iter(frames)
    first = next(pictures, None)
    if first is None:
        raise AspEnvError(f"video {path}: there is nothing to show")
    check_video_possible(path, (first.shape[1], first.shape[0]), fps)
    try:
        with atomic_file(path) as partial:
            count = _encode(partial, first, pictures, KINDS[path.suffix.lower()], fps)
    except OSError as error:
        raise AspEnvError(f"video {path}: cannot be written ({error.strerror or error})") from error
    return count


def _encode(
    path: Path, first: np.ndarray, rest: Iterable[np.ndarray], kind: _Kind, fps: float
) -> int:
    import av

    if kind.codec not in av.codecs_available:
        raise AspEnvError(f"this build of av has no {kind.codec}: pip install --force-reinstall av")
    rate = Fraction(fps).limit_denominator(1001)
    count = 0
    with av.open(
        str(path), "w", format=kind.container, options=dict(kind.container_options)
    ) as container:
        stream = container.add_stream(kind.codec, rate=rate, options=dict(kind.codec_options))
        assert isinstance(stream, av.VideoStream)
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt = "yuv420p"
        context = stream.codec_context
        context.thread_count = 1
        context.time_base = 1 / rate
        context.color_primaries = context.color_trc = context.colorspace = BT709
        context.color_range = LIMITED_RANGE
        for image in chain((first,), rest):
            if image.shape != first.shape:
                raise AspEnvError(f"picture {count}: {image.shape}, the first was {first.shape}")
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709")
            frame.pts, frame.time_base = count, 1 / rate
            container.mux(stream.encode(frame))
            count += 1
        container.mux(stream.encode(None))
    return count

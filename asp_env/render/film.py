"""Rollouts as videos: a frame for any time of a rollout, and files that browsers play."""

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
    FORECAST_COLOUR,
    PLAN_COLOUR,
    RECORDED_EGO_COLOUR,
    FrameContents,
    draw_contents,
    draw_hint,
    draw_legend,
    draw_time_line,
)

ALARM_COLOUR: Colour = (255, 84, 104)
WARNING_COLOUR: Colour = (255, 193, 69)
TRAIL_S = 3.0
STILL_S = 1.0
"""The last frame of a film is repeated for this long, which shows what ended the episode."""
MAX_SIDE_PX = 4096
_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Film:
    """A rollout with the map and the background of its recording."""

    rollout: Rollout
    road_map: RoadMap
    background: Background | None
    title: str

    def __post_init__(self) -> None:
        """Checks that all positions can be drawn.

        Raises:
            DataError: A position is not a finite number.
        """
        for name in ("states", "log_states", "sizes", "route", "plans", "forecast_states"):
            if not np.isfinite(getattr(self.rollout, name)).all():
                raise DataError(f"{name}: expected finite numbers")

    @property
    def duration_s(self) -> float:
        """Time from the first tick to the last."""
        return (len(self.rollout.states) - 1) * self.rollout.dt_s

    def times_s(self, fps: float, speed: float = 1.0) -> Float[np.ndarray, " frames"]:
        """The times of the frames of a video.

        Args:
            fps: Frames per second.
            speed: Seconds of the rollout per second of the video.

        Returns:
            Equidistant times from the first tick on, s; the last one is repeated for `STILL_S`.
        """
        moving = int(np.ceil(self.duration_s * fps / speed - _TOLERANCE))
        times = np.arange(moving) * (speed / fps)
        return np.concatenate([times, np.full(1 + round(STILL_S * fps), self.duration_s)])

    def frame(
        self, time_s: float, *, size_px: tuple[int, int], extent_m: float | None, hint: str = ""
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Draws the frame at a time; equal arguments give equal bits.

        Args:
            time_s: Time since the first tick. Positions are interpolated between ticks; forecasts
                and the plan are the latest ones.
            size_px: Width and height.
            extent_m: Width of the area around the ego; None shows the whole map.
            hint: A text at the bottom in the middle.

        Returns:
            An RGB image.

        Raises:
            AspEnvError: A size is not positive.
            DataError: The background image cannot be read.
        """
        contents = self.contents(time_s)
        canvas = draw_contents(contents, size_px=size_px, extent_m=extent_m)
        entries = [("ego", EGO_COLOUR), ("recorded ego", RECORDED_EGO_COLOUR)]
        if len(self.rollout.plans):
            entries.append(("plan", PLAN_COLOUR))
        if len(self.rollout.forecast_ticks):
            entries.append(("forecasts", FORECAST_COLOUR))
        draw_legend(canvas, entries)
        draw_hint(canvas, hint)
        duration_s = max(self.duration_s, self.rollout.dt_s)
        draw_time_line(canvas, min(time_s / duration_s, 1.0), self._event_intervals())
        return canvas.image

    def contents(self, time_s: float) -> FrameContents:
        """The contents of the frame at a time."""
        rollout = self.rollout
        last = len(rollout.states) - 1
        position = float(np.clip(time_s / rollout.dt_s, 0, last))
        tick = min(int(position + _TOLERANCE), last)
        share = max(position - tick, 0.0)
        first = max(tick - round(TRAIL_S / rollout.dt_s), 0)
        now, present = _between(rollout.states, rollout.valid, tick, share)
        past, past_valid = rollout.states[first : tick + 1], rollout.valid[first : tick + 1]
        log, log_valid = _between(rollout.log_states[:, :1], rollout.log_valid[:, :1], tick, share)
        rows, elapsed = self._forecast_rows(tick)
        plan_tick = min(tick, len(rollout.plans) - 1)
        plan = rollout.plans[plan_tick, tick - plan_tick :] if plan_tick >= 0 else past[:0, EGO, :2]
        return FrameContents(
            road_map=self.road_map,
            background=self.background,
            states=np.concatenate([past, now[None]]).swapaxes(0, 1),
            valid=np.concatenate([past_valid, present[None]]).swapaxes(0, 1),
            sizes=rollout.sizes,
            classes=rollout.classes,
            route=rollout.route,
            modes=rollout.forecast_states[rows],
            probabilities=np.exp(rollout.forecast_log_probs[rows]),
            slots=rollout.forecast_slots[rows],
            elapsed_steps=elapsed,
            plan=plan,
            recorded_ego=log[EGO] if log_valid[EGO] else None,
            caption=(
                f"{time_s:.1f} / {self.duration_s:.1f} s   {now[EGO, 3]:.1f} m/s",
                self.title,
            ),
            alarms=_alarms(rollout.event_names, rollout.events[tick]),
        )

    def _forecast_rows(
        self, tick: int
    ) -> tuple[Shaped[np.ndarray, " rows"], Shaped[np.ndarray, " rows"]]:
        """Rows of the latest tick with forecasts, and the steps that have passed since."""
        ticks = self.rollout.forecast_ticks
        past = ticks[ticks <= tick]
        rows = np.flatnonzero(ticks == past.max()) if len(past) else np.zeros(0, dtype=np.int64)
        return rows, tick - ticks[rows]

    def _event_intervals(self) -> list[tuple[float, float, Colour]]:
        """(begin, end, colour) of events, as shares of the time, the most serious last."""
        steps = max(len(self.rollout.states) - 1, 1)
        intervals = []
        for kind, name in enumerate(self.rollout.event_names):
            edges = np.diff(self.rollout.events[:, kind].astype(np.int8), prepend=0, append=0)
            begins, ends = np.flatnonzero(edges > 0) / steps, np.flatnonzero(edges < 0) / steps
            for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
                intervals.append((begin, min(end, 1.0), _event_colour(name)))
        return sorted(intervals, key=lambda interval: interval[2] == ALARM_COLOUR)


def _between(
    states: Shaped[np.ndarray, "ticks a 4"],
    valid: Bool[np.ndarray, "ticks a"],
    tick: int,
    share: float,
) -> tuple[Shaped[np.ndarray, "a 4"], Bool[np.ndarray, " a"]]:
    """States and mask between two ticks; an agent that leaves stands still until the next tick."""
    following = min(tick + 1, len(states) - 1)
    moved = between_states(states[tick], states[following], share)
    both = valid[tick] & valid[following]
    return np.where(both[:, None], moved, states[tick]), valid[tick]


def _event_colour(name: str) -> Colour:
    return ALARM_COLOUR if name.endswith("collision") else WARNING_COLOUR


def _alarms(
    names: Sequence[str], active: Bool[np.ndarray, " kinds"]
) -> tuple[tuple[str, Colour], ...]:
    """Active events, the most serious first.

    An event whose name is part of another's is left out: "collision" beside "at-fault collision".
    """
    events = [name for name, is_active in zip(names, active, strict=True) if is_active]
    shown = [name for name in events if not any(name in other for other in events if other != name)]
    alarms = [(name, _event_colour(name)) for name in shown]
    return tuple(sorted(alarms, key=lambda alarm: alarm[1] != ALARM_COLOUR))


def frames_of(
    films: Sequence[Film],
    *,
    size_px: tuple[int, int],
    extent_m: float | None,
    fps: float,
    speed: float,
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """The frames of films, one film after the other.

    Args:
        films: The films.
        size_px: Width and height.
        extent_m: Width of the area around the ego; None shows the whole map.
        fps: Frames per second.
        speed: Seconds of a rollout per second of the video.
    """
    for film in films:
        latest: tuple[float, UInt8[np.ndarray, "height width 3"]] | None = None
        for time_s in film.times_s(fps, speed).tolist():
            if latest is None or latest[0] != time_s:
                latest = (time_s, film.frame(time_s, size_px=size_px, extent_m=extent_m))
            yield latest[1]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Format:
    container: str
    container_options: Mapping[str, str]
    codec: str
    codec_options: Mapping[str, str]


FORMATS: Mapping[str, _Format] = {
    ".mp4": _Format(
        container="mp4",
        # The index comes first, so that a browser can play the video before it is read to its end.
        container_options={"movflags": "+faststart", "fflags": "+bitexact"},
        codec="libx264",
        # With its macroblock tree, x264 is not deterministic for some sizes.
        codec_options={"crf": "21", "preset": "medium", "x264-params": "mbtree=0"},
    ),
    ".webm": _Format(
        container="webm",
        container_options={"fflags": "+bitexact"},
        codec="libvpx-vp9",
        codec_options={"crf": "30", "b": "0", "deadline": "good", "cpu-used": "4"},
    ),
}
"""Video formats by the suffix of the file name."""
BT709 = 1
"""Code of BT.709 for primaries, transfer function and matrix, which browsers guess if missing."""
LIMITED_RANGE = 1


def check_video_possible(path: Path, size_px: tuple[int, int], fps: float) -> None:
    """Checks that a video can be written, before its first frame is drawn.

    Args:
        path: The file to write.
        size_px: Width and height.
        fps: Frames per second.

    Raises:
        AspEnvError: The suffix, the size or the frame rate is not supported.
        MissingExtraError: The package that encodes videos is not installed.
    """
    if path.suffix.lower() not in FORMATS:
        known = " or ".join(FORMATS)
        raise AspEnvError(f"video {path}: expected a name that ends in {known}")
    if not all(16 <= side <= MAX_SIDE_PX and side % 2 == 0 for side in size_px):
        raise AspEnvError(
            f"size {size_px[0]} {size_px[1]}: a video's width and height are even numbers from 16 "
            f"to {MAX_SIDE_PX}"
        )
    if not 1 <= fps <= 240:
        raise AspEnvError(f"frame rate {fps}: expected 1 to 240 per second")
    if find_spec("av") is None:
        raise MissingExtraError("av", "render", "a video")


def write_video(
    path: Path, frames: Iterable[UInt8[np.ndarray, "height width 3"]], *, fps: float
) -> int:
    """Writes RGB images of equal, even size as H.264 (`.mp4`) or VP9 (`.webm`).

    The video is written to a temporary file and renamed, so that no incomplete file remains; an
    existing file is replaced. A single thread encodes: equal images give equal bytes.

    Args:
        path: The file to write.
        frames: The images, drawn on demand.
        fps: Frames per second.

    Returns:
        The number of frames.

    Raises:
        AspEnvError: The file cannot be written, there are no images, or their sizes differ.
        MissingExtraError: The package that encodes videos is not installed.
    """
    images = iter(frames)
    first = next(images, None)
    if first is None:
        raise AspEnvError(f"video {path}: there are no frames")
    check_video_possible(path, (first.shape[1], first.shape[0]), fps)
    try:
        with atomic_file(path) as partial:
            count = _encode(partial, first, images, FORMATS[path.suffix.lower()], fps)
    except OSError as error:
        raise AspEnvError(f"video {path}: cannot be written ({error.strerror or error})") from error
    return count


def _encode(
    path: Path, first: np.ndarray, rest: Iterable[np.ndarray], video_format: _Format, fps: float
) -> int:
    import av

    if video_format.codec not in av.codecs_available:
        raise AspEnvError(
            f"this build of av has no {video_format.codec}: pip install --force-reinstall av"
        )
    rate = Fraction(fps).limit_denominator(1001)
    count = 0
    with av.open(
        str(path), "w", format=video_format.container, options=dict(video_format.container_options)
    ) as container:
        stream = container.add_stream(
            video_format.codec, rate=rate, options=dict(video_format.codec_options)
        )
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
                raise AspEnvError(f"frame {count}: {image.shape}, the first was {first.shape}")
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709")
            frame.pts, frame.time_base = count, 1 / rate
            container.mux(stream.encode(frame))
            count += 1
        container.mux(stream.encode(None))
    return count

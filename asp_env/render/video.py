"""Pictures become a video that browsers play."""

import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from asp_env.errors import AspEnvError, MissingExtraError

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
    home = next(folder for folder in path.absolute().parents if folder.exists())
    aside = home / f".{path.name}.{os.getpid()}.partial"
    try:
        count = _encode(aside, first, pictures, KINDS[path.suffix.lower()], fps)
        path.parent.mkdir(parents=True, exist_ok=True)
        aside.replace(path)
    except OSError as error:
        raise AspEnvError(f"video {path}: cannot be written ({error.strerror or error})") from error
    finally:
        with suppress(OSError):
            aside.unlink()
    return count


def _encode(
    aside: Path, first: np.ndarray, rest: Iterable[np.ndarray], kind: _Kind, fps: float
) -> int:
    import av

    if kind.codec not in av.codecs_available:
        raise AspEnvError(f"this build of av has no {kind.codec}: pip install --force-reinstall av")
    rate = Fraction(fps).limit_denominator(1001)
    count = 0
    with av.open(
        str(aside), "w", format=kind.container, options=dict(kind.container_options)
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

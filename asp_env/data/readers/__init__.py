"""Readers: recordings and maps from the files of published datasets."""

from asp_env.data.readers.interaction import InteractionFiles, read_interaction
from asp_env.data.readers.lanelet2 import parse_lanelet2, read_lanelet2
from asp_env.data.readers.layout import TrackTable
from asp_env.data.readers.levelx import LevelxFiles, read_levelx
from asp_env.data.readers.opening import (
    ReaderState,
    RecordingFiles,
    content_hash,
    open_recording,
)
from asp_env.data.readers.positions import Origin

__all__ = [
    "InteractionFiles",
    "LevelxFiles",
    "Origin",
    "ReaderState",
    "RecordingFiles",
    "TrackTable",
    "content_hash",
    "open_recording",
    "parse_lanelet2",
    "read_interaction",
    "read_lanelet2",
    "read_levelx",
]

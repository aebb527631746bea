"""Readers: recordings and maps from the files of published datasets."""

from asp_env.data.readers.found import FoundRecording, RecordingTables, SignalChanges
from asp_env.data.readers.interaction import InteractionFiles, read_interaction
from asp_env.data.readers.lanelet2 import parse_lanelet2, read_lanelet2
from asp_env.data.readers.layout import ClassNames, TrackTable
from asp_env.data.readers.levelx import LevelxFiles, read_levelx
from asp_env.data.readers.measurements import Measurements
from asp_env.data.readers.opening import (
    ReaderState,
    RecordingFiles,
    content_hash,
    open_recording,
)
from asp_env.data.readers.positions import Origin
from asp_env.data.readers.tables import has_columns, read_table

__all__ = [
    "ClassNames",
    "FoundRecording",
    "InteractionFiles",
    "LevelxFiles",
    "Measurements",
    "Origin",
    "ReaderState",
    "RecordingFiles",
    "RecordingTables",
    "SignalChanges",
    "TrackTable",
    "content_hash",
    "has_columns",
    "open_recording",
    "parse_lanelet2",
    "read_interaction",
    "read_lanelet2",
    "read_levelx",
    "read_table",
]

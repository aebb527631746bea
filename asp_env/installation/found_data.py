"""The recordings that each reader finds in a folder, read one after the other."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass

from asp_env.data.readers.layout import archive_hint
from asp_env.data.source import Recordings, find_by_reader, source_folder
from asp_env.errors import AspEnvError, DataError


@dataclass(frozen=True, slots=True, kw_only=True)
class ReaderFindings:
    """What a reader finds in a folder."""

    reader: str
    num_found: int
    num_readable: int
    num_tracks: int
    duration_s: float
    num_repairs: int
    """Number of lines under Repairs in `asp-env inspect`."""
    problems: tuple[str, ...]
    """One line for each recording that cannot be read, or one for a reader that fails."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FolderFindings:
    """What all readers find in a folder."""

    data: str
    """The folder as it was given."""
    readers: tuple[ReaderFindings, ...]
    """The readers that find something, or fail."""
    problems: tuple[str, ...]
    """All problems of the folder."""


def examine(data: str, *, progress: Callable[[str], None]) -> FolderFindings:
    """Offers a folder to every reader, and reads what they find.

    Args:
        data: a folder, or another DATA such as `sample:intersection`.
        progress: called with the name of each recording before it is read.

    Raises:
        AspEnvError: the source is unknown.
        DataError: the folder does not exist.
    """
    if not data:
        raise AspEnvError("FOLDER '': expected a folder with recordings")
    folder = source_folder(data)
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "does not exist"
        raise DataError(f"{data}: {folder} {what}; expected a folder with recordings")
    readers = []
    for reader, found in find_by_reader(folder).items():
        if isinstance(found, AspEnvError):
            readers.append(_failed(reader, str(found)))
        elif found:
            readers.append(_read_all(reader, Recordings(data, found), progress))
    problems = [problem for each in readers for problem in each.problems]
    if not any(each.num_found for each in readers):
        problems.append(
            f"{data}: no reader finds recordings in it{archive_hint(folder)}; "
            "asp-env datasets lists the folders that readers expect"
        )
    return FolderFindings(data=data, readers=tuple(readers), problems=tuple(problems))


def _failed(reader: str, problem: str) -> ReaderFindings:
    return ReaderFindings(
        reader=reader,
        num_found=0,
        num_readable=0,
        num_tracks=0,
        duration_s=0.0,
        num_repairs=0,
        problems=(problem,),
    )


def _read_all(
    reader: str, recordings: Recordings, progress: Callable[[str], None]
) -> ReaderFindings:
    problems = []
    num_readable, num_tracks, duration_s = 0, 0, 0.0
    repairs: set[str] = set()
    for number, name in enumerate(recordings.names):
        progress(name)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # repairs are counted, caches are checked
                recording = recordings[number]
        except AspEnvError as error:
            problems.append(" ".join(f"recording {name}: {error}".split()))
            continue
        num_readable += 1
        num_tracks += len(recording)
        duration_s += recording.duration_s
        repairs |= {f"{name}: {line}" for line in recording.repairs}
        repairs |= {f"{recording.road_map.name}: {line}" for line in recording.road_map.repairs}
    return ReaderFindings(
        reader=reader,
        num_found=len(recordings),
        num_readable=num_readable,
        num_tracks=num_tracks,
        duration_s=round(duration_s, 1),
        num_repairs=len(repairs),
        problems=tuple(problems),
    )

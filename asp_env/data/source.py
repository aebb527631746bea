"""Sources of data: `open_data` finds the recordings that a folder or a source's name stands for."""

import hashlib
import os
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any, SupportsIndex, overload

from asp_env import registry
from asp_env.arguments import shown
from asp_env.data.readers.compressed import CSV
from asp_env.data.readers.layout import ARCHIVE, archive_hint, shorten, walk
from asp_env.data.readers.levelx import LevelxFiles
from asp_env.data.readers.opening import (
    ReaderState,
    RecordingFiles,
    content_hash,
    find_copies,
    open_recording,
)
from asp_env.data.recording import DEFAULT_DT_S, Recording, check_duration
from asp_env.errors import (
    AspEnvError,
    DataError,
    LeftOutWarning,
    RepairWarning,
    StaleInstallError,
    unknown_name,
)
from asp_env.stored import brief

_FIRST = ("levelx", "interaction")
"""Readers whose recordings stand before those of others."""

SHOWN_REPAIRS = 3
"""Number of repairs that a warning names."""

_SCHEME = re.compile(r"^([a-z][a-z0-9-]+):(.*)$", re.DOTALL)


class Recordings(Sequence[Any]):  # not of Recording: run-time checks of its items would open them
    """A sequence of recordings, each of which is read at its first access and then stays open.

    Attributes:
        source: the data as the user named them.
        names: the recordings' ids, such as `00`.
        files: the files of each recording.
        dt_s: seconds per tick that the recordings are opened for.
        repairs: one line for each recording that `open_data` leaves out, since its tables are
            those of another one.
    """

    def __init__(
        self,
        source: str,
        files: Sequence[RecordingFiles],
        *,
        dt_s: float = DEFAULT_DT_S,
        opened: ReaderState | None = None,
        quiet: bool = False,
        repairs: tuple[str, ...] = (),
    ) -> None:
        """Creates the sequence without reading any recording.

        Args:
            source: the data as the user named them.
            files: the files of each recording.
            dt_s: seconds per tick. Recordings of which it is no whole number of frames are
                resampled.
            opened: the recordings that are already open, for the same `dt_s`.
            quiet: whether repairs of maps are not warned of when a recording is opened, because
                the caller reports them.
            repairs: one line for each recording that is left out.
        """
        self.source = source
        self.names = tuple(each.name for each in files)
        self.files = tuple(files)
        self.dt_s = dt_s
        self.repairs = repairs
        self._opened = ReaderState(dt_s=dt_s, quiet=quiet) if opened is None else opened

    def __deepcopy__(self, memo: dict[int, Any]) -> "Recordings":
        """Returns the same object, since recordings are immutable."""
        del memo
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy in another process opens its files again, mapped from the same cache."""
        options = {"dt_s": self.dt_s, "quiet": self._opened.quiet}
        return partial(Recordings, **options), (self.source, self.files)

    def __len__(self) -> int:
        """Number of recordings."""
        return len(self.files)

    @overload
    def __getitem__(self, index: SupportsIndex) -> Recording: ...
    @overload
    def __getitem__(self, index: slice) -> "Recordings": ...
    def __getitem__(self, index: SupportsIndex | slice) -> "Recording | Recordings":
        """Opens one recording, or selects several without opening them.

        Raises:
            DataError: the recording's files are damaged.
            AspEnvError: its frames are too far apart for the tick.
            IndexError: there is no such recording.
            TypeError: the index is neither a number nor a slice.
        """
        if isinstance(index, slice):
            return self.subset(range(len(self))[index])
        try:
            files = self.files[index]
        except IndexError:
            raise IndexError(
                f"recording {shown(index)}: expected 0 to {len(self) - 1}, or -{len(self)} to -1"
            ) from None
        except TypeError:
            raise TypeError(
                f"recording {shown(index)}: expected a whole number or a slice"
            ) from None
        return open_recording(files, self._opened)

    def __iter__(self) -> Iterator[Recording]:
        """Opens one recording after the other."""
        return (self[index] for index in range(len(self)))

    def subset(self, indices: Iterable[SupportsIndex]) -> "Recordings":
        """The recordings at some indices, sharing those that are open."""
        files = [self.files[index] for index in indices]
        return Recordings(self.source, files, dt_s=self.dt_s, opened=self._opened)

    @property
    def quiet(self) -> bool:
        """Whether repairs of maps are not warned of, because they have been reported."""
        return self._opened.quiet

    def tracks_path(self, index: SupportsIndex) -> Path:
        """The file with the tracks of one recording; worlds may store more files beside it."""
        return self.files[index].tracks

    def hashes(self) -> tuple[str, ...]:
        """A hash of the content of each recording's files and map.

        Raises:
            DataError: a file is missing.
        """
        return tuple(content_hash(files, self._opened) for files in self.files)

    def resampled(self) -> dict[str, dict[str, float]]:
        """The frame rates of the recordings that are open and resampled, for manifests.

        Returns:
            By name of the recording: the rate of its files as `from_hz`, its own as `to_hz`.
        """
        opened = self._opened.recordings
        return {
            name: {"from_hz": each.resampled_from_hz, "to_hz": each.frame_rate_hz}
            for name in self.names
            if (each := opened.get(name)) and each.resampled_from_hz is not None
        }

    def data_hash(self) -> str:
        """A hash of the content of all recordings, independent of the folder's name.

        Raises:
            DataError: a file is missing.
        """
        return hashlib.sha256("".join(self.hashes()).encode()).hexdigest()


def open_data(data: str | Path, *, dt_s: float = DEFAULT_DT_S) -> Recordings:
    """Finds recordings; each is read at its first access.

    Recordings of which a tick is a whole number of frames are read as they are. The others are
    resampled to the nearest frame rate for which it is. A recording whose tables have the same
    content as those of an earlier one, byte for byte, is left out with a warning.

    Args:
        data: a folder with recordings in layouts of the registered readers, such as those of inD,
            rounD and INTERACTION; `sample:intersection` or `sample:roundabout`; or
            `scheme:argument` of a registered source.
        dt_s: seconds per tick with which the recordings will be used.

    Returns:
        The recordings, sorted by name within each layout.

    Raises:
        AspEnvError: the source is unknown.
        DataError: the folder does not exist, or has no recordings.
    """
    if not isinstance(data, str | Path) or not str(data):
        raise AspEnvError(
            f"data {shown(data)}: expected a folder with recordings, or a text scheme:argument"
        )
    source = str(data)
    check_duration("time step", dt_s)
    folder = source_folder(source)
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "does not exist"
        if folder.exists() and ARCHIVE.search(folder.name):
            what = "is an archive, unpack it first"
        hint = f": give the folder that it is in, {folder.parent}" if what == "is a file" else ""
        raise DataError(
            f"data {source!r}: {folder} {what}; expected a folder with recordings{hint}"
        )
    files = _find(folder)
    if not files:
        raise DataError(
            f"data {source!r}: no recordings found; expected XX_recordingMeta.csv, "
            "XX_tracksMeta.csv and XX_tracks.csv, or LOCATION/vehicle_tracks_NNN.csv, or the "
            f"files of another reader ({', '.join(registry.names('readers'))}), in the folder or "
            f"below{_tables_hint(folder)}{archive_hint(folder)}"
        )
    once, repairs = _without_copies(files)
    by_name: dict[str, RecordingFiles] = {}
    for each in once:
        other = by_name.setdefault(each.name, each)
        if other is not each:
            raise DataError(
                f"data {source!r}: two recordings are called {each.name}, expected unique names: "
                f"{other.tracks} and {each.tracks}; rename the file or folder of one, or give "
                "their folders one at a time"
            )
    if repairs:
        warnings.warn(
            f"data {source!r}: {len(repairs)} of {len(files)} recordings are in it twice: "
            f"{shorten(repairs, SHOWN_REPAIRS)} (asp-env inspect lists all repairs)",
            RepairWarning,
            stacklevel=2,
        )
    return Recordings(source, once, dt_s=dt_s, repairs=tuple(repairs))


def _without_copies(
    files: Sequence[RecordingFiles],
) -> tuple[list[RecordingFiles], list[str]]:
    """The recordings without those whose tables are those of another one, and a line for these."""
    copies = find_copies(files)
    lines = []
    for copy, first in copies.items():
        name, other = files[copy].name, files[first].name
        if name == other:
            name, other = (f"{name} ({files[each].tracks})" for each in (copy, first))
        lines.append(f"recording {name}: left out, since its tables are those of {other}")
    return [each for number, each in enumerate(files) if number not in copies], lines


def _tables_hint(folder: Path) -> str:
    """The end of an error message that names tables and maps which no reader uses; may be empty."""
    names = [
        name
        for _, names in walk(folder)
        for name in names
        if re.search(rf"(?:{CSV}|\.osm)$", name, re.IGNORECASE)
    ]
    if not names:
        return ""
    return f"; {shorten(names, 3)} are there, with other names or columns, or without the others"


def open_readable(
    data: str | Path, *, dt_s: float = DEFAULT_DT_S, strict: bool = False
) -> Recordings:
    """Finds recordings, reads all, and leaves out those that cannot be read, with one warning.

    Another warning states how many repairs the files needed.

    Args:
        data: as `open_data` takes it.
        dt_s: seconds per tick; recordings whose frames are too far apart for it are left out, too.
        strict: whether a recording that cannot be read is an error instead.

    Returns:
        The recordings that can be read, at least one.

    Raises:
        AspEnvError: the source is unknown, no recording can be read, or one cannot and `strict`.
        LeftOutWarning: a recording cannot be read and this warning is an error, as by the option
            `--strict` of commands.
    """
    found = open_data(data, dt_s=dt_s)
    recordings = Recordings(found.source, found.files, dt_s=dt_s, quiet=True)
    faults: dict[int, AspEnvError] = {}
    for number in range(len(recordings)):
        try:
            recordings[number]
        except AspEnvError as error:
            faults[number] = error
    if not faults:
        _warn_of_repairs(recordings)
        return recordings
    first = next(iter(faults.values()))
    names = shorten([recordings.names[number] for number in faults])
    if len(recordings) == 1:
        raise first
    message = (
        f"data {recordings.source!r}: {len(faults)} of {len(recordings)} recordings cannot be used "
        f"({names}): {first}"
    )
    if strict or len(faults) == len(recordings):
        raise DataError(message)
    warnings.warn(LeftOutWarning(f"{message}; left out"), stacklevel=2)
    readable = recordings.subset(n for n in range(len(recordings)) if n not in faults)
    _warn_of_repairs(readable)
    return readable


def _warn_of_repairs(recordings: Recordings) -> None:
    """Warns once of all repairs of recordings and maps, with their number."""
    tables = list(recordings)
    maps = {id(each.road_map): each.road_map for each in tables}
    of_tracks = [f"recording {each.name}: {line}" for each in tables for line in each.repairs]
    of_maps = [f"map {each.name}: {line}" for each in maps.values() for line in each.repairs]
    lines = [*of_tracks, *of_maps]
    if lines:
        repaired = sum(bool(each.repairs) for each in tables)
        warnings.warn(
            f"data {recordings.source!r}: {len(of_tracks)} repairs of {repaired} of {len(tables)} "
            f"recordings and {len(of_maps)} of maps: {shorten(lines, SHOWN_REPAIRS)} "
            "(asp-env inspect lists all repairs)",
            RepairWarning,
            stacklevel=3,
        )


def join_data(parts: Sequence[Recordings]) -> Recordings:
    """The recordings of several data sets as one sequence.

    Args:
        parts: at least one data set. If there are several, the names of recordings start with the
            number of their data set, counted from 1 (`2-00`), because names may be equal.

    Raises:
        DataError: a recording is in two of them, or they are opened for different ticks.
    """
    if len(parts) == 1:
        return parts[0]
    if len({part.dt_s for part in parts}) > 1:
        steps = ", ".join(f"{part.source!r}: {part.dt_s:g} s" for part in parts)
        raise DataError(f"data are opened for different time steps ({steps}), expected equal ones")
    files, found = [], dict[str, str]()
    for number, part in enumerate(parts, start=1):
        for each, content in zip(part.files, part.hashes(), strict=True):
            if content in found:
                raise DataError(
                    f"recording {each.name} of {part.source!r} is in {found[content]!r} too: give "
                    "each recording once"
                )
            found[content] = part.source
            files.append(replace(each, name=f"{number}-{each.name}"))
    source = ", ".join(part.source for part in parts)
    quiet = all(part.quiet for part in parts)
    return Recordings(source, files, dt_s=parts[0].dt_s, quiet=quiet)


def load(path: str | Path) -> Recordings:
    """Deprecated former name of `open_data`."""
    warnings.warn(
        "asp_env.load is deprecated and will be removed in the next release: use asp_env.open_data",
        DeprecationWarning,
        stacklevel=2,
    )
    return open_data(path)


def scheme_of(source: str) -> str | None:
    """The scheme of a source such as `synthetic:intersection`; None for a folder."""
    match = _SCHEME.match(source)
    return None if match is None or Path(source).exists() else match.group(1)


def source_folder(source: str) -> Path:
    """The folder that a source stands for; one of a registered source may be made first.

    Args:
        source: the data as the user named them. A folder need not exist.

    Raises:
        AspEnvError: the source is unknown.
    """
    scheme = scheme_of(source)
    if scheme is None:
        path = Path(source).expanduser().absolute()
        return path.resolve() if ".." in path.parts else path  # folder names are location names
    argument = source[len(scheme) + 1 :]
    if scheme == "sample":
        return _sample(argument)
    known = registry.names("sources")
    if scheme not in known:
        raise unknown_name("source", scheme, ["sample", *known])
    return Path(registry.find("sources", scheme)(argument))


def find_by_reader(folder: Path) -> dict[str, list[RecordingFiles] | AspEnvError]:
    """What each registered reader finds in a folder, this package's first layouts first.

    Args:
        folder: an existing folder.

    Returns:
        The recordings of each reader, or why it fails. A reader of another package may fail in any
        way; an `OSError` of any reader is a `DataError`.
    """
    names = [*_FIRST, *(name for name in registry.names("readers") if name not in _FIRST)]
    found: dict[str, list[RecordingFiles] | AspEnvError] = {}
    for name in names:
        try:
            recordings = list(registry.find("readers", name)(folder))
            for each in recordings:
                if not isinstance(each, RecordingFiles):
                    raise TypeError(f"it yields {brief(repr(each))}, expected FoundRecording")
            found[name] = recordings
        except StaleInstallError:
            raise
        except OSError as error:
            found[name] = DataError(f"{error.filename or folder}: {error.strerror or error}")
        except Exception as error:  # a reader of another package may raise anything
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            plug = registry.described("readers", name)
            found[name] = AspEnvError(f"{plug} is left out: {reason}")
    lists = [each for each in found.values() if isinstance(each, list)]
    taken = {
        path
        for each in lists
        for files in each
        if not isinstance(files, LevelxFiles)
        for path in files.tables
    }
    for each in lists:
        each[:] = [files for files in each if not _is_taken(files, taken)]
    return found


def _is_taken(files: RecordingFiles, taken: set[Path]) -> bool:
    """Whether files with the names of inD are those of another layout: Veh_smoothed_tracks.csv."""
    if not isinstance(files, LevelxFiles):
        return False
    present = {path for path in files.tables if os.path.lexists(path)}
    return bool(present) and present <= taken


def _find(folder: Path) -> tuple[RecordingFiles, ...]:
    """The recordings that all readers find in a folder; a reader that fails is left out."""
    found: list[RecordingFiles] = []
    for each in find_by_reader(folder).values():
        if isinstance(each, DataError):
            raise each
        if isinstance(each, AspEnvError):
            warnings.warn(str(each), stacklevel=3)
        else:
            found += each
    return tuple(found)


def _sample(site: str) -> Path:
    samples = Path(str(resources.files("asp_env"))) / "samples"
    sites = [path.name for path in samples.glob("*") if path.is_dir() and path.name[0] not in "._"]
    if site not in sites:
        raise unknown_name("sample", site, sites)
    return samples / site

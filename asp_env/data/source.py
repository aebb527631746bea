"""DATA: from the name that a user gives to recordings that are opened when they are asked for."""

import hashlib
import re
from collections.abc import Iterable, Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, SupportsIndex, overload

from asp_env import registry
from asp_env.data.readers import interaction, levelx
from asp_env.data.readers.opening import ReaderState, RecordingFiles, content_hash, open_recording
from asp_env.data.recording import Recording
from asp_env.errors import DataError, unknown_name

_SCHEME = re.compile(r"^([a-z][a-z0-9-]+):(.*)$", re.DOTALL)


class Recordings(Sequence[Any]):  # not of Recording: checking its items at run time opens them
    """The recordings of one DATA, each read when it is first asked for and kept from then on.

    Attributes:
        source: DATA as the user named it.
        names: the recordings' ids, such as `00`.
    """

    def __init__(
        self,
        source: str,
        files: Sequence[RecordingFiles],
        *,
        opened: ReaderState | None = None,
    ) -> None:
        """Lists recordings; reads none.

        Args:
            source: DATA as the user named it.
            files: where each recording lies.
            opened: those that are open already.
        """
        self.source = source
        self.names = tuple(each.name for each in files)
        self._files = tuple(files)
        self._opened = ReaderState() if opened is None else opened

    def __deepcopy__(self, memo: dict[int, Any]) -> "Recordings":
        """Itself: recordings never change."""
        del memo
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy in another process opens its files anew, mapped from the same cache."""
        return Recordings, (self.source, self._files)

    def __len__(self) -> int:
        """How many there are."""
        return len(self._files)

    @overload
    def __getitem__(self, index: SupportsIndex) -> Recording: ...
    @overload
    def __getitem__(self, index: slice) -> "Recordings": ...
    def __getitem__(self, index: SupportsIndex | slice) -> "Recording | Recordings":
        """One recording, or some of them still unopened.

        Raises:
            DataError: its files are damaged.
        """
        if isinstance(index, slice):
            return self.subset(range(len(self))[index])
        return open_recording(self._files[index], self._opened)

    def __iter__(self) -> Iterator[Recording]:
        """Opens one after the other."""
        return (self[index] for index in range(len(self)))

    def subset(self, indices: Iterable[SupportsIndex]) -> "Recordings":
        """Some of the recordings, sharing those that are open."""
        chosen = [self._files[index] for index in indices]
        return Recordings(self.source, chosen, opened=self._opened)

    def tracks_path(self, index: SupportsIndex) -> Path:
        """The file with the tracks of one recording, beside which a package may keep more."""
        return self._files[index].tracks

    def hashes(self) -> tuple[str, ...]:
        """Of each recording, a hash of the content of its files and its map.

        Raises:
            DataError: a file is missing.
        """
        return tuple(content_hash(files, self._opened) for files in self._files)

    def data_hash(self) -> str:
        """A hash of the content of all recordings, whatever their folder is called.

        Raises:
            DataError: a file is missing.
        """
        return hashlib.sha256("".join(self.hashes()).encode()).hexdigest()


def open_data(data: str | Path) -> Recordings:
    """The recordings of DATA.

    Args:
        data: a folder with recordings in the inD/rounD or the INTERACTION layout, or both;
            `sample:intersection`, `sample:roundabout`, or `scheme:argument` of a source that a
            package registers.

    Raises:
        AspEnvError: no such source.
        DataError: no such folder, or no recordings in it.
    """
    source = str(data)
    folder = _resolve(source)
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "does not exist"
        raise DataError(f"data {source!r}: {folder} {what}; expected a folder with recordings")
    files = (*levelx.find_recordings(folder), *interaction.find_recordings(folder))
    if not files:
        raise DataError(
            f"data {source!r}: no recordings found; expected XX_recordingMeta.csv, "
            "XX_tracksMeta.csv and XX_tracks.csv, or LOCATION/vehicle_tracks_NNN.csv, "
            "in the folder or below"
        )
    names = [each.name for each in files]
    if double := next((name for name in names if names.count(name) > 1), None):
        raise DataError(
            f"data {source!r}: two recordings are called {double}, expected names of their own; "
            "put the layouts in folders of their own"
        )
    return Recordings(source, files)


def load(path: str | Path) -> Recordings:
    """The recordings in a folder, lazily: the same as `open_data`."""
    return open_data(path)


def scheme_of(source: str) -> str | None:
    """What stands before the colon of DATA such as `synthetic:intersection`; None for a folder."""
    match = _SCHEME.match(source)
    return None if match is None or Path(source).exists() else match.group(1)


def _resolve(source: str) -> Path:
    scheme = scheme_of(source)
    if scheme is None:
        path = Path(source).expanduser().absolute()
        return path.resolve() if ".." in path.parts else path  # folders' names are places' names
    argument = source[len(scheme) + 1 :]
    if scheme == "sample":
        return _sample(argument)
    known = registry.names("sources")
    if scheme not in known:
        raise unknown_name("source", scheme, ["sample", *known])
    return Path(registry.find("sources", scheme)(argument))


def _sample(site: str) -> Path:
    samples = Path(str(resources.files("asp_env"))) / "samples"
    sites = [path.name for path in samples.glob("*") if path.is_dir() and path.name[0] not in "._"]
    if site not in sites:
        raise unknown_name("sample", site, sites)
    return samples / site

"""Data sets of episodes in Minari's format: `data/main_data.hdf5` and `data/metadata.json`.

The files are written with h5py alone, so that the same episodes give the same bytes. The layout is
that of Minari 0.5 (https://minari.farama.org/content/dataset_standards/): a group for each episode
with `observations` and `infos` of T + 1 ticks, and `actions`, `rewards`, `terminations` and
`truncations` of T steps. Attributes of the group hold the seed and the options of its `reset`, and
the names of its scenario, recording and ending.
"""

import io
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, final

import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from jaxtyping import Bool, Float, Int, Shaped

from asp_env.errors import DataError, MissingExtraError

FORMAT_VERSION = "0.5.0"
"""The oldest version of Minari that reads the files."""

DATA_FILE = "data/main_data.hdf5"
METADATA_FILE = "data/metadata.json"
ID_PATTERN = re.compile(r"[-\w]+-v\d+")
"""Ids that Minari accepts, without a namespace."""

Observations = Mapping[str, np.ndarray] | np.ndarray
"""Arrays (ticks, …) by entry, or one array (ticks, size)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedEpisode:
    """One episode of T steps."""

    observations: Observations
    """T + 1 observations: by entry, or flat."""
    actions: Float[np.ndarray, "steps 2"]
    rewards: Float[np.ndarray, " steps"]
    terminations: Bool[np.ndarray, " steps"]
    truncations: Bool[np.ndarray, " steps"]
    infos: Mapping[str, Shaped[np.ndarray, " ticks"]]
    """Numbers by name, T + 1 of each."""
    seed: int
    """Seed of the `reset` that starts this episode."""
    options: Mapping[str, Any]
    """Options of that `reset`."""
    attributes: Mapping[str, str]
    """Further properties of the whole episode."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DemonstrationSteps:
    """The N steps of all episodes of a data set, one after the other."""

    observations: Observations
    """The observations in which the actions were taken: by entry, or flat."""
    actions: Float[np.ndarray, "n 2"]
    rewards: Float[np.ndarray, " n"]
    terminations: Bool[np.ndarray, " n"]
    truncations: Bool[np.ndarray, " n"]
    clipped: Bool[np.ndarray, " n"]
    """Mask of actions that the bicycle model cannot execute; their values are at the limits."""
    episode: Int[np.ndarray, " n"]
    """Number of the episode."""
    recording: Int[np.ndarray, " n"]
    """Number of the recording, by the name in alphabetical order."""


def import_h5py(purpose: str) -> ModuleType:
    """Imports h5py.

    Args:
        purpose: what needs it, for the message.

    Raises:
        MissingExtraError: h5py is not installed.
    """
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise MissingExtraError("h5py", "offline", purpose) from error
    return h5py


def write_dataset(
    folder: Path,
    episodes: Iterable[RecordedEpisode],
    *,
    dataset_id: str,
    env_spec: EnvSpec,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    description: str,
) -> None:
    """Writes a data set that `minari.load_dataset` reads.

    Args:
        folder: an existing empty folder.
        episodes: the episodes in the order of their numbers.
        dataset_id: id that fits `ID_PATTERN`.
        env_spec: recovers the environment.
        observation_space: space of the observations.
        action_space: space of the actions.
        description: one sentence about the data.

    Raises:
        MissingExtraError: h5py is not installed.
        OSError: the file cannot be written.
    """
    h5py = import_h5py("writing a data set")
    (folder / "data").mkdir()
    num_episodes = num_steps = 0
    with _LateErrors(folder / DATA_FILE) as disk:
        with h5py.File(disk, "w", track_order=True) as file:
            for episode in episodes:
                _write_episode(file.create_group(f"episode_{num_episodes}"), num_episodes, episode)
                num_episodes += 1
                num_steps += len(episode.actions)
                disk.check()
        disk.check()
    metadata = {
        "total_episodes": num_episodes,
        "total_steps": num_steps,
        "data_format": "hdf5",
        "jpeg_encoding": False,
        "observation_space": json.dumps(_space_as_json(observation_space)),
        "action_space": json.dumps(_space_as_json(action_space)),
        "env_spec": env_spec.to_json(),
        "dataset_id": dataset_id,
        "minari_version": FORMAT_VERSION,
        "algorithm_name": "logged driver",
        "description": description,
        "requirements": ["asp-env"],
        "dataset_size": round((folder / DATA_FILE).stat().st_size / 1e6, 1),
    }
    (folder / METADATA_FILE).write_text(json.dumps(metadata))


@final
class _LateErrors(io.FileIO):
    """A file whose writing never fails; `check` raises the first error.

    HDF5 ends the process if it cannot write the rest of a file, as on a full disk.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+b")
        self._path = path
        self._error: OSError | None = None

    def write(self, content: Any, /) -> int:
        left = memoryview(content).cast("B")
        count = len(left)
        try:
            while self._error is None and len(left):
                left = left[super().write(left) or 0 :]
        except OSError as error:
            self._error = error
        return count

    def truncate(self, size: int | None = None, /) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self._error = self._error or error
        return self.tell() if size is None else size

    def check(self) -> None:
        """Raises the first error, with the name of the file.

        Raises:
            OSError: something could not be written.
        """
        if self._error is not None:
            raise OSError(self._error.errno, self._error.strerror, str(self._path))


def _write_episode(group: Any, number: int, episode: RecordedEpisode) -> None:
    group.attrs["id"] = number
    group.attrs["total_steps"] = len(episode.actions)
    group.attrs["seed"] = episode.seed
    for name, value in episode.options.items():
        group.attrs[f"options/{name}"] = value
    for name, value in episode.attributes.items():
        group.attrs[name] = value
    _write_arrays(group, "observations", episode.observations)
    _write_arrays(group, "infos", episode.infos)
    for name in ("actions", "rewards", "terminations", "truncations"):
        _write_arrays(group, name, getattr(episode, name))


def _write_arrays(group: Any, name: str, value: Any) -> None:
    if isinstance(value, Mapping):
        for key, each in value.items():
            _write_arrays(group.require_group(name), key, each)
        return
    group.create_dataset(
        name,
        data=value,
        chunks=True,
        maxshape=(None, *value.shape[1:]),  # Minari appends to episodes
        compression="gzip",
        compression_opts=1,
        shuffle=True,
    )


def _space_as_json(space: spaces.Space[Any]) -> dict[str, Any]:
    """A space in the form of Minari's `serialize_space`."""
    if isinstance(space, spaces.Dict):
        parts = {name: _space_as_json(part) for name, part in space.items()}
        return {"type": "Dict", "subspaces": parts}
    assert isinstance(space, spaces.Box)
    return {
        "type": "Box",
        "dtype": str(space.dtype),
        "shape": list(space.shape),
        "low": space.low.tolist(),
        "high": space.high.tolist(),
    }


def load_steps(folder: Path) -> DemonstrationSteps:
    """Loads all steps of a data set that `asp-env rl demonstrations` wrote.

    Args:
        folder: the folder of the data set.

    Raises:
        DataError: there is no such data set, or it has no steps.
        MissingExtraError: h5py is not installed.
    """
    h5py = import_h5py("reading a data set")
    path = folder / DATA_FILE
    if not path.is_file():
        raise DataError(f"{folder}: no data set ({DATA_FILE}); asp-env rl demonstrations makes one")
    try:
        with h5py.File(path, "r") as file:
            groups = [file[f"episode_{number}"] for number in range(len(file))]
            return _steps_of(groups)
    except (OSError, KeyError, ValueError) as error:
        raise DataError(
            f"{path} cannot be read ({error}): expected a file of asp-env rl demonstrations"
        ) from error


def _steps_of(groups: list[Any]) -> DemonstrationSteps:
    lengths = [len(group["actions"]) for group in groups]
    names = [str(group.attrs["recording"]) for group in groups]
    numbers = np.unique(names, return_inverse=True)[1]
    first = groups[0]["observations"]
    if hasattr(first, "keys"):
        observations: Observations = {
            name: np.concatenate([group["observations"][name][:-1] for group in groups])
            for name in first
        }
    else:
        observations = np.concatenate([group["observations"][:-1] for group in groups])
    return DemonstrationSteps(
        observations=observations,
        actions=np.concatenate([group["actions"][()] for group in groups]),
        rewards=np.concatenate([group["rewards"][()] for group in groups]),
        terminations=np.concatenate([group["terminations"][()] for group in groups]),
        truncations=np.concatenate([group["truncations"][()] for group in groups]),
        clipped=np.concatenate([group["infos/clipped"][:-1] for group in groups]),
        episode=np.repeat(np.arange(len(groups)), lengths),
        recording=np.repeat(numbers, lengths),
    )

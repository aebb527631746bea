"""Cells: results of work units, stored by a hash of everything that they depend on.

A cell is one method, or one training run of it, in up to `EPISODES_AT_ONCE` scenarios of one
condition. Its file is `cells/AB/KEY.npz` in the folder of the study, where KEY is the hash and AB
its first two digits. Cells whose dependencies are the same are the same cell, in whatever order and
by however many processes they are computed.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from asp_env.errors import DataError
from asp_env.evaluation.closed_loop.comparison import EpisodeScores
from asp_env.evaluation.closed_loop.containment import Fault
from asp_env.files import atomic_file, remove_abandoned
from asp_env.metrics.masked import Masked
from asp_env.sim.world import Ending
from asp_env.stored import parse_json, read_arrays

CELLS = "cells"
"""Folder of the cells in that of a study."""

FORMAT = 1
"""Version of the file format; part of every key."""

_READ_ERRORS = (OSError, ValueError, KeyError, TypeError)


def key_of(dependencies: Mapping[str, Any]) -> str:
    """The key of a cell.

    Args:
        dependencies: everything that the result depends on, as plain values.
    """
    text = json.dumps({"format": FORMAT, **dependencies}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


class CellFolder:
    """The cells of a study on disk."""

    def __init__(self, out: Path) -> None:
        """Opens the folder, which need not exist.

        Args:
            out: folder of the study.
        """
        self._folder = out / CELLS

    def path(self, key: str) -> Path:
        """The file of a cell."""
        return self._folder / key[:2] / f"{key}.npz"

    def __contains__(self, key: str) -> bool:
        """Whether a cell is stored."""
        return self.path(key).exists()

    def save(self, key: str, scores: EpisodeScores) -> None:
        """Stores a cell, atomically; its rollouts are left out.

        Raises:
            OSError: the file cannot be written.
        """
        header = {
            "format": FORMAT,
            "metrics": list(scores.metrics),
            "endings": [ending.name for ending in scores.endings],
            "faults": [None if fault is None else asdict(fault) for fault in scores.faults],
        }
        metrics = [*scores.metrics.values()]
        text = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
        with atomic_file(self.path(key)) as partial, partial.open("wb") as file:
            np.savez(
                file,
                header=text,
                value=np.stack([each.value for each in metrics]).astype(np.float64),
                valid=np.stack([each.valid for each in metrics]),
            )

    def load(self, key: str) -> EpisodeScores:
        """Reads a cell.

        Raises:
            DataError: the file is missing or damaged.
        """
        path = self.path(key)
        try:
            arrays = read_arrays(path)
            header = parse_json(arrays["header"].tobytes())
            value, valid = arrays["value"], arrays["valid"]
            count = len(header["endings"])
            if value.shape != (len(header["metrics"]), count) or valid.shape != value.shape:
                raise ValueError("its arrays do not fit each other")
            return EpisodeScores(
                metrics={
                    name: Masked(value=value[i], valid=valid[i])
                    for i, name in enumerate(header["metrics"])
                },
                endings=tuple(Ending[name] for name in header["endings"]),
                faults=tuple(each and Fault(**each) for each in header["faults"]),
                rollouts=(),
            )
        except _READ_ERRORS as error:
            reason = str(error) or type(error).__name__
            raise DataError(
                f"{path}: not a readable cell ({reason}); remove it, and it is driven again"
            ) from error

    def remove_leftovers(self) -> None:
        """Removes the temporary files of processes that were killed."""
        for folder in self._folder.glob("*"):
            remove_abandoned(folder)

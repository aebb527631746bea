"""Pretrained weights: runs that ship with this package, by the name `PREDICTOR:pretrained`.

Each is the folder of a finished run, `predictors/pretrained/PREDICTOR`. Its model card has the
command that made it and its errors on recordings that it was not selected on.
"""

from importlib import resources
from pathlib import Path

from asp_env.errors import CheckpointError

PRETRAINED = "pretrained"
"""The run's name that stands for the shipped weights, whatever the working directory holds. A
folder of that name is given as `./pretrained`."""


def pretrained_folder(predictor: str) -> Path:
    """The folder of a predictor's pretrained weights.

    Args:
        predictor: Name of the predictor.

    Raises:
        CheckpointError: The package has no pretrained weights of this predictor; the message lists
            those that there are.
    """
    folders = _folders()
    if predictor not in folders:
        shipped = ", ".join(f"{name}:{PRETRAINED}" for name in sorted(folders)) or "none"
        raise CheckpointError(
            f"{predictor} has no pretrained weights, the package ships {shipped}: train it and "
            f"name it as {predictor}:RUN (a folder called {PRETRAINED} is {predictor}:"
            f"./{PRETRAINED})"
        )
    return folders[predictor]


def pretrained_names() -> tuple[str, ...]:
    """The predictors that have pretrained weights, in alphabetical order."""
    return tuple(sorted(_folders()))


def _folders() -> dict[str, Path]:
    root = Path(str(resources.files("predictors"))) / PRETRAINED
    return {path.parent.name: path.parent for path in root.glob("*/config.json")}

"""The state of an unfinished run, written without pickles: tensors and JSON in one file."""

import json
import os
from pathlib import Path
from typing import Any, final

import torch
from lightning.fabric.utilities.types import _PATH
from lightning.pytorch.plugins.io import CheckpointIO
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from asp_env.errors import CheckpointError


@final
class SafetensorsIO(CheckpointIO):
    """Lightning's checkpoints as safetensors, with everything that is no tensor in the header."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: _PATH, storage_options: Any | None = None
    ) -> None:
        """Writes aside, then renames."""
        del storage_options
        tensors: dict[str, torch.Tensor] = {}
        tree = _encode(checkpoint, tensors)
        aside = Path(f"{path}.part")
        aside.write_bytes(save(tensors, metadata={"tree": json.dumps(tree)}))
        os.replace(aside, path)

    def load_checkpoint(
        self, path: _PATH, map_location: Any | None = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """What was saved.

        Raises:
            CheckpointError: the file is damaged.
        """
        del map_location, weights_only
        try:
            with safe_open(str(path), framework="pt") as file:
                names = file.keys()
                tensors = {name: file.get_tensor(name) for name in names}
                return _decode(json.loads(file.metadata()["tree"]), tensors)
        except (OSError, KeyError, TypeError, ValueError, SafetensorError) as error:
            raise CheckpointError(
                f"{path} cannot be read: delete its folder to start the run again"
            ) from error

    def remove_checkpoint(self, path: _PATH) -> None:
        """Deletes the file if it is there."""
        Path(path).unlink(missing_ok=True)


def _encode(value: Any, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(value, torch.Tensor):
        name = str(len(tensors))
        tensors[name] = value.detach().clone().contiguous()
        return {"tensor": name}
    if isinstance(value, dict):
        return {"dict": [[_encode(k, tensors), _encode(v, tensors)] for k, v in value.items()]}
    if isinstance(value, tuple):
        return {"tuple": [_encode(item, tensors) for item in value]}
    if isinstance(value, list):
        return [_encode(item, tensors) for item in value]
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise TypeError(f"the state of a run holds a {type(value).__name__}, which is not stored")


def _decode(tree: Any, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(tree, list):
        return [_decode(item, tensors) for item in tree]
    if not isinstance(tree, dict):
        return tree
    ((kind, content),) = tree.items()
    if kind == "tensor":
        return tensors[content]
    if kind == "tuple":
        return tuple(_decode(item, tensors) for item in content)
    return {_decode(key, tensors): _decode(value, tensors) for key, value in content}

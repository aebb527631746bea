"""Use of trained networks: checkpoints, calibration, and the export to ONNX.

The names are imported on first access, so that the command `asp-env export` needs no torch before
it runs.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from predictors.inference.calibration import calibrate, fit_temperature
    from predictors.inference.checkpoint import (
        PredictorSpec,
        load_trained,
        read_config,
        save_trained,
        shape_for,
    )
    from predictors.inference.onnx_file import write_onnx
    from predictors.inference.trained import TrainedPredictor

__all__ = [
    "PredictorSpec",
    "TrainedPredictor",
    "calibrate",
    "fit_temperature",
    "load_trained",
    "read_config",
    "save_trained",
    "shape_for",
    "write_onnx",
]

_MODULES = {
    "calibration": ("calibrate", "fit_temperature"),
    "checkpoint": ("PredictorSpec", "load_trained", "read_config", "save_trained", "shape_for"),
    "onnx_file": ("write_onnx",),
    "trained": ("TrainedPredictor",),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

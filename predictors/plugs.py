"""The predictors of this package, as the entry points in `asp_env.predictors` name them.

The specifications of trained predictors are made on first access, so that the physical predictors
and the controls need no torch.
"""

from functools import cache
from typing import TYPE_CHECKING, Any

from predictors.controls import Blend, Blind, InteractiveOracle, NoisyOracle, ShuffledOracle
from predictors.delayed import Delayed
from predictors.guarded import Guarded
from predictors.most_probable import MostProbable
from predictors.physical import ConstantTurnRate, ConstantVelocity, Oracle

if TYPE_CHECKING:
    from predictors.inference.checkpoint import PredictorSpec

    MTP: PredictorSpec
    DKM: PredictorSpec
    FFWASP: PredictorSpec
    SSPASP: PredictorSpec

__all__ = [
    "DKM",
    "FFWASP",
    "MTP",
    "SSPASP",
    "Blend",
    "Blind",
    "ConstantTurnRate",
    "ConstantVelocity",
    "Delayed",
    "Guarded",
    "InteractiveOracle",
    "MostProbable",
    "NoisyOracle",
    "Oracle",
    "ShuffledOracle",
]


@cache
def _specifications() -> dict[str, Any]:
    from predictors import models
    from predictors.inference.checkpoint import PredictorSpec

    return {
        "MTP": PredictorSpec(name="mtp", config=models.MTPConfig, network=models.MTPNetwork),
        "DKM": PredictorSpec(name="dkm", config=models.DKMConfig, network=models.DKMNetwork),
        "FFWASP": PredictorSpec(
            name="ffw-asp", config=models.FFWASPConfig, network=models.FFWASPNetwork
        ),
        "SSPASP": PredictorSpec(
            name="ssp-asp", config=models.SSPASPConfig, network=models.SSPASPNetwork
        ),
    }


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return _specifications()[name]

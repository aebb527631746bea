"""Networks: encoders, heads, losses, chaining of segments, and the four learned predictors."""

from predictors.models.batch import Batch, Labels, VectorTensors, make_batch, make_labels
from predictors.models.chaining import CHAININGS, Chaining
from predictors.models.dkm import DKMConfig, DKMNetwork
from predictors.models.encoders import ENCODERS, make_encoder
from predictors.models.ffw_asp import FFWASPConfig, FFWASPNetwork
from predictors.models.losses import best_mode, mode_terms
from predictors.models.mtp import MTPConfig, MTPNetwork
from predictors.models.network import (
    AbstractNetwork,
    Features,
    Modes,
    NetworkConfig,
    NetworkShape,
    TrainingProgress,
)
from predictors.models.ssp_asp import SSPASPConfig, SSPASPNetwork

__all__ = [
    "CHAININGS",
    "ENCODERS",
    "AbstractNetwork",
    "Batch",
    "Chaining",
    "DKMConfig",
    "DKMNetwork",
    "FFWASPConfig",
    "FFWASPNetwork",
    "Features",
    "Labels",
    "MTPConfig",
    "MTPNetwork",
    "Modes",
    "NetworkConfig",
    "NetworkShape",
    "SSPASPConfig",
    "SSPASPNetwork",
    "TrainingProgress",
    "VectorTensors",
    "best_mode",
    "make_batch",
    "make_encoder",
    "make_labels",
    "mode_terms",
]

"""Traffic: drivers of the agents other than the ego, and tables that assign agents to drivers."""

from asp_env.sim.traffic.assignment import Traffic, TrafficSpec, make_traffic
from asp_env.sim.traffic.driver import (
    BaseDriver,
    Control,
    Driver,
    DriverPlug,
    Shared,
    controllable_agents,
    no_control,
)
from asp_env.sim.traffic.hybrid import HybridDriver
from asp_env.sim.traffic.idm import IDMDriver
from asp_env.sim.traffic.log import LogActionsDriver, LogDriver, OwnDriver, PolicyDriver
from asp_env.sim.traffic.predictor import PredictorDriver

__all__ = [
    "BaseDriver",
    "Control",
    "Driver",
    "DriverPlug",
    "HybridDriver",
    "IDMDriver",
    "LogActionsDriver",
    "LogDriver",
    "OwnDriver",
    "PolicyDriver",
    "PredictorDriver",
    "Shared",
    "Traffic",
    "TrafficSpec",
    "controllable_agents",
    "make_traffic",
    "no_control",
]

"""Who moves the agents that the caller does not: the socket and its plugs."""

from asp_env.sim.traffic.driver import Control, Driver, DriverPlug

__all__ = ["Control", "Driver", "DriverPlug"]

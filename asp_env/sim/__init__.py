"""The closed loop: worlds of episodes, drivers of their traffic, observations and rewards."""

from asp_env.sim.episodes import EpisodeInit, Episodes
from asp_env.sim.observation import (
    STATE_FIELDS,
    Observation,
    ObservationComponent,
    ObservationContext,
    Observer,
    ego_context,
)
from asp_env.sim.reward import RewardWeights, reward_terms, weighted_sum
from asp_env.sim.simulated_future import simulated_future
from asp_env.sim.simulation import Simulation, ending
from asp_env.sim.traffic.assignment import make_traffic
from asp_env.sim.world import (
    Ending,
    Events,
    ReplayWorld,
    World,
    recorded_future,
    world_class,
)

__all__ = [
    "STATE_FIELDS",
    "Ending",
    "EpisodeInit",
    "Episodes",
    "Events",
    "Observation",
    "ObservationComponent",
    "ObservationContext",
    "Observer",
    "ReplayWorld",
    "RewardWeights",
    "Simulation",
    "World",
    "ego_context",
    "ending",
    "make_traffic",
    "recorded_future",
    "reward_terms",
    "simulated_future",
    "weighted_sum",
    "world_class",
]

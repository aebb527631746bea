"""Metrics of driven episodes: scores, comfort, time to collision and realism of the traffic."""

from asp_env.metrics.driving.comfort import comfort_signals, comfortable
from asp_env.metrics.driving.map_context import MapContext, map_context
from asp_env.metrics.driving.realism import (
    REALISM_FEATURES,
    RealismFeature,
    feature_likelihood,
    nearest_distance_and_ttc,
    realism,
    realism_features,
)
from asp_env.metrics.driving.rules import (
    DEFAULT_RULES,
    NUPLAN,
    PDMS,
    RULES,
    STRICT,
    WAYMAX,
    Rules,
    find_rules,
)
from asp_env.metrics.driving.scores import (
    EpisodeRecord,
    against_traffic_in_window_m,
    at_fault,
    driving_metrics,
    overspeed_mps,
)
from asp_env.metrics.driving.ttc import TtcRule, time_to_collision

__all__ = [
    "DEFAULT_RULES",
    "NUPLAN",
    "PDMS",
    "REALISM_FEATURES",
    "RULES",
    "STRICT",
    "WAYMAX",
    "EpisodeRecord",
    "MapContext",
    "RealismFeature",
    "Rules",
    "TtcRule",
    "against_traffic_in_window_m",
    "at_fault",
    "comfort_signals",
    "comfortable",
    "driving_metrics",
    "feature_likelihood",
    "find_rules",
    "map_context",
    "nearest_distance_and_ttc",
    "overspeed_mps",
    "realism",
    "realism_features",
    "time_to_collision",
]

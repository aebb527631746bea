"""Metrics of driven episodes: scores, comfort, time to collision and realism of the traffic."""

from asp_env.metrics.driving.comfort import (
    comfort_signals,
    comfortable,
    share_of_bounds,
    within_bounds,
)
from asp_env.metrics.driving.cost import (
    DrivingCostWeights,
    driving_cost_s,
    log_route_m,
    severity,
    time_lost_s,
)
from asp_env.metrics.driving.map_context import MapContext, map_context
from asp_env.metrics.driving.margins import (
    BOUNDED_TTC,
    bounded_ttc_s,
    near_misses,
    required_deceleration,
)
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
    GRADED,
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
    "BOUNDED_TTC",
    "DEFAULT_RULES",
    "GRADED",
    "NUPLAN",
    "PDMS",
    "REALISM_FEATURES",
    "RULES",
    "STRICT",
    "WAYMAX",
    "DrivingCostWeights",
    "EpisodeRecord",
    "MapContext",
    "RealismFeature",
    "Rules",
    "TtcRule",
    "against_traffic_in_window_m",
    "at_fault",
    "bounded_ttc_s",
    "comfort_signals",
    "comfortable",
    "driving_cost_s",
    "driving_metrics",
    "feature_likelihood",
    "find_rules",
    "log_route_m",
    "map_context",
    "near_misses",
    "nearest_distance_and_ttc",
    "overspeed_mps",
    "realism",
    "realism_features",
    "required_deceleration",
    "severity",
    "share_of_bounds",
    "time_lost_s",
    "time_to_collision",
    "within_bounds",
]

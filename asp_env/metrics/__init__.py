"""The definitions of all errors and driving scores, as pure functions of arrays.

Each returns values with a mask of where they are defined. Averages and intervals are computed in
`asp_env.evaluation.statistics`. Metrics of forecasts are in `asp_env.metrics.forecast`, metrics of
driven episodes in `asp_env.metrics.driving`; both use the contacts, distances and lanes given here.
"""

from asp_env.metrics.boxes import (
    AT_FAULT,
    Contact,
    ego_contacts,
    overlapping_paths,
    touching_trailers,
)
from asp_env.metrics.drivable import (
    DrivableField,
    beyond_log_m,
    drivable_field,
    log_off_road_m,
    off_road_m,
    road_edge_m,
)
from asp_env.metrics.lanes import (
    against_traffic_m,
    at_crossing,
    covering_lanes,
    in_several_lanes,
    lane_coordinates,
    speed_limits,
)
from asp_env.metrics.masked import Masked

__all__ = [
    "AT_FAULT",
    "Contact",
    "DrivableField",
    "Masked",
    "against_traffic_m",
    "at_crossing",
    "beyond_log_m",
    "covering_lanes",
    "drivable_field",
    "ego_contacts",
    "in_several_lanes",
    "lane_coordinates",
    "log_off_road_m",
    "off_road_m",
    "overlapping_paths",
    "road_edge_m",
    "speed_limits",
    "touching_trailers",
]

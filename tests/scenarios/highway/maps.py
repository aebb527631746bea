"""Roads of highway-env with the maps that are written for them."""

from dataclasses import dataclass
from pathlib import Path

from highway_env.road.road import RoadNetwork

from asp_env.data.readers.lanelet2 import read_lanelet2
from asp_env.data.readers.positions import Origin
from asp_env.data.road_map import RoadMap
from scenarios.highway.road_map import ORIGIN_LAT_LON_DEG, ORIGIN_UTM_M, write_road_map


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """A road, and its map after writing and reading."""

    network: RoadNetwork
    road_map: RoadMap


def read_back(folder: Path, network: RoadNetwork) -> RoadMap:
    """The map of a road after writing and reading."""
    path = folder / "place.osm"
    write_road_map(path, network, origin_utm_m=ORIGIN_UTM_M)
    latitude_deg, longitude_deg = ORIGIN_LAT_LON_DEG
    origin = Origin(
        x_m=ORIGIN_UTM_M[0],
        y_m=ORIGIN_UTM_M[1],
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
    )
    return read_lanelet2(path, origin)

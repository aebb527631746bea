"""The map of a highway-env road, as the readers of recordings want it."""

from pathlib import Path

from highway_env.road.road import RoadNetwork

from scenarios.highway.lanes import MEETS_M, mouths, strips
from scenarios.highway.markings import lanelets
from scenarios.lanelet2 import write_map

ORIGIN_UTM_M = (294_000.0, 5_628_000.0)
"""Where highway-env's origin lies in UTM zone 32: a meadow near Aachen. highway-env's roads lie
nowhere, but lanelet2 maps are written in degrees."""

ORIGIN_LAT_LON_DEG = (50.767140, 6.078601)
"""The same in degrees, to a decimetre."""


def write_road_map(path: Path, network: RoadNetwork, *, origin_utm_m: tuple[float, float]) -> None:
    """Writes the lanelet2 map of a road; its frame is highway-env's with y upwards.

    Lanes are written in the order in which the network's graph holds them.

    Args:
        path: the `.osm` file to write.
        network: the road; straight, circular and sine lanes are known to work.
        origin_utm_m: where the frame's origin lies in UTM zone 32.

    Raises:
        AspEnvError: the road has a gap that no lane can close.
    """
    lanes, areas = lanelets(list(strips(network).values()), mouths(network))
    write_map(path, lanes, areas, origin_utm_m=origin_utm_m, join_m=MEETS_M)

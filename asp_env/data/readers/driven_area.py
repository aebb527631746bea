"""A map for recordings without one: the area that vehicles cover is drivable."""

import numpy as np
from jaxtyping import Bool, Float

from asp_env.data.classes import AgentClass
from asp_env.data.readers.layout import TrackTable
from asp_env.data.road_map import Ragged, RoadMap

CELL_M = 0.5
"""Resolution of the area. Chosen by hand: below the width of a lane by far."""

REACH_M = 2.0
"""The area reaches this far from the centres of vehicles. Chosen by hand: half a lane and a bit."""

_ON_FOOT = (AgentClass.PEDESTRIAN, AgentClass.ANIMAL, AgentClass.BICYCLE)


def driven_area(table: TrackTable, name: str) -> RoadMap:
    """A map whose drivable area is within `REACH_M` of the paths of vehicles, without lanes."""
    lengths = np.diff(table.starts)
    vehicles = ~np.isin(table.classes, [int(kind) for kind in _ON_FOOT])
    points = table.states[np.repeat(vehicles, lengths), :2].astype(np.float64)
    rings = [] if not len(points) else _rings(points)
    return RoadMap(
        name=name,
        lines=Ragged.pack([]),
        line_types=np.zeros(0, dtype=np.int8),
        drivable=Ragged.pack(rings),
        lanes=Ragged.pack([]),
        successors=np.zeros((0, 2), dtype=np.int64),
        repairs=("no map: the drivable area is what vehicles cover, and there are no lanes",),
    )


def _rings(points: Float[np.ndarray, "n 2"]) -> list[np.ndarray]:
    """Rectangles of whole cells: runs of covered cells of a row, equal ones of rows merged."""
    low = points.min(axis=0) - REACH_M - CELL_M
    cells = np.unique(np.floor((points - low) / CELL_M).astype(np.int64), axis=0)
    reach = int(np.ceil(REACH_M / CELL_M))
    width, height = (cells.max(axis=0) + reach + 1).tolist()
    covered = np.zeros((width, height), dtype=bool)
    for x in range(-reach, reach + 1):
        for y in range(-reach, reach + 1):
            if np.hypot(x, y) * CELL_M <= REACH_M:
                shifted = cells + np.array([x, y])
                covered[shifted[:, 0], shifted[:, 1]] = True
    rings, open_runs = [], dict[tuple[int, int], int]()
    for row in range(covered.shape[1] + 1):
        runs = _runs(covered[:, row]) if row < covered.shape[1] else set()
        for run in sorted(set(open_runs) - runs):
            first = open_runs.pop(run)
            (x0, x1), (y0, y1) = run, (first, row)
            corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
            rings.append(low + corners * CELL_M)
        for run in runs - set(open_runs):
            open_runs[run] = row
    return rings


def _runs(covered: Bool[np.ndarray, " cells"]) -> set[tuple[int, int]]:
    """First cell and end of each run of covered cells."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], covered, [False]]).astype(np.int8)))
    return set(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))

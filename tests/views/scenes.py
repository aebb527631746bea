"""Small scenes and maps, built by hand."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from asp_env.data.classes import AgentClass
from asp_env.data.road_map import LineType, Ragged, RoadMap
from asp_env.data.scene import Scene
from asp_env.views.chauffeurnet import ChauffeurNet
from asp_env.views.mtp import MTP

CAR_M = (4.0, 2.0)
COARSE = ChauffeurNet.make((90, 60))
RASTER_VIEWS = (COARSE, ChauffeurNet.make((90, 60), ego_trail=False), MTP.make((90, 90)))
"""Every raster view at a low resolution."""


def make_map(
    lines: Sequence[tuple[LineType, Sequence[Sequence[float]]]] = (),
    drivable: Sequence[Sequence[Sequence[float]]] = (),
) -> RoadMap:
    """A map that contains only lines and rings of drivable area."""
    return RoadMap(
        name="by hand",
        lines=Ragged.pack([np.array(points, dtype=np.float64) for _, points in lines]),
        line_types=np.array([int(kind) for kind, _ in lines], dtype=np.int64),
        drivable=Ragged.pack([np.array(ring, dtype=np.float64) for ring in drivable]),
        lanes=Ragged.pack([]),
        successors=np.zeros((0, 2), dtype=np.int64),
    )


def make_scene(
    states: Float[np.ndarray, "b a ticks 4"],
    *,
    valid: np.ndarray | None = None,
    size_m: tuple[float, float] = CAR_M,
    sizes_m: np.ndarray | None = None,
    classes: np.ndarray | None = None,
    targets: Sequence[tuple[int, int]] = ((0, 0),),
    maps: tuple[RoadMap, ...] = (),
) -> Scene:
    """A scene of the given states, of cars by default.

    With several maps, situation i lies on map i; otherwise all situations lie on the only map.
    """
    situations, agents, num_ticks, _ = states.shape
    maps = maps or (make_map(),)
    sizes = np.tile(np.array(size_m), (situations, agents, 1)) if sizes_m is None else sizes_m
    return Scene(
        states=states.astype(np.float32),
        actions=np.zeros((situations, agents, num_ticks - 1, 2), dtype=np.float32),
        valid=np.ones((situations, agents, num_ticks), dtype=bool) if valid is None else valid,
        sizes=sizes.astype(np.float32),
        classes=np.zeros((situations, agents), dtype=np.int64) if classes is None else classes,
        ids=np.tile(np.arange(agents), (situations, 1)),
        tick=np.zeros(situations, dtype=np.int64),
        targets=np.array(targets, dtype=np.int64).reshape(-1, 2),
        route=np.zeros((situations, 2, 2), dtype=np.float32),
        route_valid=np.zeros((situations, 2), dtype=bool),
        maps=maps,
        map_index=np.arange(situations, dtype=np.int64) % len(maps),
        dt_s=0.2,
    )


def standing(poses: Sequence[Sequence[float]], ticks: int = 16) -> np.ndarray:
    """States (1, agents, ticks, 4) of standing agents with the poses [x, y, heading]."""
    now = np.concatenate([np.array(poses, dtype=np.float64), np.zeros((len(poses), 1))], axis=1)
    return np.tile(now[None, :, None], (1, 1, ticks, 1))


def channel(name: str) -> int:
    return ChauffeurNet.channels.index(name)


def cross_map(turn_rad: float = 0.0, shift_m: tuple[float, float] = (0.0, 0.0)) -> RoadMap:
    """Lines and a crossing of two roads around the origin, rotated and then translated."""
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)

    def move(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        return [(cos * x - sin * y + shift_m[0], sin * x + cos * y + shift_m[1]) for x, y in points]

    roads = [
        [(-60, -4), (60, -4), (60, 4), (-60, 4)],
        [(-4, -60), (-4, -4), (-4, 4), (-4, 60), (4, 60), (4, -60)],
    ]
    lines = [
        (LineType.CURB, [(-60, 4), (-5, 5), (-4, 60)]),
        (LineType.SOLID, [(60, -4), (5, -3), (3, -60)]),
        (LineType.DASHED, [(-60, 0), (60, 0)]),
        (LineType.VIRTUAL, [(0, -60), (0, 60)]),
    ]
    return make_map([(kind, move(line)) for kind, line in lines], [move(ring) for ring in roads])


def traffic(seed: int, *, situations: int = 1, agents: int = 6) -> np.ndarray:
    """States (situations, agents, 16, 4) of agents on curves near the origin."""
    rng = np.random.default_rng(seed)
    times = 0.2 * np.arange(-15, 1)
    start = rng.uniform(-20, 20, (situations, agents, 1, 2))
    speed = rng.uniform(0, 12, (situations, agents, 1))
    heading = rng.uniform(-3, 3, (situations, agents, 1)) + 0.3 * times
    steps = (speed * 0.2)[..., None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    xy = start + np.cumsum(steps, axis=2)
    return np.concatenate(
        [xy, heading[..., None], np.broadcast_to(speed, heading.shape)[..., None]], axis=-1
    )


def busy_scene(seed: int = 0) -> Scene:
    """Three situations on two maps, five targets out of order, agents absent at some ticks.

    The agents are of all classes and overlap in places.
    """
    states = traffic(seed, situations=3)
    rng = np.random.default_rng(seed)
    valid = rng.random(states.shape[:3]) < 0.8
    classes = rng.integers(0, len(AgentClass), states.shape[:2])
    targets = [(2, 0), (0, 3), (0, 0), (1, 2), (2, 5)]
    for situation, slot in targets:
        valid[situation, slot, -1] = True
    maps = (cross_map(), cross_map(0.4, (3.0, 2.0)))
    return make_scene(states, valid=valid, classes=classes, targets=targets, maps=maps)

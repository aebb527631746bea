"""SUMO's programs `netconvert`, which builds roads, and `sumo`, which simulates traffic.

The road surface becomes lanelets: strips between a left and a right border.
"""

import importlib
import os
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from asp_env.errors import AspEnvError, MissingExtraError
from asp_env.geometry import arc_lengths, wrap_angle
from scenarios.lanelet2 import Border, Lanelet, Marking, Subtype
from scenarios.polylines import Polyline, dense, offset
from scenarios.sumo.sites import Site

STEP_S = 0.1
"""Simulation step; the frames in between are interpolated."""

IMPATIENT_AFTER_S = 15.0
"""A driver in dense traffic that has waited for this long makes vehicles on the priority road
brake. Balances near misses against jams on the side roads. Chosen by hand."""

WIDENING_M = 1.3
"""Additional width of a right-angled turn in its middle, on each side. Chosen by hand."""

_MEETS_M = 0.3

_LEAST_ROAD_M, _MOST_KINK_RAD = 3.0, 1.0
"""Bounds of sound roads: length, and change of direction at a point. Chosen by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Lane:
    """A lane as netconvert builds it."""

    edge: str
    shape: Polyline
    width_m: float
    pedestrian: bool
    """Whether only pedestrians may use it."""
    index: int
    speed_mps: float
    """Speed limit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Turn:
    """A connection from one lane to another across a junction."""

    begin: str
    end: str
    shape: Polyline


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """The roads of a site as netconvert builds them, in metres around the site's centre."""

    lanes: dict[str, Lane]
    """Lanes between junctions."""
    turns: tuple[Turn, ...]
    crossings: tuple[tuple[Polyline, float], ...]
    """Centre line and width of each zebra crossing."""
    corners: tuple[Polyline, ...]
    """Outlines of the pavement at junctions."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Movements:
    """Positions of all agents that SUMO reports; rows sorted by agent, then by time."""

    names: tuple[str, ...]
    starts: np.ndarray
    """Agent i has the rows `starts[i]:starts[i + 1]`."""
    times_s: Float[np.ndarray, " rows"]
    points: Float[np.ndarray, "rows 2"]
    """Centre of the front bumper; of pedestrians the centre of the body; m."""


def _program(name: str) -> tuple[str, dict[str, str]]:
    try:
        home = importlib.import_module("sumo").SUMO_HOME
    except ImportError:
        raise MissingExtraError("eclipse-sumo", "synthetic", "synthetic traffic") from None
    return str(Path(home) / "bin" / name), {**os.environ, "SUMO_HOME": str(home)}


def _run(name: str, *arguments: str | Path) -> None:
    program, environment = _program(name)
    done = subprocess.run(
        [program, *map(str, arguments)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        message = " ".join(done.stderr.split()) or "no message"
        raise AspEnvError(f"{name} ended with status {done.returncode}: {message}")


def build_network(site: Site, folder: Path) -> Network:
    """Builds the roads of a site with netconvert; writes `net.xml` to `folder`."""
    parts = {"nodes": site.nodes, "edges": site.edges, "connections": site.connections}
    for part, text in parts.items():
        (folder / f"plain.{part}.xml").write_text(f"<{part}>{text}</{part}>")
    _run(
        "netconvert",
        "--node-files", folder / "plain.nodes.xml",
        "--edge-files", folder / "plain.edges.xml",
        "--connection-files", folder / "plain.connections.xml",
        "--output-file", folder / "net.xml",
        "--offset.disable-normalization", "true",
        "--no-turnarounds", "true",
        "--walkingareas", "true",
        "--junctions.endpoint-shape", str(site.endpoint_shape).lower(),
        "--junctions.internal-link-detail", "24",
        "--junctions.corner-detail", "12",
        "--junctions.limit-turn-speed", "2.2",
        "--precision", "3",
    )  # fmt: skip
    return _read_network(folder / "net.xml")


def _shape(text: str) -> Polyline:
    return np.array([[float(value) for value in point.split(",")[:2]] for point in text.split()])


def _read_network(path: Path) -> Network:
    root = ElementTree.parse(path).getroot()
    lanes: dict[str, Lane] = {}
    inside: dict[str, Polyline] = {}
    crossings: list[tuple[Polyline, float]] = []
    corners: list[Polyline] = []
    for edge in root.iter("edge"):
        for lane in edge.iter("lane"):
            shape, width = _shape(lane.attrib["shape"]), float(lane.attrib["width"])
            match edge.get("function"):
                case "crossing":
                    crossings.append((shape, width))
                case "walkingarea":
                    corners.append(shape)
                case "internal":
                    inside[lane.attrib["id"]] = shape
                case _:
                    lanes[lane.attrib["id"]] = Lane(
                        edge=edge.attrib["id"],
                        shape=shape,
                        width_m=width,
                        pedestrian=lane.get("allow") == "pedestrian",
                        index=int(lane.attrib["index"]),
                        speed_mps=float(lane.attrib["speed"]),
                    )
    return Network(
        lanes=lanes,
        turns=_turns(root, lanes, inside),
        crossings=tuple(crossings),
        corners=tuple(corners),
    )


def _turns(
    root: ElementTree.Element, lanes: dict[str, Lane], inside: dict[str, Polyline]
) -> tuple[Turn, ...]:
    """Joins the pieces of each connection; some have a waiting position inside the junction."""
    onward = {
        f"{link.attrib['from']}_{link.attrib['fromLane']}": link.get("via")
        for link in root.iter("connection")
        if link.attrib["from"].startswith(":")
    }
    turns = []
    for link in root.iter("connection"):
        begin = f"{link.attrib['from']}_{link.attrib['fromLane']}"
        via = link.get("via")
        if begin not in lanes or lanes[begin].pedestrian or via is None:
            continue
        pieces = []
        while via is not None:
            pieces.append(inside[via])
            via = onward.get(via)
        shape = np.concatenate([pieces[0], *(piece[1:] for piece in pieces[1:])])
        end = f"{link.attrib['to']}_{link.attrib['toLane']}"
        turns.append(Turn(begin=begin, end=end, shape=shape))
    return tuple(turns)


def simulate(
    folder: Path,
    routes: str,
    *,
    seconds: float,
    seed: int,
    impatient: bool = False,
    lenient: bool = False,
) -> Movements:
    """Simulates `routes` on the network in `folder` with SUMO.

    Args:
        folder: holds `net.xml`.
        routes: content of the routes file.
        seconds: end of the simulation.
        seed: of SUMO's random numbers.
        impatient: whether waiting drivers accept shorter gaps after `IMPATIENT_AFTER_S` instead of
            SUMO's 180 s.
        lenient: whether agents without a possible route are left out instead of an error; on
            one-way roads not every sidewalk leads to every other.
    """
    (folder / "routes.xml").write_text(f"<routes>{routes}</routes>")
    _run(
        "sumo",
        "--net-file", folder / "net.xml",
        "--route-files", folder / "routes.xml",
        "--seed", str(seed),
        "--step-length", str(STEP_S),
        "--end", str(seconds),
        "--fcd-output", folder / "vehicles.csv",
        "--person-fcd-output", folder / "people.csv",
        "--fcd-output.attributes", "x,y",
        "--output.format", "csv",
        "--precision", "4",
        "--collision.action", "warn",
        "--time-to-teleport", "-1",
        *(("--time-to-impatience", str(IMPATIENT_AFTER_S)) if impatient else ()),
        "--ignore-route-errors", str(lenient).lower(),
        "--xml-validation", "never",
        "--no-step-log", "true",
    )  # fmt: skip
    rows = pd.concat([_positions(folder / f"{kind}.csv") for kind in ("vehicles", "people")])
    names, user = np.unique(rows["name"].to_numpy(dtype=str), return_inverse=True)
    rows = rows.iloc[np.lexsort((rows["time"], user))]
    starts = np.concatenate([[0], np.cumsum(np.bincount(user, minlength=len(names)))])
    return Movements(
        names=tuple(map(str, names)),
        starts=starts,
        times_s=rows["time"].to_numpy(dtype=np.float64),
        points=rows[["x", "y"]].to_numpy(dtype=np.float64),
    )


def _positions(path: Path) -> pd.DataFrame:
    columns = ["time", "name", "x", "y"]
    with path.open(encoding="utf-8") as lines:
        empty = lines.readline().count(";") < len(columns) - 1
    if empty:
        return pd.DataFrame({column: [] for column in columns})
    return pd.read_csv(path, sep=";", header=0, names=columns).dropna()


def lanelets(network: Network, half_size_m: tuple[float, float]) -> list[Lanelet]:
    """All lanelets of a network that reach into the image, or up to 14 m beyond it."""
    reach = np.array(half_size_m) + 14.0
    visible = {
        name: lane
        for name, lane in network.lanes.items()
        if np.any(np.all(np.abs(lane.shape) < reach, axis=1))
    }
    strips = {name: _lane_strip(lane, network.lanes, reach) for name, lane in visible.items()}
    turns = [
        _turn_strip(turn, network, strips)
        for turn in network.turns
        if turn.begin in strips and turn.end in strips and arc_lengths(turn.shape)[-1] > 0.1
    ]
    crossings = [_crossing_strip(line, width) for line, width in network.crossings]
    return [*strips.values(), *turns, *crossings]


def narrowest_lane_m(network: Network) -> float:
    """Width of the narrowest lane for vehicles, m."""
    return min(lane.width_m for lane in network.lanes.values() if not lane.pedestrian)


def is_sound(network: Network) -> bool:
    """Whether vehicles can drive on all roads without a jump or a kink.

    At small angles netconvert enlarges a junction beyond the next one, so that the road between
    them vanishes or points backwards.
    """
    lengths = [
        arc_lengths(lane.shape)[-1]
        for lane in network.lanes.values()
        if not lane.edge.startswith("ring")
    ]
    paths = [
        np.concatenate(
            [network.lanes[turn.begin].shape[-2:], turn.shape, network.lanes[turn.end].shape[:2]]
        )
        for turn in network.turns
    ]
    sharpest_rad = max(map(_sharpest_kink_rad, paths))
    return bool(min(lengths) > _LEAST_ROAD_M and sharpest_rad < _MOST_KINK_RAD)


def _sharpest_kink_rad(path: Polyline) -> float:
    steps = np.diff(path, axis=0)
    steps = steps[np.hypot(*steps.T) > 0.05]
    ahead = np.arctan2(steps[:, 1], steps[:, 0])
    return float(np.abs(wrap_angle(np.diff(ahead))).max(initial=0.0))


def _lane_strip(lane: Lane, lanes: dict[str, Lane], reach: np.ndarray) -> Lanelet:
    half = 0.5 * lane.width_m
    left, right = offset(lane.shape, half), offset(lane.shape, -half)
    inside = np.flatnonzero(np.all(np.abs(lane.shape) < reach, axis=1))
    part = slice(max(0, inside[0] - 1), inside[-1] + 2)
    same_edge = [
        other for other in lanes.values() if other.edge == lane.edge and not other.pedestrian
    ]
    if lane.pedestrian:
        left_is, right_is = "curb", "virtual"
        subtype: Subtype = "walkway"
    else:
        subtype = "road"
        outermost = lane.index == min(other.index for other in same_edge)
        innermost = lane.index == max(other.index for other in same_edge)
        right_is = "curb" if outermost else "dashed"
        left_is = "curb" if innermost and not _faces_traffic(lane, left, lanes) else "dashed"
    return Lanelet(
        subtype=subtype,
        left=(Border(line=left[part], marking=left_is),),
        right=(Border(line=right[part], marking=right_is),),
        speed_limit_mps=None if lane.pedestrian else lane.speed_mps,
    )


def _faces_traffic(lane: Lane, left: Polyline, lanes: dict[str, Lane]) -> bool:
    """Whether the left border of the lane is also that of an opposite lane."""
    for other in lanes.values():
        if other.edge == lane.edge or other.pedestrian or len(other.shape) != len(lane.shape):
            continue
        facing = offset(other.shape, 0.5 * other.width_m)[::-1]
        if np.hypot(*(facing - left)[1:-1].T).max(initial=0.0) < _MEETS_M and (
            np.hypot(*(facing - left)[[0, -1]].T).min() < _MEETS_M
        ):
            return True
    return False


def _right_turn_rad(turn: Turn) -> float:
    first, last = np.diff(turn.shape[:2], axis=0)[0], np.diff(turn.shape[-2:], axis=0)[0]
    cross = first[0] * last[1] - first[1] * last[0]
    return -float(np.arctan2(cross, first @ last))


def _turn_strip(turn: Turn, network: Network, strips: dict[str, Lanelet]) -> Lanelet:
    begin, end = strips[turn.begin], strips[turn.end]
    angle = _right_turn_rad(turn)
    left_is = _side(turn, network, strips, lambda lanelet: lanelet.left[0], -1.0)
    right_is = _side(turn, network, strips, lambda lanelet: lanelet.right[0], 1.0)
    line = dense(turn.shape, 1.0)
    arc = arc_lengths(line)
    share = arc / arc[-1]
    extra = WIDENING_M * min(abs(angle) / (0.5 * np.pi), 1.0) * np.sin(np.pi * share) ** 2
    before, after = network.lanes[turn.begin].width_m, network.lanes[turn.end].width_m
    half = 0.5 * (before + (after - before) * share)
    left = offset(line, half + (0.0 if left_is == "curb" else extra))
    right = offset(line, -half - extra)
    left[0], right[0] = begin.left_line[-1], begin.right_line[-1]
    left[-1], right[-1] = end.left_line[0], end.right_line[0]
    return Lanelet(
        subtype="road",
        left=(Border(line=left, marking=left_is),),
        right=(Border(line=right, marking=right_is),),
        speed_limit_mps=max(network.lanes[turn.begin].speed_mps, network.lanes[turn.end].speed_mps),
    )


def _side(
    turn: Turn,
    network: Network,
    strips: dict[str, Lanelet],
    border: Callable[[Lanelet], Border],
    sign: float,
) -> Marking:
    """Marking of one side: a kerb continues across a junction along its outermost connection."""
    both = border(strips[turn.begin]).marking, border(strips[turn.end]).marking
    rivals = [t for t in network.turns if t.begin == turn.begin or t.end == turn.end]
    outermost = all(
        sign * _right_turn_rad(turn) >= sign * _right_turn_rad(rival) - 1e-9
        if rival.begin == turn.begin
        else _starts_inside(turn, rival, sign)
        for rival in rivals
    )
    return "curb" if both == ("curb", "curb") and outermost else "virtual"


def _starts_inside(turn: Turn, rival: Turn, sign: float) -> bool:
    """Whether another connection to the same lane starts on the inner side."""
    along = turn.shape[-1] - turn.shape[-2]
    offset_m = rival.shape[0] - turn.shape[0]
    cross = along[0] * offset_m[1] - along[1] * offset_m[0]
    return bool(sign * cross >= 0.0)


def _crossing_strip(line: Polyline, width_m: float) -> Lanelet:
    return Lanelet(
        subtype="crosswalk",
        left=(Border(line=offset(line, 0.5 * width_m), marking="zebra"),),
        right=(Border(line=offset(line, -0.5 * width_m), marking="zebra"),),
    )

"""SUMO as two programs: `netconvert` builds the roads, `sumo` moves those who use them."""

import importlib
import os
import subprocess
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from asp_env.errors import AspEnvError, MissingExtraError
from scenarios.polylines import Polyline
from scenarios.synthetic.site import Site

STEP_S = 0.1
"""Step of the simulation; the frames in between are interpolated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Lane:
    """One lane as netconvert built it."""

    edge: str
    shape: Polyline
    width_m: float
    feet: bool
    """Whether only pedestrians use it."""
    index: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Turn:
    """How traffic gets from one lane to another across a junction."""

    begin: str
    end: str
    shape: Polyline


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """What netconvert made of a site, in metres around its middle."""

    lanes: dict[str, Lane]
    """Lanes between junctions."""
    turns: tuple[Turn, ...]
    crossings: tuple[tuple[Polyline, float], ...]
    """Middle line and width of every zebra crossing."""
    corners: tuple[Polyline, ...]
    """Outlines of the pavement at junctions."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Movements:
    """Where SUMO says that everybody was: rows sorted by road user, then time."""

    names: tuple[str, ...]
    starts: np.ndarray
    """User i has the rows `starts[i]:starts[i + 1]`."""
    times_s: Float[np.ndarray, " rows"]
    points: Float[np.ndarray, "rows 2"]
    """Middle of the front bumper; for pedestrians the middle of the body."""


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
        said = " ".join(done.stderr.split()) or "nothing"
        raise AspEnvError(f"{name} ended with status {done.returncode}; it said: {said}")


def build_network(site: Site, folder: Path) -> Network:
    """Has netconvert build the site's roads; leaves `net.xml` in `folder`."""
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
                        feet=lane.get("allow") == "pedestrian",
                        index=int(lane.attrib["index"]),
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
    """Joins the pieces of each way across a junction; some wait in its middle."""
    onward = {
        f"{link.attrib['from']}_{link.attrib['fromLane']}": link.get("via")
        for link in root.iter("connection")
        if link.attrib["from"].startswith(":")
    }
    turns = []
    for link in root.iter("connection"):
        begin = f"{link.attrib['from']}_{link.attrib['fromLane']}"
        via = link.get("via")
        if begin not in lanes or lanes[begin].feet or via is None:
            continue
        pieces = []
        while via is not None:
            pieces.append(inside[via])
            via = onward.get(via)
        shape = np.concatenate([pieces[0], *(piece[1:] for piece in pieces[1:])])
        end = f"{link.attrib['to']}_{link.attrib['toLane']}"
        turns.append(Turn(begin=begin, end=end, shape=shape))
    return tuple(turns)


def simulate(folder: Path, routes: str, *, seconds: float, seed: int) -> Movements:
    """Has sumo drive `routes` on the network in `folder`."""
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
        "--xml-validation", "never",
        "--no-step-log", "true",
    )  # fmt: skip
    rows = pd.concat([_positions(folder / f"{who}.csv") for who in ("vehicles", "people")])
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
    with path.open() as lines:
        nobody = lines.readline().count(";") < len(columns) - 1
    if nobody:
        return pd.DataFrame({column: [] for column in columns})
    return pd.read_csv(path, sep=";", header=0, names=columns).dropna()

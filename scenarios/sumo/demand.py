"""Demand: which agents appear, when, on which route, and with which driver parameters."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from scenarios.sumo.drivers import dense_driver
from scenarios.sumo.motion import PathStyle
from scenarios.sumo.sites import LEFT_TURN_RAD, Arm, Site, right_turn_rad

Traffic = Literal["normal", "dense", "varied"]
"""`dense` has more vehicles, more left turns and drivers of four temperaments; `varied` draws all
of this, and the sites, maps and trackers, for each location."""

VEHICLES_PER_HOUR = {
    "crossroads": (850.0, 1150.0),
    "t-junction": (800.0, 1050.0),
    "roundabout": (1000.0, 1350.0),
    "two-lane-roundabout": (1050.0, 1400.0),
}
DENSE_VEHICLES_PER_HOUR = {
    "crossroads": (1400.0, 1900.0),
    "t-junction": (1400.0, 1900.0),
    "roundabout": (1400.0, 1900.0),
    "two-lane-roundabout": (2000.0, 2600.0),
}
"""On the main road of an intersection, vehicles follow each other after 3 to 6 s. Balances how many
vehicles meet against jams. Chosen by hand."""

DENSE_FAR_ROUND_LEFT = 0.6
"""Share of the vehicles that pass more than half of a ring and enter it on the left lane, in dense
traffic; the others pass it on the outer lane. Chosen by hand."""

DENSE_LEFT_TURNS = 1.8
"""Odds of a left turn in dense traffic, relative to those in normal traffic. Chosen by hand."""

STOP_WITHIN_M = (6.0, 34.0)
"""Distance of a stop from the crossing or, behind it, its end. Chosen by hand: within the image."""

PEDESTRIANS_PER_HOUR = (130.0, 260.0)
SHARES = {
    "car": 0.74,
    "van": 0.09,
    "truck": 0.05,
    "bus": 0.02,
    "motorcycle": 0.03,
    "bicycle": 0.07,
}
SIZES_M = {
    "car": ((3.9, 4.9), (1.7, 1.9)),
    "van": ((5.0, 6.0), (1.95, 2.1)),
    "truck": ((7.5, 9.0), (2.4, 2.5)),
    "bus": ((11.0, 12.0), (2.5, 2.55)),
    "motorcycle": ((2.0, 2.3), (0.75, 0.85)),
    "bicycle": ((1.7, 1.9), (0.6, 0.7)),
    "pedestrian": ((0.4, 0.5), (0.5, 0.6)),
}
"""Ranges of length and width. Chosen by hand, like the rates and shares above."""
SUMO_CLASSES = {
    "car": "passenger",
    "van": "delivery",
    "truck": "truck",
    "bus": "bus",
    "motorcycle": "motorcycle",
    "bicycle": "bicycle",
}
SHARPEST_TURN_RAD = {"bus": np.radians(50.0), "truck": np.radians(110.0)}
"""Routes of long vehicles have no right turn that is sharper than this."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mix:
    """From what the agents of a simulation are drawn."""

    vehicles_per_hour: tuple[float, float]
    pedestrians_per_hour: tuple[float, float]
    shares: Mapping[str, float]
    """Share of each class of vehicles."""
    left_odds: float = 1.0
    """Odds of a left turn, relative to those that follow from the weights of the arms."""
    far_round_left: float = 0.9
    """Share of the vehicles that pass more than half of a ring and enter it on the left lane."""
    impatient: bool = False
    """Whether waiting drivers accept shorter gaps soon; see `simulate`."""
    lenient: bool = False
    """Whether agents without a possible route are left out; see `simulate`."""
    driver: Callable[[np.random.Generator, str], dict[str, float]] | None = None
    """Draws attributes of SUMO's vehicle type for a class; they replace the usual ones."""
    stops: float = 0.0
    """Share of the vehicles that stop on their lane for a while."""
    stop_s: tuple[float, float] = (0.0, 0.0)
    """Duration of these stops."""
    path_style: Callable[[np.random.Generator, str, float], PathStyle] | None = None
    """Draws the deviation from the middle of the lane for a class and a width, m."""


def usual_mix(kind: str, traffic: Traffic) -> Mix:
    """The mix of normal or dense traffic at a site of this kind."""
    if traffic == "normal":
        return Mix(
            vehicles_per_hour=VEHICLES_PER_HOUR[kind],
            pedestrians_per_hour=PEDESTRIANS_PER_HOUR,
            shares=SHARES,
        )
    return Mix(
        vehicles_per_hour=DENSE_VEHICLES_PER_HOUR[kind],
        pedestrians_per_hour=PEDESTRIANS_PER_HOUR,
        shares=SHARES,
        left_odds=DENSE_LEFT_TURNS,
        far_round_left=DENSE_FAR_ROUND_LEFT,
        impatient=True,
        driver=lambda rng, _: dense_driver(rng),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Demand:
    """All agents of a simulation."""

    users: dict[str, "RoadUser"]
    """Agents by name."""
    entries: tuple[tuple[float, str, str], ...]
    """(departure s, name, XML element), by departure."""

    def without(self, names: set[str]) -> "Demand":
        """The same demand without some agents."""
        entries = tuple(entry for entry in self.entries if entry[1] not in names)
        return Demand(users=self.users, entries=entries)

    @property
    def routes(self) -> str:
        """The content of SUMO's routes file."""
        return "".join(text for _, _, text in self.entries)


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadUser:
    """Class, as named in the files, and size of an agent."""

    kind: str
    length_m: float
    width_m: float
    style: PathStyle | None = None
    """Deviation from the middle of the lane."""


def demand(rng: np.random.Generator, site: Site, seconds: float, mix: Mix | None = None) -> Demand:
    """Draws the agents that depart within `seconds` at a site, by default of normal traffic."""
    mix = mix or usual_mix(site.kind, "normal")
    users: dict[str, RoadUser] = {}
    entries: list[tuple[float, str, str]] = []
    hours = seconds / 3600.0
    kinds, shares = list(mix.shares), np.array(list(mix.shares.values()))
    weights = np.array([arm.weight for arm in site.arms])
    count = rng.poisson(hours * rng.uniform(*mix.vehicles_per_hour))
    for number in range(count):
        name = f"v{number}"
        depart = float(rng.uniform(0.0, seconds))
        kind = str(rng.choice(kinds, p=shares / shares.sum()))
        begin, end = _route(rng, site.arms, weights, kind, mix)
        users[name] = _user(rng, kind, mix)
        vehicle = _vehicle_xml(rng, name, users[name], depart, begin, end, mix)
        entries.append((depart, name, vehicle))
    for number in range(rng.poisson(hours * rng.uniform(*mix.pedestrians_per_hour))):
        name = f"p{number}"
        depart = float(rng.uniform(0.0, seconds))
        users[name] = _user(rng, "pedestrian", mix)
        entries.append((depart, name, _person_xml(rng, name, users[name], depart, site.arms)))
    return Demand(users=users, entries=tuple(sorted(entries)))


def _user(rng: np.random.Generator, kind: str, mix: Mix) -> RoadUser:
    length, width = SIZES_M[kind]
    length_m = round(float(rng.uniform(*length)), 2)
    width_m = round(float(rng.uniform(*width)), 2)
    style = mix.path_style(rng, kind, width_m) if mix.path_style else None
    return RoadUser(kind=kind, length_m=length_m, width_m=width_m, style=style)


def _route(
    rng: np.random.Generator,
    arms: tuple[Arm, ...],
    weights: np.ndarray,
    kind: str,
    mix: Mix,
) -> tuple[Arm, Arm]:
    sharpest = SHARPEST_TURN_RAD.get(kind, np.pi)
    pairs = [
        (a, b)
        for a in range(len(arms))
        for b in range(len(arms))
        if a != b and arms[a].enters and arms[b].leaves
    ]
    turns = {(a, b): right_turn_rad(arms[a].angle_rad, arms[b].angle_rad) for a, b in pairs}
    allowed = [pair for pair in pairs if turns[pair] <= sharpest] or pairs
    chances = np.array([weights[a] * weights[b] for a, b in allowed])
    is_left = np.array([turns[pair] < -LEFT_TURN_RAD for pair in allowed])
    chances = np.where(is_left, mix.left_odds, 1.0) * chances
    begin, end = allowed[int(rng.choice(len(allowed), p=chances / chances.sum()))]
    return arms[begin], arms[end]


def _vehicle_xml(
    rng: np.random.Generator,
    name: str,
    user: RoadUser,
    depart: float,
    begin: Arm,
    end: Arm,
    mix: Mix,
) -> str:
    heavy = user.kind in ("truck", "bus")
    top_mps = rng.uniform(4.0, 6.5) if user.kind == "bicycle" else 40.0
    accel = rng.uniform(1.0, 1.5) if heavy or user.kind == "bicycle" else rng.uniform(1.5, 2.8)
    parameters = {
        "vClass": SUMO_CLASSES[user.kind],
        "length": user.length_m,
        "width": user.width_m,
        "maxSpeed": top_mps,
        "accel": accel,
        "decel": rng.uniform(2.0, 3.5),
        "emergencyDecel": 8.0,
        "minGap": rng.uniform(1.2, 2.8),
        "tau": rng.uniform(0.9, 1.9),
        "speedFactor": float(np.clip(rng.normal(0.97, 0.12), 0.7, 1.25)),
        "speedDev": 0.0,
        "carFollowModel": "EIDM",
        "treaction": rng.uniform(0.3, 1.0),
        "tpersdrive": rng.uniform(2.0, 8.0),
        "sigmaerror": rng.uniform(0.05, 0.25),
        "lcKeepRight": 0.0,
        "lcSpeedGain": 0.0,
        "jmTimegapMinor": rng.uniform(0.5, 1.5),
        "jmCrossingGap": rng.uniform(2.0, 6.0),
        "impatience": rng.uniform(0.4, 0.8),
    }
    if mix.driver is not None:
        parameters |= mix.driver(rng, user.kind)
    lane = _depart_lane(rng, user, begin, end, mix)
    stop = _stop_xml(rng, user, begin, end, lane, mix) if mix.stops else ""
    attributes = " ".join(
        f'{key}="{value}"' if isinstance(value, str) else f'{key}="{value:.4f}"'
        for key, value in parameters.items()
    )
    return (
        f'<vType id="t{name}" {attributes}/>'
        f'<trip id="{name}" type="t{name}" depart="{depart:.3f}" from="{begin.enter}" '
        f'to="{end.leave}" departSpeed="desired" departPos="base" departLane="{lane}"'
        + (f">{stop}</trip>" if stop else "/>")
    )


def _stop_xml(
    rng: np.random.Generator, user: RoadUser, begin: Arm, end: Arm, lane: int, mix: Mix
) -> str:
    """A stop on the lane before or after the junction, of a share of the vehicles."""
    after, at_m = rng.random() < 0.5, rng.uniform(*STOP_WITHIN_M)
    duration = rng.uniform(*mix.stop_s)
    if rng.random() >= mix.stops or (after and not end.one_lane_leaves):
        return ""
    edge, position = (end.leave, at_m) if after else (begin.enter, begin.length_m - at_m)
    on = f"{edge}_{1 if after else lane}"
    position = max(position, user.length_m + 1.0)
    return f'<stop lane="{on}" endPos="{position:.2f}" duration="{duration:.1f}"/>'


def _depart_lane(rng: np.random.Generator, user: RoadUser, begin: Arm, end: Arm, mix: Mix) -> int:
    """The lane on which a vehicle enters; lane 0 is the sidewalk.

    In a ring, vehicles that pass more than half of it mostly start on the left. At a junction the
    left lane is for left turns.
    """
    angle = right_turn_rad(begin.angle_rad, end.angle_rad)
    if begin.left_turns_only:
        return begin.lanes if angle < -LEFT_TURN_RAD else 1
    if begin.starts:
        return int(rng.choice(begin.starts[end.leave]))
    far_round = angle < -0.3 and user.kind not in ("truck", "bus")
    return begin.lanes if far_round and rng.random() < mix.far_round_left else 1


def _person_xml(
    rng: np.random.Generator, name: str, user: RoadUser, depart: float, arms: tuple[Arm, ...]
) -> str:
    begin, end = rng.choice(len(arms), 2, replace=False)
    left_side, left_end = rng.random(2) < 0.5
    left_side = (left_side and arms[begin].leaves) or not arms[begin].enters
    left_end = (left_end and arms[end].enters) or not arms[end].leaves
    start = arms[begin].leave if left_side else arms[begin].enter
    goal = arms[end].enter if left_end else arms[end].leave
    return (
        f'<vType id="t{name}" vClass="pedestrian" length="{user.length_m}" '
        f'width="{user.width_m}" maxSpeed="{rng.uniform(1.0, 1.7):.3f}"/>'
        f'<person id="{name}" type="t{name}" depart="{depart:.3f}" '
        f'departPos="{-30 if left_side else 30}">'
        f'<walk from="{start}" to="{goal}" arrivalPos="{30 if left_end else -30}"/></person>'
    )

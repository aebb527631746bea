"""Whose definitions a drive is judged by: bundles of thresholds and rules with a name."""

from collections.abc import Mapping
from dataclasses import dataclass

from asp_env.errors import unknown_name
from asp_env.metrics.drivable import OFF_ROAD_M
from asp_env.metrics.driving.ttc import TtcRule


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """The rules in which published scores differ. What is not here, all of them share."""

    name: str
    version: int
    """Raised whenever the same drive would get another number."""
    about: str
    off_road_m: float
    """A corner further outside the drivable area than this is off the road."""
    any_side_is_fault: bool
    """Whether a contact at the ego's side is its fault everywhere, or, as in nuPlan, only while it
    is in several lanes or off the road."""
    ttc: TtcRule
    min_progress_m: float
    """Ways that are compared for progress are no shorter than this: that of the log, and with
    `lifts` that of the ego too."""
    lifts: bool
    multipliers: tuple[str, ...] = ()
    """Metrics whose product scales the score."""
    weights: Mapping[str, float]
    """Metrics whose weighted mean is the score; without any there is no score."""
    shown: tuple[str, ...]
    """Metrics that the table shows, in its order."""

    @property
    def label(self) -> str:
        """Name and version, as results carry them."""
        return f"{self.name} {self.version}"


_NUPLAN_TTC = TtcRule(
    futures="constant-velocity",
    step_s=0.1,
    horizon_s=3.0,
    min_ttc_s=0.95,
    sector=True,
    ignore_after_contact=False,
    standing_mps=0.005,
)
_PDMS_WEIGHTS = {"progress": 5.0, "TTC": 5.0, "comfort": 2.0}

NUPLAN = Rules(
    name="nuplan",
    version=1,
    about="nuPlan's closed-loop score",
    off_road_m=OFF_ROAD_M,
    any_side_is_fault=False,
    ttc=_NUPLAN_TTC,
    min_progress_m=2.0,
    lifts=True,
    multipliers=("no at-fault collision", "on road", "direction", "making progress"),
    weights={"progress": 5.0, "TTC": 5.0, "speed": 4.0, "comfort": 2.0},
    shown=("no at-fault collision", "on road", "direction", "TTC", "progress", "speed", "comfort"),
)

PDMS = Rules(
    name="pdms",
    version=1,
    about="NAVSIM's predictive driver model score over a whole closed-loop episode",
    off_road_m=OFF_ROAD_M,
    any_side_is_fault=False,
    ttc=TtcRule(
        futures="recorded",
        step_s=0.3,
        horizon_s=0.9,  # the last step within NAVSIM's window of 1 s
        min_ttc_s=0.95,
        sector=True,
        ignore_after_contact=False,
        standing_mps=0.005,
    ),
    min_progress_m=1.0,
    lifts=False,
    multipliers=("no at-fault collision", "on road"),
    weights=_PDMS_WEIGHTS,
    shown=("no at-fault collision", "on road", "TTC", "progress", "comfort"),
)

WAYMAX = Rules(
    name="waymax",
    version=1,
    about="Waymax's metrics; it has no score",
    off_road_m=0.0,
    any_side_is_fault=True,
    ttc=_NUPLAN_TTC,
    min_progress_m=1.0,
    lifts=False,
    weights={},
    shown=(
        *("no collision", "on road", "right way", "feasible"),
        *("progress", "log divergence"),
    ),
)

STRICT = Rules(
    name="strict",
    version=1,
    about="PDMS on the road as mapped, at fault at any side, with TTC to all but those behind",
    off_road_m=OFF_ROAD_M,
    any_side_is_fault=True,
    ttc=TtcRule(
        futures="constant-velocity",
        step_s=0.1,
        horizon_s=3.0,
        min_ttc_s=0.95,
        sector=False,
        ignore_after_contact=True,
        standing_mps=0.05,
    ),
    min_progress_m=1.0,
    lifts=False,
    multipliers=("no at-fault collision", "on mapped road"),
    weights=_PDMS_WEIGHTS,
    shown=("no at-fault collision", "on mapped road", "TTC", "progress", "comfort"),
)

RULES = {preset.name: preset for preset in (NUPLAN, PDMS, WAYMAX, STRICT)}
DEFAULT_RULES = PDMS.name


def find_rules(name: str) -> Rules:
    """A preset by its name.

    Raises:
        AspEnvError: there is none of that name.
    """
    if name not in RULES:
        raise unknown_name("metrics", name, list(RULES))
    return RULES[name]

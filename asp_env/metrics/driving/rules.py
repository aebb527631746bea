"""The rules by which drives are evaluated: named sets of thresholds and definitions."""

from collections.abc import Mapping
from dataclasses import dataclass

from asp_env.errors import unknown_name
from asp_env.metrics.drivable import OFF_ROAD_M
from asp_env.metrics.driving.ttc import TtcRule


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """The definitions in which published scores differ. All other definitions are shared."""

    name: str
    version: int
    """Increased whenever the same drive would receive another number."""
    description: str
    off_road_m: float
    """The ego is off the road if a corner is further outside the drivable area than this."""
    any_side_is_fault: bool
    """Whether a contact at the ego's side is always its fault, or, as in nuPlan, only while it is
    in several lanes or off the road."""
    ttc: TtcRule
    min_progress_m: float
    """The progress of the log is at least this, and with `lifts_ego` that of the ego too."""
    lifts_ego: bool
    multipliers: tuple[str, ...] = ()
    """Metrics whose product scales the score."""
    weights: Mapping[str, float]
    """Metrics whose weighted mean is the score; without weights there is no score."""
    shown: tuple[str, ...]
    """Metrics in the printed table, in their order."""

    @property
    def label(self) -> str:
        """Name and version, as results contain them."""
        return f"{self.name} {self.version}"


_NUPLAN_TTC = TtcRule(
    futures="constant-velocity",
    step_s=0.1,
    horizon_s=3.0,
    min_ttc_s=0.95,
    sector=True,
    ignore_after_contact=True,
    standing_mps=0.005,
)
_PDMS_TTC = TtcRule(
    futures="recorded",
    step_s=0.3,
    horizon_s=0.9,  # the last step within NAVSIM's window of 1 s
    min_ttc_s=0.95,
    sector=True,
    ignore_after_contact=True,
    standing_mps=0.005,
)
_PDMS_WEIGHTS = {"progress": 5.0, "TTC": 5.0, "comfort": 2.0}

NUPLAN = Rules(
    name="nuplan",
    version=1,
    description="nuPlan's closed-loop score",
    off_road_m=OFF_ROAD_M,
    any_side_is_fault=False,
    ttc=_NUPLAN_TTC,
    min_progress_m=2.0,
    lifts_ego=True,
    multipliers=("no at-fault collision", "on road", "direction", "making progress"),
    weights={"progress": 5.0, "TTC": 5.0, "speed": 4.0, "comfort": 2.0},
    shown=("no at-fault collision", "on road", "direction", "TTC", "progress", "speed", "comfort"),
)

PDMS = Rules(
    name="pdms",
    version=1,
    description="NAVSIM's predictive driver model score over a whole closed-loop episode",
    off_road_m=OFF_ROAD_M,
    any_side_is_fault=False,
    ttc=_PDMS_TTC,
    min_progress_m=1.0,
    lifts_ego=False,
    multipliers=("no at-fault collision", "on road"),
    weights=_PDMS_WEIGHTS,
    shown=("no at-fault collision", "on road", "TTC", "progress", "comfort"),
)

WAYMAX = Rules(
    name="waymax",
    version=1,
    description="Waymax's metrics; it has no score",
    off_road_m=0.0,
    any_side_is_fault=True,
    ttc=_NUPLAN_TTC,
    min_progress_m=1.0,
    lifts_ego=False,
    weights={},
    shown=(
        *("no collision", "on road", "right way", "feasible"),
        *("progress", "log divergence"),
    ),
)

STRICT = Rules(
    name="strict",
    version=1,
    description=(
        "PDMS on the road as mapped, at fault at any side, with TTC to all but those behind"
    ),
    off_road_m=OFF_ROAD_M,
    any_side_is_fault=True,
    ttc=TtcRule(
        futures="constant-velocity",
        step_s=0.1,
        horizon_s=3.0,
        min_ttc_s=0.95,
        sector=False,
        ignore_after_contact=False,
        standing_mps=0.05,
    ),
    min_progress_m=1.0,
    lifts_ego=False,
    multipliers=("no at-fault collision", "on mapped road"),
    weights=_PDMS_WEIGHTS,
    shown=("no at-fault collision", "on mapped road", "TTC", "progress", "comfort"),
)

GRADED = Rules(
    name="graded",
    version=1,
    description="PDMS with continuous measures in place of the thresholds of TTC and comfort",
    off_road_m=OFF_ROAD_M,
    any_side_is_fault=False,
    ttc=_PDMS_TTC,
    min_progress_m=1.0,
    lifts_ego=False,
    multipliers=("no at-fault collision", "on road"),
    weights={"progress": 5.0, "safety margin": 5.0, "smoothness": 2.0},
    shown=(
        *("no at-fault collision", "on road", "safety margin", "progress", "smoothness"),
        "driving cost",
    ),
)

RULES = {rules.name: rules for rules in (NUPLAN, PDMS, WAYMAX, STRICT, GRADED)}
DEFAULT_RULES = PDMS.name


def find_rules(name: str) -> Rules:
    """The rules of the given name.

    Raises:
        AspEnvError: the name is unknown; the known names are listed.
    """
    if name not in RULES:
        raise unknown_name("rules", name, list(RULES))
    return RULES[name]

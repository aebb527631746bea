"""What each metric says, in a line, and which way is better."""

from dataclasses import dataclass
from typing import Literal

Better = Literal["lower", "higher", "neither"]


@dataclass(frozen=True, slots=True, kw_only=True)
class MetricNote:
    """How a metric is printed and read."""

    label: str
    unit: str
    """`m`, `m²`, `%` (the value is a share of one), … or nothing."""
    better: Better
    text: str

    def format(self, value: float) -> str:
        """The value as text, without its unit."""
        if self.unit == "%":
            return f"{100 * value:.1f}"
        return f"{value:.3f}" if 0 < abs(value) < 0.1 else f"{value:.2f}"


def _note(label: str, unit: str, better: Better, text: str) -> MetricNote:
    return MetricNote(label=label, unit=unit, better=better, text=text)


NOTES = {
    "FDE": _note("FDE", "m", "lower", "Distance from the forecast's last position to the truth."),
    "FDE / constant velocity": _note(
        "FDE / CV",
        "",
        "lower",
        "FDE over constant velocity's on the same targets; paired interval.",
    ),
    "ADE": _note("ADE", "m", "lower", "Distance to the truth, averaged over the forecast's ticks."),
    "L2": _note("L2", "m", "lower", "Distance to the truth so many seconds ahead."),
    "MAE": _note("MAE", "m", "lower", "Mean absolute error of x and y over all ticks."),
    "MSE": _note("MSE", "m²", "lower", "Mean squared error of x and y over all ticks."),
    "miss": _note("Miss", "%", "lower", "Share of targets whose last position is over 2 m off."),
    "brier-FDE": _note(
        "Brier FDE", "m", "lower", "FDE plus (1 - p)², p being the judged mode's probability."
    ),
    "NLL": _note(
        "NLL",
        "nats",
        "lower",
        "Negative log density of the true end under Gaussians of 1 m around the modes' ends.",
    ),
    "ECE": _note(
        "ECE",
        "",
        "lower",
        "Expected calibration error of the modes' probabilities of ending nearest, in ten bins.",
    ),
    "Brier": _note(
        "Brier", "", "lower", "Squared error of the modes' probabilities of ending nearest, summed."
    ),
    "off-road": _note(
        "Off road",
        "%",
        "lower",
        "Share of modes whose centre leaves the drivable area by over 0.3 m; of targets that keep "
        "to it.",
    ),
    "overlap": _note(
        "Overlap",
        "%",
        "lower",
        "Share of modes whose box meets that of another road user where the two were recorded "
        "apart.",
    ),
    "infeasible": _note(
        "Infeasible",
        "%",
        "lower",
        "Share of modes that accelerate by over 10.4 m/s² or curve by over 0.3 1/m.",
    ),
    "inconsistency": _note(
        "Inconsistency",
        "m",
        "lower",
        "Distance between most probable forecasts made 0.6 s apart, where they speak of one time.",
    ),
    "score": _note(
        "Score",
        "%",
        "higher",
        "The score of the preset that judged: its multipliers times its weighted mean, 0 to 100 %.",
    ),
    "score - constant-velocity": _note(
        "Score - CV",
        "%",
        "higher",
        "Score less that of the same planner with constant velocity; paired interval.",
    ),
    "no at-fault collision": _note(
        "No fault",
        "%",
        "higher",
        "Drives in which the ego hit nobody standing, nobody at its front and nobody at its side, "
        "by the preset's rule; being hit from behind, or while standing, is no fault.",
    ),
    "no collision": _note(
        "No contact", "%", "higher", "Drives in which the ego's box met nobody else's at all."
    ),
    "on road": _note(
        "On road",
        "%",
        "higher",
        "Drives without a corner further outside the drivable area than preset and log allow.",
    ),
    "on mapped road": _note(
        "On the map", "%", "higher", "The same where the log's own way off the map excuses nothing."
    ),
    "progress": _note(
        "Progress", "%", "higher", "Way made good, as a share of the recorded ego's."
    ),
    "making progress": _note(
        "Makes way", "%", "higher", "Drives over at least a fifth of the recorded ego's way."
    ),
    "TTC": _note(
        "TTC", "%", "higher", "Drives that always kept their time to any collision above 0.95 s."
    ),
    "direction": _note(
        "Direction", "%", "higher", "100 % up to 2 m against the traffic within 1 s, 0 above 6 m."
    ),
    "right way": _note(
        "Right way", "%", "higher", "Drives that stayed within 3.5 m of a way on from their start."
    ),
    "speed": _note(
        "Speed limit", "%", "higher", "1 less the mean overspeed over 2.23 m/s, at least 0."
    ),
    "feasible": _note(
        "Feasible", "%", "higher", "Drives within Waymax's bounds of acceleration and curvature."
    ),
    "no hit from behind": _note(
        "No rear hit", "%", "higher", "Drives in which nobody ran into the ego from behind."
    ),
    "comfort": _note(
        "Comfort", "%", "higher", "Drives within nuPlan's bounds of acceleration, jerk and yaw."
    ),
    "log divergence": _note(
        "Off the log", "m", "neither", "Mean distance between the ego and the recorded one."
    ),
    "realism": _note(
        "Realism",
        "%",
        "higher",
        "How likely the recorded traffic is under the simulated one, by the weights of WOSAC 2025.",
    ),
    "route deviation": _note(
        "Off the route", "m", "neither", "Mean distance to the way that the recorded ego took."
    ),
}
"""By name in `metrics.csv`."""


def note(metric: str) -> MetricNote:
    """The note of a metric; an unknown one keeps its name and is ranked neither way."""
    return NOTES.get(metric) or _note(metric, "", "neither", "")

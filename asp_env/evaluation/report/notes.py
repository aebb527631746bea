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
        return f"{value:.3f}" if abs(value) < 0.1 else f"{value:.2f}"


def _note(label: str, unit: str, better: Better, text: str) -> MetricNote:
    return MetricNote(label=label, unit=unit, better=better, text=text)


NOTES = {
    "fde": _note("FDE", "m", "lower", "Distance from the forecast's last position to the truth."),
    "ade": _note("ADE", "m", "lower", "Distance to the truth, averaged over the forecast's ticks."),
    "mae": _note("MAE", "m", "lower", "Mean absolute error of x and y over all ticks."),
    "mse": _note("MSE", "m²", "lower", "Mean squared error of x and y over all ticks."),
    "minade": _note("minADE", "m", "lower", "ADE of the mode that has the smallest one."),
    "minfde": _note("minFDE", "m", "lower", "FDE of the mode that has the smallest one."),
    "missrate": _note(
        "Miss rate", "%", "lower", "Share of targets whose last position is missed by over 2 m."
    ),
    "brierminfde": _note(
        "Brier minFDE", "m", "lower", "minFDE plus (1 - p)², p being that mode's probability."
    ),
    "nll": _note("NLL", "", "lower", "Negative log-likelihood of the truth under the modes."),
    "ece": _note(
        "ECE", "%", "lower", "How far stated mode probabilities lie from how often they are right."
    ),
    "brier": _note("Brier", "", "lower", "Squared error of the stated mode probabilities."),
    "consistency": _note(
        "Consistency", "m", "lower", "How far consecutive forecasts of the same time lie apart."
    ),
    "infeasible": _note(
        "Infeasible", "%", "lower", "Share of steps beyond 10.4 m/s² or a curvature of 0.3 1/m."
    ),
    "overlap": _note("Overlap", "%", "lower", "Share of forecasts that run into another agent."),
    "offroad": _note("Off-road", "%", "lower", "Share that leaves the drivable area."),
    "collision": _note(
        "Collision", "%", "lower", "Share of drives in which the ego's box meets another one."
    ),
    "atfaultcollision": _note(
        "At-fault collision",
        "%",
        "lower",
        "Collisions with somebody standing, at the ego's front, or while it is between lanes.",
    ),
    "rearend": _note(
        "Rear-end hit", "%", "neither", "Hits from behind by replayed agents: not the ego's fault."
    ),
    "wrongway": _note("Wrong way", "%", "lower", "Share of drives that go against the traffic."),
    "progress": _note("Progress", "%", "higher", "Way made good along the recorded route."),
    "comfort": _note(
        "Comfort", "%", "higher", "Share of drives within the limits of acceleration, jerk and yaw."
    ),
    "ttc": _note(
        "TTC", "%", "higher", "Share of drives with over 0.95 s to any collision at all times."
    ),
    "speed": _note("Speed limit", "%", "higher", "How well the speed limit was kept."),
    "nuplanscore": _note(
        "nuPlan score", "%", "higher", "No fault, on the road, then progress, TTC, speed, comfort."
    ),
    "pdms": _note(
        "PDMS", "%", "higher", "NAVSIM's score: no fault times progress, TTC and comfort."
    ),
    "score": _note(
        "Score", "%", "higher", "The driving score: safety first, then way and comfort."
    ),
    "logdivergence": _note(
        "Log divergence", "m", "neither", "Mean distance between the ego and the recorded one."
    ),
    "routedeviation": _note("Route deviation", "m", "lower", "Mean distance from the route."),
    "reward": _note("Reward", "", "higher", "The environment's reward, summed over a drive."),
    "completed": _note("Completed", "%", "higher", "Share of drives that reached their end."),
}
"""By name without case, blanks, dashes and a trailing `rate`."""


def note(metric: str) -> MetricNote:
    """The note of a metric; an unknown one keeps its name and is ranked neither way."""
    key = "".join(letter for letter in metric.lower() if letter.isalnum())
    found = NOTES.get(key) or NOTES.get(key.removesuffix("rate"))
    return found or _note(metric, "", "neither", "")

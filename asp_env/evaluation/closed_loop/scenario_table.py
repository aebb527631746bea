"""`scenarios.csv`: every metric of every method in every scenario, for statistics of one's own."""

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from asp_env.data.scenarios.scenario import ScenarioSet
from asp_env.evaluation.closed_loop.comparison import EpisodeScores
from asp_env.evaluation.closed_loop.summary import MethodScores
from asp_env.evaluation.results import Condition
from asp_env.files import atomic_file

COLUMNS = (
    *("data", "traffic", "latency_ticks"),
    *("scenario", "recording", "location", "tags"),
    *("planner", "predictor", "run", "ending", "fault"),
)
"""Columns before those of the metrics."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DrivenScenarios:
    """Scenarios that some methods have driven in one condition."""

    condition: Condition
    scenarios: ScenarioSet
    methods: Sequence[MethodScores]
    """Scores of all methods in these scenarios."""


def write_scenario_table(folder: Path, driven: Sequence[DrivenScenarios]) -> None:
    """Writes `scenarios.csv`: a row for each condition, method, training run and scenario.

    The columns are `COLUMNS` and the names of the metrics that are defined in any scenario; where a
    metric is not defined, its cell is empty. `fault` is the first fault of the predictor or the
    planner, where faults are contained.
    Numbers have six significant digits, tags are separated by blanks.

    Args:
        folder: an existing folder.
        driven: the scenarios by condition.
    """
    metrics = defined_metrics(driven)
    with (
        atomic_file(folder / "scenarios.csv") as partial,
        partial.open("w", newline="") as file,
    ):
        writer = csv.writer(file)
        writer.writerow([*COLUMNS, *metrics])
        for each in driven:
            for method in each.methods:
                for run, scores in zip(method.runs, method.scores, strict=True):
                    writer.writerows(_rows(each, method, run, scores, metrics))


def defined_metrics(driven: Sequence[DrivenScenarios]) -> list[str]:
    """The names of the metrics that are defined in any scenario.

    Args:
        driven: the scenarios by condition.
    """
    return list(
        dict.fromkeys(
            name
            for each in driven
            for method in each.methods
            for scores in method.scores
            for name, metric in scores.metrics.items()
            if metric.valid.any()
        )
    )


def _rows(
    driven: DrivenScenarios,
    method: MethodScores,
    run: str,
    scores: EpisodeScores,
    metrics: Sequence[str],
) -> Iterator[list[object]]:
    """The rows of one training run."""
    values = {name: (each.value.tolist(), each.valid) for name, each in scores.metrics.items()}
    scenarios = driven.scenarios
    for i, scenario in enumerate(scenarios):
        yield [
            driven.condition.data,
            driven.condition.traffic,
            driven.condition.latency_ticks,
            scenario.name,
            scenario.recording_name,
            scenarios.locations[scenario.recording],
            " ".join(scenario.tags),
            method.planner,
            method.predictor,
            run,
            scores.endings[i].name,
            scores.faults[i] or "",
            *(
                f"{values[name][0][i]:.6g}" if name in values and values[name][1][i] else ""
                for name in metrics
            ),
        ]

"""`scenarios.csv`: every metric of every method in every scenario, for statistics of one's own."""

import csv
from collections.abc import Sequence
from pathlib import Path

from asp_env.data.scenarios.scenario import ScenarioSet
from asp_env.evaluation.closed_loop.summary import MethodScores
from asp_env.files import atomic_file

COLUMNS = ("scenario", "recording", "location", "tags", "planner", "predictor", "run", "ending")
"""Columns before those of the metrics."""


def write_scenario_table(
    folder: Path, scenarios: ScenarioSet, methods: Sequence[MethodScores]
) -> None:
    """Writes `scenarios.csv`: a row for each method, training run and scenario.

    The columns are `COLUMNS` and the names of the metrics that are defined in any scenario; where a
    metric is not defined, its cell is empty.
    Numbers have six significant digits, tags are separated by blanks.

    Args:
        folder: an existing folder.
        scenarios: the scenarios.
        methods: the scores of all methods in these scenarios.
    """
    metrics = list(
        dict.fromkeys(
            name
            for method in methods
            for scores in method.scores
            for name, metric in scores.metrics.items()
            if metric.valid.any()
        )
    )
    with (
        atomic_file(folder / "scenarios.csv") as partial,
        partial.open("w", newline="") as file,
    ):
        writer = csv.writer(file)
        writer.writerow([*COLUMNS, *metrics])
        for method in methods:
            for run, scores in zip(method.runs, method.scores, strict=True):
                values = {name: (m.value.tolist(), m.valid) for name, m in scores.metrics.items()}
                for i, scenario in enumerate(scenarios):
                    writer.writerow(
                        [
                            scenario.name,
                            scenario.recording_name,
                            scenarios.locations[scenario.recording],
                            " ".join(scenario.tags),
                            method.planner,
                            method.predictor,
                            run,
                            scores.endings[i].name,
                            *(
                                f"{values[name][0][i]:.6g}"
                                if name in values and values[name][1][i]
                                else ""
                                for name in metrics
                            ),
                        ]
                    )

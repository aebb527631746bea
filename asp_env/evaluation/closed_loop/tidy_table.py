"""`scenarios.parquet`: a row for each condition, method, training run, scenario and metric."""

from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from asp_env.errors import MissingExtraError
from asp_env.evaluation.closed_loop.scenario_table import DrivenScenarios, defined_metrics
from asp_env.files import atomic_file

TEXTS = (
    *("data", "traffic", "planner", "predictor", "run"),
    *("scenario", "recording", "location", "metric"),
)
"""Columns of text, stored as numbers of a dictionary."""


def check_parquet_possible() -> None:
    """Checks that the package of the extra `parquet` is installed, before a long run begins.

    Raises:
        MissingExtraError: pyarrow is not installed.
    """
    if find_spec("pyarrow") is None:
        raise MissingExtraError("pyarrow", "parquet", "--parquet")


def write_tidy_table(folder: Path, driven: Sequence[DrivenScenarios]) -> None:
    """Writes `scenarios.parquet`, with the metrics of `scenarios.csv`.

    The columns are `TEXTS`, `latency_ticks`, `value` and `valid`. Values are not rounded; that of a
    metric that is not defined in a scenario is missing, and `valid` is false.

    Args:
        folder: an existing folder.
        driven: the scenarios by condition.

    Raises:
        MissingExtraError: pyarrow is not installed.
    """
    check_parquet_possible()
    import pyarrow as pa  # pyright: ignore[reportMissingImports]
    import pyarrow.parquet as pq  # pyright: ignore[reportMissingImports]

    text = pa.dictionary(pa.int32(), pa.string())
    schema = pa.schema(
        [
            *((name, text) for name in TEXTS),
            ("latency_ticks", pa.int32()),
            ("value", pa.float64()),
            ("valid", pa.bool_()),
        ]
    )
    metrics = defined_metrics(driven)
    with (
        atomic_file(folder / "scenarios.parquet") as partial,
        pq.ParquetWriter(partial, schema) as writer,
    ):
        for columns in _blocks(driven, metrics):
            for name in TEXTS:
                numbers, names = columns[name]
                columns[name] = pa.DictionaryArray.from_arrays(
                    pa.array(numbers, pa.int32()), pa.array(names, pa.string())
                )
            columns["value"] = pa.array(columns["value"], mask=~columns["valid"])
            writer.write_table(pa.table(columns, schema=schema))


def _blocks(driven: Sequence[DrivenScenarios], metrics: Sequence[str]) -> Iterator[dict[str, Any]]:
    """The columns of each training run; a column of text as numbers and the names they refer to."""
    for each in driven:
        scenarios = [*each.scenarios]
        n_scenarios, n_metrics = len(scenarios), len(metrics)
        rows = n_scenarios * n_metrics
        own = {
            "scenario": [scenario.name for scenario in scenarios],
            "recording": [scenario.recording_name for scenario in scenarios],
            "location": [each.scenarios.locations[scenario.recording] for scenario in scenarios],
        }
        by_scenario = {name: _numbered(values, repeats=n_metrics) for name, values in own.items()}
        for method in each.methods:
            for run, scores in zip(method.runs, method.scores, strict=True):
                value = np.zeros((n_scenarios, n_metrics))
                valid = np.zeros((n_scenarios, n_metrics), dtype=bool)
                for column, name in enumerate(metrics):
                    if name in scores.metrics:
                        value[:, column] = scores.metrics[name].value
                        valid[:, column] = scores.metrics[name].valid
                same = {
                    "data": each.condition.data,
                    "traffic": each.condition.traffic,
                    "planner": method.planner,
                    "predictor": method.predictor,
                    "run": run,
                }
                yield {
                    **{name: (np.zeros(rows, np.int32), [text]) for name, text in same.items()},
                    **by_scenario,
                    "metric": (np.tile(np.arange(n_metrics), n_scenarios), list(metrics)),
                    "latency_ticks": np.full(rows, each.condition.latency_ticks, np.int32),
                    "value": value.reshape(-1),
                    "valid": valid.reshape(-1),
                }


def _numbered(texts: Sequence[str], *, repeats: int) -> tuple[np.ndarray, list[str]]:
    """Each text `repeats` times, as numbers of the list of different texts."""
    names = {text: number for number, text in enumerate(dict.fromkeys(texts))}
    numbers = np.array([names[text] for text in texts], np.int32)
    return np.repeat(numbers, repeats), list(names)

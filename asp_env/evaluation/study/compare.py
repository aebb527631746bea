"""`asp-env compare`: two methods, or one method in two results, scenario by scenario."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Float
from rich import box
from rich.table import Table

from asp_env.console import text_console
from asp_env.errors import AspEnvError, DataError, unknown_name
from asp_env.evaluation.closed_loop.scenario_table import COLUMNS
from asp_env.evaluation.results import SCORE
from asp_env.evaluation.statistics import Difference, difference, resampled_means
from asp_env.files import atomic_file, check_new

TABLE = "scenarios.csv"

DECIDING = 20
"""Number of scenarios that are listed."""

Key = tuple[str, str, str, str]
"""DATA, traffic, latency in ticks, and scenario."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Compare:
    """Compare two methods scenario by scenario, of one result folder or of two."""

    a: tyro.conf.Positional[Path]
    """Folder written by asp-env study, drive or benchmark."""
    b: tyro.conf.Positional[Path]
    """Another one, or the same for two methods of it."""
    methods: Annotated[tuple[str, ...], tyro.conf.arg(metavar="METHOD …")] = ()
    """The method of the first and that of the second folder, such as
    contingency+constant-velocity pdm+oracle; one name stands for both.
    The default is every method that both folders have."""
    metric: str = SCORE
    """Metric to compare, a column of scenarios.csv."""
    traffic: str | None = None
    """Traffic of both; the default is all."""
    latency_ticks: int | None = None
    """Latency of both; the default is all."""
    out: Path | None = None
    """CSV file to write: the difference in every scenario. It must not exist."""

    def run(self) -> None:
        """Prints the differences, and the scenarios that decide.

        Raises:
            AspEnvError: a folder or an option is bad, or nothing can be compared.
        """
        if self.out is not None:
            check_new(self.out)
        first, second = self._read(self.a), self._read(self.b)
        pairs = self._pairs(first, second)
        compared = [
            compare_methods(name, first[names[0]], second[names[1]])
            for name, names in pairs.items()
        ]
        found = [each for each in compared if each is not None]
        if not found:
            raise AspEnvError(
                f"{self.a} and {self.b} have no scenario in common in the same traffic and latency"
            )
        console = text_console()
        console.print(difference_table(found, self.metric))
        for each in found if len(found) == 1 else []:
            console.print(deciding_table(each, self.metric))
        if len(found) > 1:
            console.print("name one or two METHODs by --methods for the scenarios that decide")
        if self.out is not None:
            _write(self.out, found)
            console.print(f"wrote {self.out}")

    def _read(self, folder: Path) -> dict[str, "DrivenMethod"]:
        read = read_scenario_table(folder / TABLE, self.metric)
        keys = [key for method in read.values() for key in method.values]
        for option, chosen, known in (
            ("traffic", self.traffic, [traffic for _, traffic, _, _ in keys]),
            ("latency-ticks", self.latency_ticks, [_latency(key) for key in keys]),
        ):
            if chosen is not None and chosen not in known:
                found = ", ".join(map(str, sorted(set(known)))) or "nothing"
                raise AspEnvError(f"--{option} {chosen}: {folder} has {found}")
        return {
            name: DrivenMethod(
                values={
                    key: value
                    for key, value in method.values.items()
                    if self.traffic in (None, key[1])
                    and self.latency_ticks in (None, _latency(key))
                },
                recordings=method.recordings,
            )
            for name, method in read.items()
        }

    def _pairs(
        self, first: Mapping[str, object], second: Mapping[str, object]
    ) -> dict[str, tuple[str, str]]:
        """The methods of both folders that are compared, by a name for the table."""
        if not self.methods:
            if self.a.resolve() == self.b.resolve():
                raise AspEnvError("the folders are the same: name two of its methods by --methods")
            return {name: (name, name) for name in first if name in second}
        one, *more = self.methods
        if len(more) > 1:
            raise AspEnvError(f"--methods: {len(self.methods)} names given, expected one or two")
        names = (one, more[0] if more else one)
        for name, known in zip(names, (first, second), strict=True):
            if name not in known:
                raise unknown_name("method", name, known)
        label = names[1] if names[0] == names[1] else f"{names[1]} less {names[0]}"
        return {label: names}


def _latency(key: Key) -> int:
    return int(key[2] or 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class DrivenMethod:
    """A metric of one method in the scenarios of a folder."""

    values: Mapping[Key, Mapping[str, float]]
    """Values by scenario and training run."""
    recordings: Mapping[Key, str]
    """Recording of each scenario."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """Two methods in the N scenarios that both have driven."""

    name: str
    keys: Sequence[Key]
    a: Float[np.ndarray, " n"]
    """Values of the first method, means over its training runs."""
    b: Float[np.ndarray, " n"]
    less: Difference
    """The second less the first, paired by scenario."""


def read_scenario_table(path: Path, metric: str) -> dict[str, DrivenMethod]:
    """A metric of every method of a result folder.

    Args:
        path: a `scenarios.csv`.
        metric: name of the column.

    Returns:
        Methods by name, `PLANNER+PREDICTOR` or `PLANNER`.

    Raises:
        DataError: the file cannot be read.
        AspEnvError: it has no such metric.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise DataError(
            f"{path}: cannot be read ({reason}); expected a folder written by asp-env study, drive "
            "or benchmark"
        ) from error
    columns = list(lines[0]) if lines else []
    if missing := [name for name in COLUMNS if name not in columns]:
        raise DataError(f"{path}: no column {missing[0]}; drive again with this version")
    if metric not in columns:
        raise unknown_name("metric", metric, columns[len(COLUMNS) :])
    values: dict[str, dict[Key, dict[str, float]]] = {}
    recordings: dict[Key, str] = {}
    for line in lines:
        if not line[metric]:
            continue
        name = "+".join(part for part in (line["planner"], line["predictor"]) if part)
        key = (line["data"], line["traffic"], line["latency_ticks"], line["scenario"])
        try:
            value = float(line[metric])
        except (TypeError, ValueError) as error:
            raise DataError(f"{path}: {metric} {line[metric]!r}, expected a number") from error
        values.setdefault(name, {}).setdefault(key, {})[line["run"]] = value
        recordings[key] = f"{line['data']}/{line['recording']}"
    return {name: DrivenMethod(values=each, recordings=recordings) for name, each in values.items()}


def compare_methods(name: str, a: DrivenMethod, b: DrivenMethod) -> Compared | None:
    """The paired difference of two methods.

    Intervals are over recordings and, with several, over the training runs of each method.

    Args:
        name: name of the comparison.
        a: the first method.
        b: the second one.

    Returns:
        The difference b - a; None if no scenario is driven by all runs of both.
    """
    runs = [sorted({run for each in method.values.values() for run in each}) for method in (a, b)]
    keys = [
        key
        for key, values in a.values.items()
        if len(values) == len(runs[0]) and len(b.values.get(key, ())) == len(runs[1])
    ]
    if not keys:
        return None
    groups = np.array([a.recordings[key] for key in keys])
    arrays = [
        np.array([[method.values[key][run] for key in keys] for run in names])
        for method, names in zip((a, b), runs, strict=True)
    ]
    # The same run of the same predictor in both folders is resampled together.
    streams = (0, 0 if runs[0] == runs[1] else 1)
    draws = [
        resampled_means(values, groups, stream=stream)
        for values, stream in zip(arrays, streams, strict=True)
    ]
    return Compared(
        name=name,
        keys=keys,
        a=arrays[0].mean(axis=0),
        b=arrays[1].mean(axis=0),
        less=difference(draws[1] - draws[0], n=len(keys)),
    )


def difference_table(compared: Sequence[Compared], metric: str) -> Table:
    """The differences of all methods.

    Args:
        compared: the comparisons.
        metric: name of the metric.
    """
    table = Table(
        title=f"{metric}: second less first, paired by scenario [95 % interval]",
        box=box.SIMPLE_HEAD,
        show_edge=False,
    )
    for heading in ("method", "first", "second", "difference", "better", "worse", "n"):
        table.add_column(heading, justify="left" if heading == "method" else "right")
    for each in compared:
        gain = each.b - each.a
        table.add_row(
            each.name,
            f"{each.a.mean():.3f}",
            f"{each.b.mean():.3f}",
            f"{each.less:+.3f}",
            str(int((gain > 0).sum())),
            str(int((gain < 0).sum())),
            str(len(gain)),
        )
    return table


def deciding_table(compared: Compared, metric: str) -> Table:
    """The scenarios with the largest differences.

    Args:
        compared: the comparison.
        metric: name of the metric.
    """
    gain = compared.b - compared.a
    order = np.lexsort((np.arange(len(gain)), -np.abs(gain)))[:DECIDING]
    chosen = [i for i in order.tolist() if gain[i] != 0]
    rest = gain.sum() - gain[chosen].sum()
    table = Table(
        title=f"the {len(chosen)} scenarios with the largest difference of {metric}"
        if chosen
        else f"no scenario differs in {metric}",
        caption=f"together {gain[chosen].sum() / len(gain):+.3f} of the mean difference "
        f"{gain.mean():+.3f}; all others {rest / len(gain):+.3f}",
        box=box.SIMPLE_HEAD,
        show_edge=False,
    )
    for heading in ("scenario", "condition", "first", "second", "difference"):
        table.add_column(
            heading, justify="left" if heading in ("scenario", "condition") else "right"
        )
    for i in chosen:
        data, traffic, latency, scenario = compared.keys[i]
        late = f", {latency} ticks" if latency not in ("", "0") else ""
        table.add_row(
            scenario,
            f"{Path(data).name}, {traffic}{late}",
            f"{compared.a[i]:.3f}",
            f"{compared.b[i]:.3f}",
            f"{gain[i]:+.3f}",
        )
    return table


def _write(path: Path, compared: Sequence[Compared]) -> None:
    with atomic_file(path) as partial, partial.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["method", "data", "traffic", "latency_ticks", "scenario", "a", "b"])
        for each in compared:
            for key, a, b in zip(each.keys, each.a.tolist(), each.b.tolist(), strict=True):
                writer.writerow([each.name, *key, f"{a:.6g}", f"{b:.6g}"])

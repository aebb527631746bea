"""Methods of several training runs, compared on the same snippets of the same recordings.

```
python -m predictors.experiments.paired DATA --methods 'dkm:R/dkm/*' 'ssp-asp:R/ssp-asp/*'
```

prints, for moving targets, the final displacement error of each method and its difference to the
first method. Runs of a method are averaged; intervals are of a bootstrap over recordings and runs.
A difference that is smaller than the minimal detectable effect is not resolved.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Float
from rich.table import Table

from asp_env.console import table_console
from asp_env.data.predictor import load_predictor
from asp_env.data.recording import DEFAULT_DT_S, ticks
from asp_env.data.source import open_readable
from asp_env.evaluation.selection import expand_runs
from asp_env.evaluation.statistics import (
    Difference,
    Estimate,
    difference,
    interval,
    resampled_means,
)
from asp_env.metrics.forecast.errors import SELECTIONS
from predictors.experiments.errors import (
    METRICS,
    VIOLATIONS,
    Errors,
    compute_errors,
    snippets_to_evaluate,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Paired:
    """Compare methods of several training runs on the same snippets."""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")]
    """Recordings that none of the runs was trained on; all of them are used."""
    methods: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME[:RUN] …")]
    """Predictors by name; a pattern in quotes, such as 'dkm:runs/*', is one method of
    several runs. The first one is the reference."""
    horizon: float = 3.0
    """Forecast horizon in seconds."""
    per_recording: int = 500
    """Largest number of snippets of each recording, chosen at random."""

    def run(self) -> None:
        """Computes the errors and prints the table.

        Raises:
            AspEnvError: The data or a predictor are bad.
        """
        table_console().print(table(self.compare()))

    def compare(self) -> list["Row"]:
        """The rows of the table, in the order of the methods.

        Raises:
            AspEnvError: The data or a predictor are bad.
        """
        recordings = open_readable(self.data, dt_s=DEFAULT_DT_S)
        index = snippets_to_evaluate(
            recordings,
            horizon_s=self.horizon,
            dt_s=DEFAULT_DT_S,
            part="all",
            per_recording=self.per_recording,
        )
        runs = expand_runs(self.methods)
        horizon = ticks(self.horizon, DEFAULT_DT_S)
        predictors = {
            run: load_predictor(run, horizon=horizon, dt_s=DEFAULT_DT_S)
            for members in runs.values()
            for run in members
        }
        errors = compute_errors(
            predictors, index, scenes=recordings, recorded=recordings, stamp="paired"
        )
        return compared({name: [errors[run] for run in members] for name, members in runs.items()})


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One method."""

    method: str
    runs: int
    fde_m: dict[str, Estimate]
    """FDE of moving targets by selection."""
    less_reference_m: dict[str, Difference]
    """Its difference to the first method by selection; empty for the first method."""
    violations: dict[str, float]
    """Share of the modes of moving targets that cannot be driven, by reason."""


def compared(methods: Mapping[str, list[Errors]]) -> list[Row]:
    """Errors of methods and differences to the first of them.

    Args:
        methods: errors of each run of each method, all on the same snippets.
    """
    draws: dict[str, dict[str, Float[np.ndarray, " draws"]]] = {}
    rows = []
    for stream, (name, runs) in enumerate(methods.items()):
        moving, groups = runs[0].moving, runs[0].recording
        count = int(moving.sum())
        draws[name] = {}
        for number, selection in enumerate(SELECTIONS):
            fde_m = np.stack([each.values[number, METRICS.index("FDE")] for each in runs])
            draws[name][selection] = resampled_means(
                fde_m[:, moving], groups[moving], stream=stream
            )
        reference = next(iter(draws))
        less = {
            selection: difference(values - draws[reference][selection], n=count)
            for selection, values in draws[name].items()
            if name != reference
        }
        rows.append(
            Row(
                method=name,
                runs=len(runs),
                fde_m={key: interval(value, n=count) for key, value in draws[name].items()},
                less_reference_m=less,
                violations=_violations(runs),
            )
        )
    return rows


def _violations(runs: list[Errors]) -> dict[str, float]:
    shares = {}
    for number, violation in enumerate(VIOLATIONS):
        known = [each.violations_valid[number] & each.moving for each in runs]
        values = [each.violations[number][rows] for each, rows in zip(runs, known, strict=True)]
        joined = np.concatenate(values)
        shares[violation] = float(joined.mean()) if len(joined) else float("nan")
    return shares


def table(rows: list[Row]) -> Table:
    """The table of all methods."""
    shown = Table(title="moving targets, FDE in m; 95 % intervals over recordings and runs")
    for column in ("method", "runs"):
        shown.add_column(column)
    for selection in SELECTIONS:
        shown.add_column(selection)
        shown.add_column(f"less {rows[0].method}")
    shown.add_column(" / ".join(VIOLATIONS))
    for row in rows:
        cells = [row.method, str(row.runs)]
        for selection in SELECTIONS:
            less = row.less_reference_m.get(selection)
            cells += [f"{row.fde_m[selection]:.2f}", "" if less is None else f"{less:+.2f}"]
        cells.append(" / ".join(f"{row.violations[each]:.3f}" for each in VIOLATIONS))
        shown.add_row(*cells)
    return shown


if __name__ == "__main__":
    tyro.cli(Paired).run()

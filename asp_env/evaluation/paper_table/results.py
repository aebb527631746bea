"""From kept errors to numbers: means, differences in pairs, and what training said of features."""

import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from asp_env.errors import AspEnvError
from asp_env.evaluation import intervals
from asp_env.evaluation.intervals import Estimate
from asp_env.evaluation.paper_table.cells import Cell
from asp_env.evaluation.paper_table.errors import METRICS, Errors
from asp_env.metrics.open_loop import SELECTIONS

SUBSETS = ("moving", "all")
REFERENCES = ("constant-turn-rate", "dkm", "ffw-asp")
"""Whom every predictor is compared with."""

FEATURES = ("feature R2", "feature standard deviation", "feature effective rank")
"""Columns of a run's log."""

ORACLE = "oracle"
"""The chaining that is handed the recorded future."""


class Key(NamedTuple):
    """A line of the table at one site and horizon: what is averaged over seeds."""

    site: str
    view: str
    predictor: str
    preset: str
    variant: str
    chaining: str
    """Where it is another than the predictor's own."""
    horizon_s: float

    @classmethod
    def of(cls, cell: Cell, chaining: str = "") -> "Key":
        """The line that a cell belongs to."""
        return cls(
            site=cell.site,
            view=cell.view,
            predictor=cell.predictor,
            preset=cell.preset,
            variant=cell.variant,
            chaining=chaining,
            horizon_s=cell.horizon_s,
        )

    @property
    def is_base(self) -> bool:
        """Whether nothing was changed of the recipe."""
        return not self.variant


class Number(NamedTuple):
    """What a line says of one metric."""

    selection: str
    subset: str
    metric: str
    estimate: Estimate
    spread: float | None
    """Standard deviation over seeds; None of one seed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """All that was kept of a table's cells."""

    errors: Mapping[Key, Mapping[int, Errors]] = field(default_factory=dict)
    """By seed; -1 for what learns nothing."""
    features: Mapping[Key, Sequence[Mapping[str, float]]] = field(default_factory=dict)
    """Of each seed, what its best epoch said of features."""

    def __post_init__(self) -> None:
        """Checks that what is compared in pairs makes pairs.

        Raises:
            AspEnvError: two lines of one site and horizon speak of different snippets.
        """
        first: dict[tuple[str, float], Errors] = {}
        for key, by_seed in self.errors.items():
            for each in by_seed.values():
                other = first.setdefault((key.site, key.horizon_s), each)
                if not each.same_snippets(other):
                    raise AspEnvError(
                        f"errors at {key.site} for {key.horizon_s:g} s are of different snippets: "
                        "remove the folder errors and start again"
                    )

    def numbers(self, key: Key) -> Iterator[Number]:
        """Means over snippets of errors that were first averaged over seeds, snippet by snippet."""
        by_seed = self.errors[key]
        for selection, subset, metric, keep, groups in self._choices(key):
            values = np.stack([each.of(selection, metric)[keep] for each in by_seed.values()])
            of_seeds = values.mean(axis=1, dtype=np.float64)
            yield Number(
                selection=selection,
                subset=subset,
                metric=metric,
                estimate=intervals.mean(_over_seeds(values), groups),
                spread=float(of_seeds.std(ddof=1)) if len(of_seeds) > 1 else None,
            )

    def differences(self, key: Key, other: Key) -> Iterator[Number]:
        """A line's means less another's, paired; over the seeds that both have.

        What learns nothing is compared with every seed. Nothing if there is no seed in common.
        """
        mine, theirs = self.errors[key], self.errors[other]
        if -1 not in mine and -1 not in theirs:
            both = sorted(set(mine) & set(theirs))
            mine = {seed: mine[seed] for seed in both}
            theirs = {seed: theirs[seed] for seed in both}
        if not mine or not theirs:
            return
        for selection, subset, metric, keep, groups in self._choices(key):
            values, others = (
                np.stack([each.of(selection, metric)[keep] for each in side.values()])
                for side in (mine, theirs)
            )
            paired = len(values) == len(others) > 1
            of_seeds = (values - others).mean(axis=1, dtype=np.float64) if paired else None
            yield Number(
                selection=selection,
                subset=subset,
                metric=metric,
                estimate=intervals.mean(_over_seeds(values) - _over_seeds(others), groups),
                spread=None if of_seeds is None else float(of_seeds.std(ddof=1)),
            )

    def references(self, key: Key) -> Iterator[Key]:
        """The lines that one is compared with: those of `REFERENCES`, with the same change."""
        for name in REFERENCES:
            for view in dict.fromkeys(("", key.view)):
                reference = key._replace(predictor=name, preset="", view=view, chaining="")
                if reference != key and reference in self.errors:
                    yield reference

    def base(self, key: Key) -> Key | None:
        """The line without the change."""
        base = key._replace(variant="")
        return base if base in self.errors and not key.is_base else None

    def _choices(
        self, key: Key
    ) -> Iterator[
        tuple[str, str, str, Bool[np.ndarray, " n"], Float[np.ndarray, " m"] | np.ndarray]
    ]:
        first = next(iter(self.errors[key].values()))
        for subset in SUBSETS:
            keep = first.moving if subset == "moving" else np.ones(len(first.moving), dtype=bool)
            if keep.any():
                for selection in SELECTIONS:
                    for metric in METRICS:
                        yield selection, subset, metric, keep, first.recording[keep]


def _over_seeds(values: Float[np.ndarray, "seeds n"]) -> Float[np.ndarray, " n"]:
    return values.mean(axis=0, dtype=np.float64)


def excludes_zero(estimate: Estimate) -> bool:
    """Whether an interval lies to one side of zero."""
    low, high = estimate.low, estimate.high
    return low is not None and high is not None and (low > 0 or high < 0)


def best_features(run: Path) -> dict[str, float]:
    """What a finished run's log says of its features in the epoch that was kept; maybe nothing."""
    best = json.loads((run / "config.json").read_text())["provenance"]["best_epoch"]
    found: dict[str, float] = {}
    for path in sorted(run.glob("logs/*/metrics.csv")):
        with path.open(newline="") as file:
            for row in csv.DictReader(file):
                if row.get("epoch") == str(best):
                    found |= {name: float(row[name]) for name in FEATURES if row.get(name)}
    return found

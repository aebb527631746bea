"""Means, paired differences and feature statistics, from the stored errors of all cells."""

import csv
import dataclasses
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from asp_env.errors import AspEnvError
from asp_env.evaluation import statistics
from asp_env.evaluation.statistics import Estimate
from asp_env.metrics.forecast.errors import SELECTIONS
from predictors.experiments.cells import CAUSAL, INPUT_VARIANTS, Cell
from predictors.experiments.errors import METRICS, VIOLATIONS, Errors

SUBSETS = ("moving", "all")
REFERENCES = ("constant-turn-rate", "dkm", "ffw-asp")
"""Predictors that every other one is compared with."""

FEATURES = ("feature R2", "feature standard deviation", "feature effective rank")
"""Columns of the log of a run that describe its action features."""

ORACLE = "oracle"
"""The chaining of segments that uses the recorded future."""

NO_SEED = -1
"""Seed of predictors without training."""


class Choice(NamedTuple):
    """Selection of modes and subset of snippets of a table."""

    selection: str
    subset: str


CHOICES = tuple(Choice(selection, subset) for subset, selection in product(SUBSETS, SELECTIONS))


class Key(NamedTuple):
    """A line of the table at one site and horizon; its seeds are averaged."""

    site: str
    view: str
    predictor: str
    recipe: str
    """Recipe, if it is not the table's."""
    variant: str
    chaining: str
    """Way of chaining segments, if it is not the predictor's own."""
    horizon_s: float

    @classmethod
    def of(cls, cell: Cell, chaining: str = "") -> "Key":
        """The line that a cell belongs to."""
        return cls(
            site=cell.site,
            view=cell.view,
            predictor=cell.predictor,
            recipe=cell.recipe,
            variant=cell.variant,
            chaining=chaining,
            horizon_s=cell.horizon_s,
        )


class Training(NamedTuple):
    """The training of one line and seed, with the runs that it starts from."""

    epochs: int
    """Prediction epochs."""
    pretraining_epochs: int
    cpu_s: float | None
    """CPU time in seconds, with the opening of the data; None if it is not known."""


class SeedMean(NamedTuple):
    """One metric of a line, averaged over seeds."""

    estimate: Estimate
    spread: float | None
    """Standard deviation over seeds; None for one seed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sums:
    """Errors summed over the snippets of each of R recordings; all means are computed from them."""

    errors: Float[np.ndarray, "r subsets selections metrics"]
    counts: Int[np.ndarray, "r subsets"]
    violations: Float[np.ndarray, "r subsets violations"]
    """Shares of modes for which `VIOLATIONS` hold, summed over the snippets that they apply to."""
    violation_counts: Int[np.ndarray, "r subsets violations"]
    """Number of these snippets."""
    digest: str
    """Hash of the snippets."""

    @classmethod
    def of(cls, errors: Errors) -> "Sums":
        """Sums of the errors of one run."""
        _, group = np.unique(errors.recording, return_inverse=True)
        recordings = int(group.max()) + 1
        sums = np.zeros((recordings, len(SUBSETS), len(SELECTIONS), len(METRICS)))
        counts = np.zeros((recordings, len(SUBSETS)), dtype=np.int64)
        violations = np.zeros((recordings, len(SUBSETS), len(VIOLATIONS)))
        violation_counts = np.zeros(violations.shape, dtype=np.int64)
        for number, subset in enumerate(SUBSETS):
            member = errors.moving if subset == "moving" else np.ones_like(errors.moving)
            values = np.moveaxis(errors.values, -1, 0)[member].astype(np.float64)
            np.add.at(sums[:, number], group[member], values)
            counts[:, number] = np.bincount(group[member], minlength=recordings)
            applies = errors.violations_valid.T[member]
            shares = np.where(applies, errors.violations.T[member], 0).astype(np.float64)
            np.add.at(violations[:, number], group[member], shares)
            np.add.at(violation_counts[:, number], group[member], applies)
        content = np.stack([errors.recording, errors.track, errors.tick, errors.moving])
        digest = hashlib.sha256(content.astype(np.int64).tobytes()).hexdigest()
        return cls(
            errors=sums,
            counts=counts,
            violations=violations,
            violation_counts=violation_counts,
            digest=digest,
        )

    def chosen(self, choice: Choice) -> Float[np.ndarray, "r metrics"]:
        """Sums of one selection and subset."""
        return self.errors[:, SUBSETS.index(choice.subset), [*SELECTIONS].index(choice.selection)]

    def chosen_counts(self, choice: Choice) -> Int[np.ndarray, " r"]:
        """Number of snippets of each recording in the subset of a choice."""
        return self.counts[:, SUBSETS.index(choice.subset)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """Results of all finished cells.

    Raises:
        AspEnvError: two lines of one site and horizon are of different snippets, so that they
            cannot be compared in pairs.
    """

    sums: Mapping[Key, Mapping[int, Sums]] = field(default_factory=dict)
    """Errors by line and seed."""
    features: Mapping[Key, Sequence[Mapping[str, float]]] = field(default_factory=dict)
    """`FEATURES` of the best epoch of each seed, by line; empty without predicted features."""
    training: Mapping[Key, Sequence[Training]] = field(default_factory=dict)
    """The training of each seed, by line."""

    def __post_init__(self) -> None:
        first: dict[tuple[str, float], str] = {}
        for key, by_seed in self.sums.items():
            for each in by_seed.values():
                if each.digest != first.setdefault((key.site, key.horizon_s), each.digest):
                    raise AspEnvError(
                        f"errors at {key.site} for {key.horizon_s:g} s are of different snippets: "
                        "remove the folder errors and start again"
                    )

    def means(self, key: Key, choice: Choice) -> dict[str, SeedMean]:
        """Means of a line by metric; empty if the line or the subset is empty.

        The errors of each snippet are averaged over seeds first, then over snippets.
        """
        return _seed_means(list(self.sums.get(key, {}).values()), None, choice)

    def violations(self, key: Key, subset: str) -> dict[str, SeedMean]:
        """Shares of modes for which `VIOLATIONS` hold, averaged over seeds; those that apply.

        Args:
            key: a line.
            subset: one of `SUBSETS`.
        """
        seeds, column = list(self.sums.get(key, {}).values()), SUBSETS.index(subset)
        means = {}
        for number, name in enumerate(VIOLATIONS):
            counts = [each.violation_counts[:, column, number] for each in seeds]
            if not counts or not counts[0].sum():
                continue
            by_seed = np.stack([each.violations[:, column, number] for each in seeds])
            means[name] = _seed_mean(by_seed, counts[0])
        return means

    def differences(self, key: Key, other: Key, choice: Choice) -> dict[str, SeedMean]:
        """Paired differences of the means of two lines, over the seeds that both have.

        A predictor without training is compared with every seed. Empty without common seeds.
        """
        minuend, subtrahend = self.sums.get(key, {}), self.sums.get(other, {})
        if NO_SEED not in minuend and NO_SEED not in subtrahend:
            common = sorted(set(minuend) & set(subtrahend))
            minuend = {seed: minuend[seed] for seed in common}
            subtrahend = {seed: subtrahend[seed] for seed in common}
        return _seed_means(list(minuend.values()), list(subtrahend.values()), choice)

    def references(self, key: Key) -> Iterator[Key]:
        """The lines that a line is compared with.

        These are the `REFERENCES` with the same variant if there are any. Otherwise they are those
        without a variant, unless the variant changes the input of all predictors.
        """
        candidates = [(key.view, key.variant), ("", key.variant)]
        if key.variant not in INPUT_VARIANTS:
            candidates.append((key.view, ""))
        if key.variant != CAUSAL:
            candidates.append(("", ""))
        for name in REFERENCES:
            for view, variant in dict.fromkeys(candidates):
                other = key._replace(
                    predictor=name, recipe="", view=view, variant=variant, chaining=""
                )
                if other in self.sums and other != key:
                    yield other
                    break

    def base(self, key: Key) -> Key | None:
        """The same line without its variant, if there is one."""
        base = key._replace(variant="")
        return base if base in self.sums and key.variant else None


def _seed_means(
    minuend: Sequence[Sums], subtrahend: Sequence[Sums] | None, choice: Choice
) -> dict[str, SeedMean]:
    """Means by metric of the sums of all seeds, or of their differences to other sums."""
    if not minuend or (subtrahend is not None and not subtrahend):
        return {}
    counts = minuend[0].chosen_counts(choice)
    if not counts.sum():
        return {}
    by_seed = np.stack([each.chosen(choice) for each in minuend])
    if subtrahend is not None:
        other_by_seed = np.stack([each.chosen(choice) for each in subtrahend])
        by_seed = by_seed - other_by_seed  # broadcasts a predictor without training to every seed
    return {
        metric: _seed_mean(by_seed[:, :, column], counts) for column, metric in enumerate(METRICS)
    }


def _seed_mean(by_seed: Float[np.ndarray, "seeds r"], counts: Int[np.ndarray, " r"]) -> SeedMean:
    """The mean over snippets and seeds of values that are summed over each recording.

    Args:
        by_seed: sums of every seed and recording.
        counts: number of snippets of each recording, at least one in total.
    """
    total, present = int(counts.sum()), counts > 0
    sums = by_seed.mean(axis=0)[present]
    estimate = statistics.ratio(sums, counts[present].astype(float), np.arange(len(sums)))
    seeds = by_seed.sum(axis=1) / total
    return SeedMean(
        estimate=dataclasses.replace(estimate, n=total),
        spread=float(seeds.std(ddof=1)) if len(seeds) > 1 else None,
    )


def excludes_zero(estimate: Estimate) -> bool:
    """Whether the interval of an estimate lies on one side of zero."""
    low, high = estimate.low, estimate.high
    return low is not None and high is not None and (low > 0 or high < 0)


def trained(run: Path, cpu_s: float | None) -> Training:
    """The training of a finished run, without the run that it starts from.

    Args:
        run: folder of the run.
        cpu_s: CPU time of its training in seconds, if it is known.
    """
    provenance = json.loads((run / "config.json").read_text())["provenance"]
    config = provenance["config"]
    return Training(
        epochs=provenance.get("trained_epochs", config["epochs"]),
        pretraining_epochs=config["pretraining_epochs"],
        cpu_s=cpu_s,
    )


def best_features(run: Path) -> dict[str, float]:
    """The `FEATURES` that a finished run logged in its best epoch; empty without any.

    Args:
        run: folder of the run.
    """
    best = json.loads((run / "config.json").read_text())["provenance"]["best_epoch"]
    features: dict[str, float] = {}
    for path in sorted(run.glob("logs/*/metrics.csv")):
        with path.open(newline="") as file:
            for row in csv.DictReader(file):
                if row.get("epoch") == str(best):
                    features |= {name: float(row[name]) for name in FEATURES if row.get(name)}
    return features

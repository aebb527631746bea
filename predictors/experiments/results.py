"""From kept errors to numbers: means, differences in pairs, and what training said of features."""

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
from predictors.experiments.cells import CAUSAL, GIVEN, Cell
from predictors.experiments.errors import METRICS, Errors

SUBSETS = ("moving", "all")
REFERENCES = ("constant-turn-rate", "dkm", "ffw-asp")
"""Whom every predictor is compared with."""

FEATURES = ("feature R2", "feature standard deviation", "feature effective rank")
"""Columns of a run's log."""

ORACLE = "oracle"
"""The chaining that is handed the recorded future."""

NO_SEED = -1
"""Stands for the seed of what learns nothing."""


class Choice(NamedTuple):
    """What a table speaks of."""

    selection: str
    subset: str


CHOICES = tuple(Choice(each, subset) for subset, each in product(SUBSETS, SELECTIONS))


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


class Number(NamedTuple):
    """What a line says of one metric."""

    estimate: Estimate
    spread: float | None
    """Standard deviation over seeds; None of one seed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sums:
    """Errors summed over the snippets of each of R recordings; every mean is made of them."""

    errors: Float[np.ndarray, "r subsets selections metrics"]
    counts: Int[np.ndarray, "r subsets"]
    digest: str
    """Of which snippets they are."""

    @classmethod
    def of(cls, errors: Errors) -> "Sums":
        """Of all snippets of one run."""
        _, group = np.unique(errors.recording, return_inverse=True)
        recordings = int(group.max()) + 1
        sums = np.zeros((recordings, len(SUBSETS), len(SELECTIONS), len(METRICS)))
        counts = np.zeros((recordings, len(SUBSETS)), dtype=np.int64)
        for number, subset in enumerate(SUBSETS):
            keep = errors.moving if subset == "moving" else np.ones_like(errors.moving)
            values = np.moveaxis(errors.values, -1, 0)[keep].astype(np.float64)
            np.add.at(sums[:, number], group[keep], values)
            counts[:, number] = np.bincount(group[keep], minlength=recordings)
        content = np.stack([errors.recording, errors.track, errors.tick, errors.moving])
        digest = hashlib.sha256(content.astype(np.int64).tobytes()).hexdigest()
        return cls(errors=sums, counts=counts, digest=digest)

    def chosen(self, choice: Choice) -> Float[np.ndarray, "r metrics"]:
        """Of one selection and subset."""
        return self.errors[:, SUBSETS.index(choice.subset), [*SELECTIONS].index(choice.selection)]

    def counted(self, choice: Choice) -> Int[np.ndarray, " r"]:
        """How many snippets of each recording a choice has."""
        return self.counts[:, SUBSETS.index(choice.subset)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """All that was kept of a table's cells."""

    sums: Mapping[Key, Mapping[int, Sums]] = field(default_factory=dict)
    """By seed."""
    features: Mapping[Key, Sequence[Mapping[str, float]]] = field(default_factory=dict)
    """Of each seed, what its best epoch said of features; nothing where none are predicted."""

    def __post_init__(self) -> None:
        """Checks that what is compared in pairs makes pairs.

        Raises:
            AspEnvError: two lines of one site and horizon speak of different snippets.
        """
        first: dict[tuple[str, float], str] = {}
        for key, by_seed in self.sums.items():
            for each in by_seed.values():
                if each.digest != first.setdefault((key.site, key.horizon_s), each.digest):
                    raise AspEnvError(
                        f"errors at {key.site} for {key.horizon_s:g} s are of different snippets: "
                        "remove the folder errors and start again"
                    )

    def numbers(self, key: Key, choice: Choice) -> dict[str, Number]:
        """A line's means by metric; nothing where it or the subset is empty.

        Errors are averaged over seeds first, snippet by snippet; then over snippets.
        """
        return _numbers(list(self.sums.get(key, {}).values()), None, choice)

    def differences(self, key: Key, other: Key, choice: Choice) -> dict[str, Number]:
        """A line's means less another's, paired, over the seeds that both have.

        What learns nothing is compared with every seed. Nothing if there is no seed in common.
        """
        mine, theirs = self.sums.get(key, {}), self.sums.get(other, {})
        if NO_SEED not in mine and NO_SEED not in theirs:
            both = sorted(set(mine) & set(theirs))
            mine = {seed: mine[seed] for seed in both}
            theirs = {seed: theirs[seed] for seed in both}
        return _numbers(list(mine.values()), list(theirs.values()), choice)

    def references(self, key: Key) -> Iterator[Key]:
        """The lines that one is compared with.

        Those of `REFERENCES` with the same change; else without, but where the change is one of
        what everybody is given.
        """
        places = [(key.view, key.variant), ("", key.variant)]
        if key.variant not in GIVEN:
            places.append((key.view, ""))
        if key.variant != CAUSAL:
            places.append(("", ""))
        for name in REFERENCES:
            for view, variant in dict.fromkeys(places):
                other = key._replace(
                    predictor=name, preset="", view=view, variant=variant, chaining=""
                )
                if other in self.sums and other != key:
                    yield other
                    break

    def base(self, key: Key) -> Key | None:
        """The line without the change."""
        base = key._replace(variant="")
        return base if base in self.sums and key.variant else None


def _numbers(
    sides: Sequence[Sums], others: Sequence[Sums] | None, choice: Choice
) -> dict[str, Number]:
    """Means of one side, or of one less the other, by metric."""
    if not sides or (others is not None and not others):
        return {}
    counts = sides[0].counted(choice)
    total = int(counts.sum())
    if not total:
        return {}
    of_seeds = np.stack([each.chosen(choice) for each in sides])
    sums = of_seeds.mean(axis=0)
    if others is not None:
        of_others = np.stack([each.chosen(choice) for each in others])
        sums = sums - of_others.mean(axis=0)
        of_seeds = of_seeds - of_others  # one line of what learns nothing stands for every seed
    seeds = of_seeds.sum(axis=1) / total
    there = counts > 0
    groups = np.arange(int(there.sum()))
    found = {}
    for column, metric in enumerate(METRICS):
        estimate = statistics.ratio(sums[there, column], counts[there].astype(float), groups)
        found[metric] = Number(
            estimate=dataclasses.replace(estimate, n=total),
            spread=float(seeds[:, column].std(ddof=1)) if len(seeds) > 1 else None,
        )
    return found


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

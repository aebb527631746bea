"""The sites of a table: where is learned, selected and judged, one group of columns each.

MERGED: The cells of the table: what is trained and judged, and what has to be there before.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from asp_env.data.source import open_data
from asp_env.errors import AspEnvError, unknown_name


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """Data and their content."""

    name: str
    data: str
    data_hash: str
    validation: str | None = None
    """Data to select on; the part validation of `data` if None."""
    validation_hash: str | None = None
    test: str | None = None
    """Data to judge on; the part test of `data` if None."""
    test_hash: str | None = None

    @property
    def judged_on(self) -> str:
        """The data that errors are of."""
        return self.test or self.data

    @property
    def judged_hash(self) -> str:
        """Of their content."""
        return self.test_hash or self.data_hash


def open_sites(data: Sequence[str], validation: Sequence[str], test: Sequence[str]) -> list[Site]:
    """The sites of some data.

    Raises:
        AspEnvError: not as many for each part, data that cannot be read, or a recording twice.
    """
    for option, given in (("--validation", validation), ("--test", test)):
        if given and len(given) != len(data):
            raise AspEnvError(
                f"{option}: {len(given)} given, expected one for each of the {len(data)} DATA"
            )
    if validation and not test:
        raise AspEnvError(
            "--validation: all of DATA is learned from then, so nothing is left to judge on; "
            "give --test too"
        )
    return [
        _open_site(
            name,
            data[number],
            validation[number] if validation else None,
            test[number] if test else None,
        )
        for number, name in enumerate(site_names(data))
    ]


def _open_site(name: str, data: str, validation: str | None, test: str | None) -> Site:
    opened = {given: open_data(given) for given in (data, validation, test) if given is not None}
    if test is not None:
        judged = dict(zip(opened[test].hashes(), opened[test].names, strict=True))
        for other in (each for each in (data, validation) if each is not None):
            if both := set(judged) & set(opened[other].hashes()):
                raise AspEnvError(
                    f"recording {judged[min(both)]} of {test!r} is in {other!r} too: judge on "
                    "recordings that are neither learned from nor selected on"
                )
    hashes = {given: recordings.data_hash() for given, recordings in opened.items()}
    return Site(
        name=name,
        data=data,
        data_hash=hashes[data],
        validation=validation,
        validation_hash=None if validation is None else hashes[validation],
        test=test,
        test_hash=None if test is None else hashes[test],
    )


SEGMENT_S = 3.0
"""Runs for longer horizons that go on from others do so from one for this, of the same seed."""

PHYSICAL = ("constant-velocity", "constant-turn-rate")
"""These learn nothing; every table has them."""

CAUSAL = "causal"
"""The variant whose histories know nothing that came later; the physical ones have it too."""

GIVEN = (CAUSAL, "no-trail", "long")
"""Variants of what every predictor is given: compared with others of the same alone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One predictor for one horizon at one site."""

    site: str
    predictor: str
    horizon_s: float
    view: str = ""
    """What it looks at; for a variant without the trail, the view with it."""
    preset: str = ""
    """Where it is another than the table's."""
    variant: str = ""
    """A change of the recipe by name; none for the table itself."""
    seed: int | None = None
    """None for one that learns nothing."""
    start: "Cell | None" = None
    """The cell whose weights it goes on from."""

    @property
    def label(self) -> str:
        """Predictor, preset and variant."""
        return "-".join(part for part in (self.predictor, self.preset, self.variant) if part)

    @property
    def name(self) -> str:
        """Where it lies below the folders of runs, errors and logs."""
        parts = [self.site, self.view, self.label, f"{self.horizon_s:g}s"]
        if self.seed is not None:
            parts.append(f"seed{self.seed}")
        return "/".join(part for part in parts if part)


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelSpec:
    """A predictor of the table, by its recipe."""

    predictor: str
    preset: str = ""
    """Where it is another than the table's."""
    warm_starts_from_3s: bool
    """Whether a run for more than 3 s goes on from the weights of one for 3 s."""

    @classmethod
    def from_name(cls, name: str, warm_starts_from_3s: Callable[[str], bool]) -> "ModelSpec":
        """Of `ssp-asp` or `ssp-asp:ours`; `warm_starts_from_3s` tells it of a predictor."""
        predictor, _, preset = name.partition(":")
        return cls(
            predictor=predictor, preset=preset, warm_starts_from_3s=warm_starts_from_3s(predictor)
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Ablation:
    """A variant of a predictor."""

    predictor: str
    name: str
    horizons_s: tuple[float, ...]
    """Those that it says something about."""
    warm_starts_from_3s: bool
    """Whether a run for more than 3 s goes on from the weights of one for 3 s."""


def choose_ablations(
    names: Sequence[str],
    variants: Mapping[str, Mapping[str, Any]],
    warm_starts_from_3s: Callable[[str, str], bool],
) -> list[Ablation]:
    """The ablations of some names.

    Args:
        names: `none`, `all`, a name (of every predictor that has it) or `predictor:name`.
        variants: by predictor and name; each with `horizons_s`.
        warm_starts_from_3s: of a predictor and a name, whether runs for more than 3 s go on from others.

    Raises:
        AspEnvError: no predictor has it.
    """
    known = sorted({name for of in variants.values() for name in of})
    chosen = []
    for given in names:
        if given == "none":
            continue
        predictor, _, name = given.rpartition(":")
        found = [
            Ablation(
                predictor=each,
                name=variant,
                horizons_s=tuple(of[variant].horizons_s),
                warm_starts_from_3s=warm_starts_from_3s(each, variant),
            )
            for each, of in variants.items()
            for variant in of
            if name in ("all", variant) and predictor in ("", each)
        ]
        if not found:
            raise unknown_name("ablation", given, ["none", "all", *known])
        chosen += [each for each in found if each not in chosen]
    return chosen


def plan_cells(
    *,
    sites: Sequence[str],
    entrants: Sequence[ModelSpec],
    views: Sequence[str],
    horizons_s: Sequence[float],
    seeds: Sequence[int],
    ablations: Sequence[Ablation] = (),
    ablation_view: str = "",
) -> list[Cell]:
    """All cells, in the order in which they are best run: a whole table for one seed, then more.

    A cell stands behind the one that it starts from, even if nobody asked for that one.
    Ablations are of the first site and one view.
    """
    cells: list[Cell] = []
    histories = ["", CAUSAL] if any(each.name == CAUSAL for each in ablations) else [""]
    for site, horizon_s, predictor, variant in product(sites, horizons_s, PHYSICAL, histories):
        _add(cells, Cell(site=site, predictor=predictor, horizon_s=horizon_s, variant=variant))
    for seed, site, horizon_s in product(seeds, sites, sorted(horizons_s)):
        for view, entrant in product(views, entrants):
            _add(cells, _base(site, view, entrant, horizon_s, seed))
    for seed, ablation in product(seeds, ablations):
        for horizon_s in sorted(set(horizons_s) & set(ablation.horizons_s)):
            _add(cells, _changed(sites[0], ablation_view, ablation, horizon_s, seed))
    return cells


def _base(site: str, view: str, entrant: ModelSpec, horizon_s: float, seed: int) -> Cell:
    later = horizon_s > SEGMENT_S and entrant.warm_starts_from_3s
    start = _base(site, view, entrant, SEGMENT_S, seed) if later else None
    return Cell(
        site=site,
        predictor=entrant.predictor,
        preset=entrant.preset,
        view=view,
        horizon_s=horizon_s,
        seed=seed,
        start=start,
    )


def _changed(site: str, view: str, ablation: Ablation, horizon_s: float, seed: int) -> Cell:
    start = None
    if horizon_s > SEGMENT_S and ablation.warm_starts_from_3s:
        if SEGMENT_S in ablation.horizons_s:
            start = _changed(site, view, ablation, SEGMENT_S, seed)
        else:
            start = Cell(
                site=site,
                predictor=ablation.predictor,
                view=view,
                horizon_s=SEGMENT_S,
                seed=seed,
            )
    return Cell(
        site=site,
        predictor=ablation.predictor,
        view=view,
        variant=ablation.name,
        horizon_s=horizon_s,
        seed=seed,
        start=start,
    )


def _add(cells: list[Cell], cell: Cell) -> None:
    if cell.start is not None:
        _add(cells, cell.start)
    if cell not in cells:
        cells.append(cell)


def site_names(data: Sequence[str]) -> list[str]:
    """A name for each DATA: its folder's, fit for a path.

    Raises:
        AspEnvError: two have the same.
    """
    names = [each.rstrip("/").rpartition("/")[2].replace(":", "-") for each in data]
    for name in names:
        if names.count(name) > 1 or not name.strip("."):
            raise AspEnvError(f"DATA: {name!r} names {names.count(name)} sites; one each is needed")
    return names

"""Sites and cells of a table: what is trained and evaluated, and what each run starts from.

A site is a data set with its own group of columns. A cell is one predictor, or one ablation of it,
for one horizon and seed at one site.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from asp_env.data.recording import DEFAULT_DT_S
from asp_env.data.snippets import index_snippets
from asp_env.data.source import Recordings, open_readable
from asp_env.data.split import SPLIT_HORIZON_S, split_by_recording
from asp_env.errors import AspEnvError, unknown_name

SEGMENT_S = 3.0
"""A run for a longer horizon that does not start from scratch starts from a run for this one."""

PHYSICAL = ("constant-velocity", "constant-turn-rate")
"""Predictors without training; every table has them."""

CAUSAL = "causal"
"""The variant with histories that were filtered without later frames. The physical predictors have
it too."""

INPUT_VARIANTS = (CAUSAL, "no-trail", "long")
"""Variants of the input of all predictors. Other predictors are compared with them only if they
have the same input."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """Data of a site and hashes of their content."""

    name: str
    data: str
    data_hash: str
    validation: str | None = None
    """Data to select on; None for the part validation of `data`."""
    validation_hash: str | None = None
    test: str | None = None
    """Data to evaluate on; None for the part test of `data`."""
    test_hash: str | None = None

    @property
    def evaluated_on(self) -> str:
        """The data that errors are computed on."""
        return self.test or self.data

    @property
    def evaluated_hash(self) -> str:
        """Hash of the data that errors are computed on."""
        return self.test_hash or self.data_hash


def open_sites(data: Sequence[str], validation: Sequence[str], test: Sequence[str]) -> list[Site]:
    """Opens the data of all sites.

    Args:
        data: DATA of each site.
        validation: data to select on, for each site or for none.
        test: data to evaluate on, for each site or for none.

    Raises:
        AspEnvError: the numbers differ, data cannot be read, or test recordings are also trained
            or selected on.
    """
    for option, given in (("--validation", validation), ("--test", test)):
        if given and len(given) != len(data):
            raise AspEnvError(
                f"{option}: {len(given)} given, expected one for each of the {len(data)} DATA"
            )
    if validation and not test:
        raise AspEnvError(
            "--validation: all of DATA is trained on then, so nothing is left to evaluate on; "
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
    opened = {
        given: open_readable(given) for given in (data, validation, test) if given is not None
    }
    if test is not None:
        names = dict(zip(opened[test].hashes(), opened[test].names, strict=True))
        for other in (each for each in (data, validation) if each is not None):
            if both := set(names) & set(opened[other].hashes()):
                raise AspEnvError(
                    f"recording {names[min(both)]} of {test!r} is also in {other!r}: evaluate on "
                    "recordings that are neither trained nor selected on"
                )
    if validation is None:
        _check_split(opened[data])
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


def _check_split(recordings: Recordings) -> None:
    """Checks that DATA can be divided into parts, which every cell needs.

    Raises:
        AspEnvError: it cannot.
    """
    index = index_snippets(recordings, dt_s=DEFAULT_DT_S, horizon_s=SPLIT_HORIZON_S)
    counts = np.bincount(index.recording, minlength=len(recordings))
    try:
        split_by_recording(counts, [recording.location for recording in recordings])
    except AspEnvError as error:
        raise AspEnvError(
            f"{recordings.source!r}: {str(error).partition(';')[0]}; give more recordings, or "
            "other data by --validation and --test"
        ) from error


def site_names(data: Sequence[str]) -> list[str]:
    """The name of each site: the last part of its path, without characters unfit for a file name.

    Raises:
        AspEnvError: two sites have the same name, or one has none.
    """
    names = [each.rstrip("/").rpartition("/")[2].replace(":", "-") for each in data]
    for name in names:
        if not name:
            raise AspEnvError(
                "DATA '': expected a folder with recordings, or a text scheme:argument"
            )
        if names.count(name) > 1 or not name.strip("."):
            raise AspEnvError(
                f"DATA: {name!r} names {names.count(name)} sites; each needs a name of its own"
            )
    return names


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One predictor for one horizon and seed at one site."""

    site: str
    predictor: str
    horizon_s: float
    view: str = ""
    """View of the network; for a variant without the trail, the view that has it."""
    recipe: str = ""
    """Recipe, if it is not the table's."""
    variant: str = ""
    """Variant of the recipe; empty for the main table."""
    seed: int | None = None
    """None for a predictor without training."""
    start: "Cell | None" = None
    """The cell whose weights the training starts from."""

    @property
    def label(self) -> str:
        """Predictor, recipe and variant."""
        return "-".join(part for part in (self.predictor, self.recipe, self.variant) if part)

    @property
    def name(self) -> str:
        """Path below the folders of runs, errors and logs."""
        parts = [self.site, self.view, self.label, f"{self.horizon_s:g}s"]
        if self.seed is not None:
            parts.append(f"seed{self.seed}")
        return "/".join(part for part in parts if part)


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelSpec:
    """A predictor of the table and its recipe."""

    predictor: str
    recipe: str = ""
    """Recipe, if it is not the table's."""
    warm_starts_from_3s: bool
    """Whether a run for more than 3 s starts from the weights of a run for 3 s."""

    @classmethod
    def from_name(cls, name: str, warm_starts_from_3s: Callable[[str], bool]) -> "ModelSpec":
        """Parses `PREDICTOR` or `PREDICTOR:RECIPE`.

        Args:
            name: such as `ssp-asp` or `ssp-asp:ours`.
            warm_starts_from_3s: of a predictor, whether its runs for more than 3 s start from
                runs for 3 s.
        """
        predictor, _, recipe = name.partition(":")
        return cls(
            predictor=predictor, recipe=recipe, warm_starts_from_3s=warm_starts_from_3s(predictor)
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Ablation:
    """A variant of a predictor."""

    predictor: str
    name: str
    horizons_s: tuple[float, ...]
    """Horizons that the variant is meant for."""
    warm_starts_from_3s: bool
    """Whether a longer run starts from the weights of a run for one segment, or 3 s."""
    segment_s: float | None = None
    """Length of the segments that are chained, if it is not the recipe's."""


def choose_ablations(
    names: Sequence[str],
    variants: Mapping[str, Mapping[str, Any]],
    warm_starts_from_3s: Callable[[str, str], bool],
) -> list[Ablation]:
    """Ablations by name.

    Args:
        names: `none`, `all`, `VARIANT` (of every predictor that has it) or `PREDICTOR:VARIANT`.
        variants: variants by predictor and name; each has `horizons_s` and `segment_s`.
        warm_starts_from_3s: of a predictor and a variant, whether runs for more than 3 s start
            from runs for 3 s.

    Raises:
        AspEnvError: no predictor has such a variant.
    """
    known = sorted({name for by_name in variants.values() for name in by_name})
    chosen = []
    for given in names:
        if given == "none":
            continue
        predictor, _, name = given.rpartition(":")
        matching = [
            Ablation(
                predictor=each,
                name=variant,
                horizons_s=tuple(by_name[variant].horizons_s),
                warm_starts_from_3s=warm_starts_from_3s(each, variant),
                segment_s=by_name[variant].segment_s,
            )
            for each, by_name in variants.items()
            for variant in by_name
            if name in ("all", variant) and predictor in ("", each)
        ]
        if not matching:
            raise unknown_name("ablation", given, ["none", "all", *known])
        chosen += [each for each in matching if each not in chosen]
    return chosen


def plan_cells(
    *,
    sites: Sequence[str],
    models: Sequence[ModelSpec],
    views: Sequence[str],
    horizons_s: Sequence[float],
    seeds: Sequence[int],
    ablations: Sequence[Ablation] = (),
    ablation_view: str = "",
) -> list[Cell]:
    """All cells in the order in which they run: the whole table for one seed, then for the next.

    A cell comes after the one that it starts from, which is added if it is not in the table.

    Args:
        sites: names of the sites.
        models: predictors with training.
        views: views of their networks.
        horizons_s: horizons in seconds.
        seeds: training seeds.
        ablations: variants, which are run at the first site only.
        ablation_view: the view of the ablations.
    """
    cells: list[Cell] = []
    variants = ["", CAUSAL] if any(each.name == CAUSAL for each in ablations) else [""]
    for site, horizon_s, predictor, variant in product(sites, horizons_s, PHYSICAL, variants):
        _add(cells, Cell(site=site, predictor=predictor, horizon_s=horizon_s, variant=variant))
    for seed, site, horizon_s in product(seeds, sites, sorted(horizons_s)):
        for view, model in product(views, models):
            _add(cells, _model_cell(site, view, model, horizon_s, seed))
    for seed, ablation in product(seeds, ablations):
        for horizon_s in sorted(set(horizons_s) & set(ablation.horizons_s)):
            _add(cells, _ablation_cell(sites[0], ablation_view, ablation, horizon_s, seed))
    return cells


def _model_cell(site: str, view: str, model: ModelSpec, horizon_s: float, seed: int) -> Cell:
    start = None
    if horizon_s > SEGMENT_S and model.warm_starts_from_3s:
        start = _model_cell(site, view, model, SEGMENT_S, seed)
    return Cell(
        site=site,
        predictor=model.predictor,
        recipe=model.recipe,
        view=view,
        horizon_s=horizon_s,
        seed=seed,
        start=start,
    )


def _ablation_cell(site: str, view: str, ablation: Ablation, horizon_s: float, seed: int) -> Cell:
    start = None
    first_s = SEGMENT_S if ablation.segment_s is None else ablation.segment_s
    if horizon_s > first_s and ablation.warm_starts_from_3s:
        if ablation.segment_s is not None or first_s in ablation.horizons_s:
            start = _ablation_cell(site, view, ablation, first_s, seed)
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
    """Appends a cell behind the one that it starts from."""
    if cell.start is not None:
        _add(cells, cell.start)
    if cell not in cells:
        cells.append(cell)

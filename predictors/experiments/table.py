"""`asp-env table`: what the paper's table has, trained and judged on any data."""

import fcntl
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from asp_env import registry
from asp_env.data.recording import DEFAULT_DT_S, ticks
from asp_env.errors import AspEnvError, MissingExtraError, unknown_name
from asp_env.files import atomic_file, leftovers
from asp_env.metrics.forecast.errors import MODE_RULES
from asp_env.views import VIEWS
from predictors.experiments.campaign import COST, Campaign
from predictors.experiments.cells import (
    CAUSAL,
    PHYSICAL,
    Cell,
    ModelSpec,
    Site,
    choose_ablations,
    open_sites,
    plan_cells,
    site_names,
)
from predictors.experiments.results import ORACLE
from predictors.experiments.tables import PAGE_WIDTH, export, read_findings, rows, tables
from predictors.experiments.worker import Job, Judging

CHAININGS = ("top1", ORACLE)
"""Judged besides a predictor's own way to chain segments."""

PLAN, LOCK = "plan.json", ".lock"


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Train and judge what the paper's table has; started again, it goes on where it was.

    A folder may get more predictors, views, seeds, horizons and ablations later: what is finished
    stays. Every seed of a predictor is a run of `asp-env train` in OUT/runs.
    """

    data: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="DATA …")]
    """What is learned from, a site each."""
    out: Path
    """Folder of runs, errors and tables."""
    validation: tuple[str, ...] = ()
    """Data to select on, for each DATA; all of DATA is learned from then."""
    test: tuple[str, ...] = ()
    """Data to judge on, for each DATA; without them, the part test of DATA."""
    recipe: str = "cpu"
    """Recipes: cpu (minutes on two cores) or paper."""
    views: tuple[str, ...] = ("chauffeurnet", "vectors")
    """What networks look at."""
    predictors: tuple[str, ...] = ("mtp", "dkm", "ffw-asp", "ssp-asp")
    """Rows, such as ssp-asp, or ssp-asp:ours for another preset."""
    horizons: tuple[float, ...] = (3.0, 6.0)
    """Columns, seconds. Those of ssp-asp over 3 s go on from the 3 s weights of the same seed."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """One run each."""
    ablations: tuple[str, ...] = ("none",)
    """Changes of recipes to try on the first DATA: none, all, or names such as no-trail or
    ssp-asp:skip."""
    ablation_view: str = "chauffeurnet"
    """What they look at."""
    jobs: int = 2
    """Cells at a time, of one thread each; 0 prints what is there, even meanwhile."""
    per_recording: int | None = None
    """Test snippets of each recording at most, at random."""
    epochs: int | None = None
    """Instead of the preset's; of each stage where there are two."""
    max_snippets: int | None = None
    """Learn from no more than so many, chosen at random."""

    def run(self) -> None:
        """Trains and judges what is not there yet, writes the folder, prints the tables.

        Raises:
            AspEnvError: an option or the data are bad, or the folder holds another table.
            SystemExit: of status 1, at the end, if a cell failed.
        """
        self._check()
        cells = self._plan()
        sites = {site.name: site for site in open_sites(self.data, self.validation, self.test)}
        console = Console()
        with _claimed(self.out, self._fixed(list(sites.values())), alone=self.jobs > 0):
            jobs = {cell: self._job(cell, sites[cell.site]) for cell in cells}
            campaign = Campaign(jobs, self.out, console)
            campaign.run(self.jobs)
            judged = {
                cell: job.judging
                for cell, job in jobs.items()
                if job.judging is not None and cell not in campaign.failed
            }
            findings = read_findings(judged)
            known = list(sites.values())
            export(
                self.out,
                rows(findings, sites, self.recipe),
                tables(findings, known, PAGE_WIDTH),
                self._manifest(known, campaign),
            )
        for table in tables(findings, known, console.width):
            console.print(table, "")
        console.print(f"wrote {self.out}/report.html; what it took is in {self.out / COST}")
        for cell, why in campaign.failed.items():
            console.print(f"failed: {cell.name}: {why}", style="red", soft_wrap=True, markup=False)
        if campaign.failed:
            raise SystemExit(1)

    def _check(self) -> None:
        """Refuses options that no cell could be run with."""
        if not (self.data and self.views and self.predictors and self.horizons and self.seeds):
            raise AspEnvError("table: give DATA, views, predictors, horizons and seeds, each once")
        for view in (*self.views, self.ablation_view):
            if view not in VIEWS:
                raise unknown_name("view", view, VIEWS)
        for horizon in self.horizons:
            ticks(horizon, DEFAULT_DT_S)
        if self.jobs < 0 or (self.per_recording is not None and self.per_recording < 1):
            raise AspEnvError(
                f"table: jobs is {self.jobs} and per_recording {self.per_recording}, expected 0 or "
                "more and 1 or more"
            )

    def _plan(self) -> list[Cell]:
        """All cells.

        Raises:
            AspEnvError: there is no such recipe or ablation.
        """
        train = registry.find("commands", "train")
        try:
            entrants = [
                ModelSpec.from_name(name, train.warm_starts_from_3s) for name in self.predictors
            ]
            own = dict.fromkeys(each.predictor for each in entrants if not each.preset)
            variants = {predictor: train.variants(predictor) for predictor in own}
            ablations = choose_ablations(self.ablations, variants, train.warm_starts_from_3s)
            cells = plan_cells(
                sites=site_names(self.data),
                entrants=entrants,
                views=self.views,
                horizons_s=self.horizons,
                seeds=self.seeds,
                ablations=ablations,
                ablation_view=self.ablation_view,
            )
            for cell in cells:
                self._recipes(cell)
        except ModuleNotFoundError as error:
            raise MissingExtraError(str(error.name), "train", "training") from error
        return cells

    def _recipes(self, cell: Cell) -> dict[str, Any]:
        """What the configuration of a cell's run must be, but for its data; nothing without one.

        Raises:
            AspEnvError: there is no such recipe.
        """
        if cell.seed is None:
            return {}
        train = registry.find("commands", "train")
        config = train(**self._options(cell), data="", out=Path()).config_for(cell.horizon_s)
        found = {"recipe": asdict(config), "defaults": _defaults(config)}
        return json.loads(json.dumps(found))

    def _options(self, cell: Cell) -> dict[str, Any]:
        """The options of `train` that are not about data and folders."""
        return {
            "predictor": cell.predictor,
            "recipe": cell.preset or self.recipe,
            "view": cell.view,
            "variant": cell.variant or None,
            "horizon": cell.horizon_s,
            "seed": cell.seed,
            "epochs": self.epochs,
            "max_snippets": self.max_snippets,
        }

    def _job(self, cell: Cell, site: Site) -> Job:
        """What the process of a cell does."""
        run = self.out / "runs" / cell.name
        train = None
        if cell.seed is not None:
            start = None if cell.start is None else str(self.out / "runs" / cell.start.name)
            where = {"data": site.data, "validation": site.validation}
            train = {**self._options(cell), **where, "out": str(run), "start": start}
        if cell.horizon_s not in self.horizons:
            return Job(train=train, judging=None, **self._recipes(cell))
        return Job(
            train=train,
            **self._recipes(cell),
            judging=Judging(
                predictor=cell.predictor,
                run="" if train is None else str(run),
                data=site.judged_on,
                data_hash=site.judged_hash,
                part="test" if site.test is None else "all",
                horizon_s=cell.horizon_s,
                history="causal" if cell.variant == CAUSAL else "recorded",
                per_recording=self.per_recording,
                errors=str(self.out / "errors" / cell.name),
                chainings=CHAININGS if not cell.variant and cell.seed is not None else (),
            ),
        )

    def _fixed(self, sites: Sequence[Site]) -> dict[str, Any]:
        """What all cells of a folder have in common, whenever they were run."""
        hashes = {
            site.name: {k: v for k, v in asdict(site).items() if k.endswith("_hash")}
            for site in sites
        }
        options = {"epochs": self.epochs, "max_snippets": self.max_snippets}
        return {"sites": hashes, "preset": self.recipe, **options}

    def _manifest(self, sites: Sequence[Site], campaign: Campaign) -> dict[str, Any]:
        return {
            "sites": [asdict(site) for site in sites],
            "options": {
                name: value
                for name, value in asdict(self).items()
                if name not in ("data", "validation", "test", "out", "jobs")
            },
            "privileged": [ORACLE],
            "physical": PHYSICAL,
            "best-of-3": f"of the three most probable modes, {MODE_RULES['fde']}",
            "intervals": "95 %, bootstrap over recordings, of errors averaged over seeds",
            "failed": {cell.name: why for cell, why in campaign.failed.items()},
        }


def _defaults(config: Any) -> dict[str, Any]:
    """Of a dataclass, those of its fields that have one, and of dataclasses in it."""
    found = {each.name: each.default for each in fields(config) if each.default is not MISSING}
    inner = {each.name: getattr(config, each.name) for each in fields(config)}
    return found | {name: _defaults(value) for name, value in inner.items() if is_dataclass(value)}


@contextmanager
def _claimed(out: Path, fixed: dict[str, Any], *, alone: bool) -> Iterator[None]:
    """The folder, for this table and, if `alone`, for this command.

    Raises:
        AspEnvError: it holds something else, or another command is at it.
    """
    path = out / PLAN
    # An interrupted command may leave only these.
    begun = {LOCK, *(each.name for each in leftovers(path))}
    foreign = out.exists() and (not out.is_dir() or {each.name for each in out.iterdir()} - begun)
    if foreign and not path.exists():
        raise AspEnvError(f"{out}: holds something that is no table; choose another --out")
    out.mkdir(parents=True, exist_ok=True)
    with (out / LOCK).open("w") as lock:
        try:
            if alone:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise AspEnvError(
                f"{out}: another asp-env table is at it; --jobs 0 prints what is there"
            ) from error
        same = json.loads(json.dumps(fixed))
        if not path.exists():
            with atomic_file(path) as partial:
                partial.write_text(json.dumps(fixed, indent=1) + "\n")
        elif (found := _read_plan(path)) != same:
            other = ", ".join(name for name in same if found.get(name) != same[name])
            raise AspEnvError(
                f"{out}: holds a table of other {other}; choose another --out or remove it"
            )
        yield


def _read_plan(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text()))
    except (TypeError, ValueError) as error:
        raise AspEnvError(f"{path}: cannot be read ({error}); choose another --out") from error

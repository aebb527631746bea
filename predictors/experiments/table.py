"""`asp-env table`: the paper's table on any data, with ablations."""

import fcntl
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, asdict, dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from asp_env.arguments import MAX_SEED, check_jobs
from asp_env.console import text_console
from asp_env.data.recording import DEFAULT_DT_S, ticks
from asp_env.errors import AspEnvError, MissingExtraError, unknown_name
from asp_env.files import atomic_file, is_temporary
from asp_env.metrics.forecast.errors import MODE_RULES
from asp_env.views import view_names
from asp_env.workers import WorkerPool
from predictors.experiments.campaign import COST, LOGS, ONE_THREAD, Campaign
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
from predictors.experiments.job import EvaluationJob, Job
from predictors.experiments.results import ORACLE, Training, trained
from predictors.experiments.tables import PAGE_WIDTH, export, read_findings, rows, tables
from predictors.training.command import Train

CHAININGS = ("top1", ORACLE)
"""Rules for chaining segments that are evaluated besides a predictor's own."""

PLAN, LOCK = "plan.json", ".lock"


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Train and evaluate the predictors of the paper's table; repeat to resume.

    Predictors, views, seeds, horizons and ablations can be added to OUT later.

    Every cell with a seed is a run of asp-env train, in OUT/runs.
    """

    data: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="DATA …")]
    """Training data; each DATA is a site of the table."""
    out: Path
    """Folder of the runs, errors and tables."""
    validation: tuple[str, ...] = ()
    """Validation data, one for each DATA. All of DATA is then used for training."""
    test: tuple[str, ...] = ()
    """Test data, one for each DATA. The default is the part test of DATA."""
    recipe: str = "cpu"
    """Recipe of the predictors: cpu (minutes on two cores) or paper."""
    views: tuple[str, ...] = ("chauffeurnet", "vectors")
    """Views of the networks."""
    predictors: tuple[str, ...] = ("mtp", "dkm", "ffw-asp", "ssp-asp")
    """Predictors such as ssp-asp; ssp-asp:ours is one with another recipe."""
    horizons: tuple[float, ...] = (3.0, 6.0)
    """Horizons in seconds. Runs of ssp-asp over 3 s start from the 3 s weights of the same seed."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Training seeds."""
    ablations: tuple[str, ...] = ("none",)
    """Variants of the recipes at the first site: none, all,
    or names such as no-trail or ssp-asp:skip."""
    ablation_view: str = "chauffeurnet"
    """View of the ablations."""
    jobs: int = 2
    """Number of cells that run at a time, with one thread
    each. With 0, the command only prints the finished
    cells, even while another command runs."""
    per_recording: int | None = None
    """Largest number of test snippets of each recording; they are chosen at random."""
    epochs: int | None = None
    """Number of prediction epochs of each training stage
    instead of the recipe's. With --budget cpu it is that of
    the reference, with converged the largest number."""
    budget: Literal["epochs", "cpu", "converged"] = "epochs"
    """What the number of prediction epochs of a row follows
    from: the recipe (epochs); the CPU time of --cpu-reference
    (cpu); or the validation error, until it stops to improve
    (converged, with the schedule plateau)."""
    patience: int | None = None
    """Prediction epochs without a lower validation error that
    end a run with --budget converged; 10 by default."""
    cpu_reference: str = "ssp-asp"
    """Predictor, or PREDICTOR:RECIPE, whose CPU time --budget
    cpu gives to every row of a view and horizon."""
    costs: Path | None = None
    """File of the measured CPU time of an epoch, for --budget
    cpu; what it lacks is measured at the first DATA and
    added. The default is OUT/epoch_costs.json."""
    max_snippets: int | None = None
    """Largest number of training snippets; they are chosen at random."""
    parked: bool = False
    """Train and evaluate on parked vehicles, too, as the paper's figures of all classes do."""

    def run(self) -> None:
        """Runs the cells that are not finished, writes the folder and prints the tables.

        Raises:
            AspEnvError: an option or the data are bad, or the folder contains another table.
            SystemExit: with status 1, at the end, if a cell failed.
        """
        self._check()
        cells = self._plan()
        sites = {site.name: site for site in open_sites(self.data, self.validation, self.test)}
        console = text_console()
        with _claimed(self.out, self._fixed(list(sites.values())), exclusive=self.jobs > 0):
            self._measure(cells, next(iter(sites.values())))
            jobs = {cell: self._job(cell, sites[cell.site]) for cell in cells}
            campaign = Campaign(jobs, self.out, console)
            campaign.run(self.jobs)
            evaluated = {
                cell: job.evaluation
                for cell, job in jobs.items()
                if job.evaluation is not None and cell not in campaign.failed
            }
            training = {
                cell: self._training(cell, campaign)
                for cell, job in evaluated.items()
                if job.done and cell.seed is not None
            }
            findings = read_findings(evaluated, training)
            all_sites = list(sites.values())
            export(
                self.out,
                rows(findings, sites, self.recipe),
                tables(findings, all_sites, PAGE_WIDTH, budget=self._budget),
                self._manifest(all_sites, campaign),
            )
        for table in tables(findings, all_sites, console.width, budget=self._budget):
            console.print(table, "")
        console.print(f"wrote {self.out}/report.html; CPU times are in {self.out / COST}")
        for cell, reason in campaign.failed.items():
            line = f"failed: {cell.name}: {reason}"
            console.print(line, style="red", soft_wrap=True)
        if campaign.failed:
            raise SystemExit(1)

    def _check(self) -> None:
        if not (self.data and self.views and self.predictors and self.horizons and self.seeds):
            raise AspEnvError("table: give DATA, views, predictors, horizons and seeds, each once")
        for view in (*self.views, self.ablation_view):
            if view not in view_names():
                raise unknown_name("view", view, view_names())
        for horizon in self.horizons:
            ticks(horizon, DEFAULT_DT_S)
        self._check_names_and_numbers()

    def _check_names_and_numbers(self) -> None:
        for option in ("views", "predictors", "horizons", "seeds"):
            given = getattr(self, option)
            twice = [each for each in given if given.count(each) > 1]
            if twice:
                raise AspEnvError(f"--{option}: {twice[0]} is given twice; give it once")
        for seed in self.seeds:
            if not 0 <= seed <= MAX_SEED:
                raise AspEnvError(f"--seeds {seed}: expected 0 to {MAX_SEED}")
        if "none" in self.ablations and len(self.ablations) > 1:
            raise AspEnvError(f"--ablations {' '.join(self.ablations)}: expected none alone")
        check_jobs(self.jobs, least=0)
        if self.per_recording is not None and self.per_recording < 1:
            raise AspEnvError(f"--per-recording {self.per_recording}: expected 1 or more")

    def _plan(self) -> list[Cell]:
        """All cells.

        Raises:
            AspEnvError: a predictor, recipe or ablation is unknown, or the costs cannot be read.
        """
        try:
            from predictors.training.variants import ablations as ablations_of
            from predictors.training.variants import warm_starts_from_3s

            models = [ModelSpec.from_name(name, warm_starts_from_3s) for name in self.predictors]
            table_recipe = dict.fromkeys(each.predictor for each in models if not each.recipe)
            variants = {
                predictor: ablations_of(predictor, self.recipe, budget=self.budget)
                for predictor in table_recipe
            }
            ablations = choose_ablations(self.ablations, variants, warm_starts_from_3s)
            cells = plan_cells(
                sites=site_names(self.data),
                models=models,
                views=self.views,
                horizons_s=self.horizons,
                seeds=self.seeds,
                ablations=ablations,
                ablation_view=self.ablation_view,
            )
            for cell in cells:
                if cell.seed is not None:
                    train = self._train(cell)
                    train.check_budget()
                    train.unlimited_for(cell.horizon_s, epochs=self.epochs)
                    if self.budget == "cpu":
                        train.costly_configs()
            if self.budget == "cpu":
                from predictors.training.budgets import EpochCosts

                EpochCosts.read(self._costs, self._reference)
        except ModuleNotFoundError as error:
            raise MissingExtraError(str(error.name), "train", "training") from error
        return cells

    def _configuration(self, cell: Cell) -> dict[str, Any]:
        """Configuration of a cell's run without its data, and defaults; empty without training.

        Raises:
            AspEnvError: there is no such recipe.
        """
        if cell.seed is None:
            return {}
        config = self._train(cell).config_for(cell.horizon_s)
        fields = {"recipe": asdict(config), "defaults": _defaults(config)}
        return json.loads(json.dumps(fields))

    def _options(self, cell: Cell) -> dict[str, Any]:
        """Options of `train` except data and folders."""
        return {
            "predictor": cell.predictor,
            "recipe": cell.recipe or self.recipe,
            "view": cell.view,
            "variant": cell.variant or None,
            "horizon": cell.horizon_s,
            "seed": cell.seed,
            "epochs": self.epochs,
            "max_snippets": self.max_snippets,
            "budget": self.budget,
            "patience": self.patience,
            "cpu_reference": self.cpu_reference,
            "costs": self._costs if self.budget == "cpu" else self.costs,
            "parked": self.parked,
        }

    def _train(self, cell: Cell, site: Site | None = None) -> Train:
        """The command of a cell; without a site for its configuration only."""
        validation = () if site is None or site.validation is None else (site.validation,)
        return Train(**self._options(cell), data=(), validation=validation, out=Path())

    @property
    def _costs(self) -> Path:
        from predictors.training.budgets import COSTS

        return self.out / COSTS if self.costs is None else self.costs

    @property
    def _reference(self) -> str:
        """The reference of the budget `cpu` as PREDICTOR:RECIPE."""
        predictor, _, recipe = self.cpu_reference.partition(":")
        return f"{predictor}:{recipe or self.recipe}"

    @property
    def _budget(self) -> str:
        """What the number of epochs follows from, in words."""
        if self.budget == "cpu":
            return f"CPU time of {self._reference}"
        if self.budget == "converged":
            from predictors.training.budgets import CONVERGED_PATIENCE

            patience = self.patience or CONVERGED_PATIENCE
            return f"until {patience} prediction epochs do not improve the validation error"
        return "prediction epochs of the recipe" if self.epochs is None else "prediction epochs"

    def _measure(self, cells: Sequence[Cell], site: Site) -> None:
        """Measures the CPU time of an epoch of all rows, if the budget needs it.

        Raises:
            AspEnvError: the data or the file of the costs are bad.
        """
        if self.budget != "cpu" or not self.jobs:
            return
        from predictors.training.budgets import complete_costs
        from predictors.training.epoch_costs import measure_epochs

        trains = [self._train(cell, site) for cell in cells if cell.seed is not None]
        log = self.out / LOGS / f"{self._costs.stem}.txt"
        log.parent.mkdir(parents=True, exist_ok=True)

        def measure(configs: Sequence[Any]) -> Sequence[Any]:
            work = partial(measure_epochs, data=site.data)
            env = {**os.environ, **ONE_THREAD}
            with log.open("ab") as file, WorkerPool(work, 1, output=file, env=env) as pool:
                return pool.submit(list(configs)).result()

        configs = [config for train in trains for config in train.costly_configs()]
        complete_costs(self._costs, self._reference, configs, measure)

    def _training(self, cell: Cell, campaign: Campaign) -> Training:
        """The training of a finished cell, with those that it starts from."""
        own = trained(self.out / "runs" / cell.name, campaign.training_cpu_s(cell))
        if cell.start is None:
            return own
        first = self._training(cell.start, campaign)
        cpu_s = None
        if own.cpu_s is not None and first.cpu_s is not None:
            cpu_s = first.cpu_s + own.cpu_s
        return Training(
            epochs=first.epochs + own.epochs,
            pretraining_epochs=first.pretraining_epochs + own.pretraining_epochs,
            cpu_s=cpu_s,
        )

    def _job(self, cell: Cell, site: Site) -> Job:
        run = self.out / "runs" / cell.name
        train = None
        if cell.seed is not None:
            start = None if cell.start is None else str(self.out / "runs" / cell.start.name)
            data = {"data": site.data, "validation": site.validation}
            train = {**self._options(cell), **data, "out": str(run), "start": start}
        if cell.horizon_s not in self.horizons:
            return Job(train=train, evaluation=None, **self._configuration(cell))
        return Job(
            train=train,
            **self._configuration(cell),
            evaluation=EvaluationJob(
                predictor=cell.predictor,
                run="" if train is None else str(run),
                data=site.evaluated_on,
                data_hash=site.evaluated_hash,
                part="test" if site.test is None else "all",
                horizon_s=cell.horizon_s,
                history="causal" if cell.variant == CAUSAL else "recorded",
                per_recording=self.per_recording,
                parked=self.parked,
                errors=str(self.out / "errors" / cell.name),
                chainings=CHAININGS if not cell.variant and cell.seed is not None else (),
            ),
        )

    def _fixed(self, sites: Sequence[Site]) -> dict[str, Any]:
        """Content of `plan.json`: what all cells of a folder have in common."""
        hashes = {
            site.name: {k: v for k, v in asdict(site).items() if k.endswith("_hash")}
            for site in sites
        }
        options: dict[str, Any] = {"epochs": self.epochs, "max_snippets": self.max_snippets}
        if self.budget != "epochs":
            options["budget"] = self.budget
        if self.budget == "converged":
            options["patience"] = self.patience
        if self.budget == "cpu":
            options["cpu_reference"] = self._reference
        if self.parked:
            options["parked"] = True
        return {"sites": hashes, "preset": self.recipe, **options}

    def _manifest(self, sites: Sequence[Site], campaign: Campaign) -> dict[str, Any]:
        return {
            "sites": [asdict(site) for site in sites],
            "options": {
                name: value
                for name, value in asdict(self).items()
                if name not in ("data", "validation", "test", "out", "jobs", "costs")
            },
            "budget": self._budget,
            "epoch costs": self._stored_costs(),
            "privileged": [ORACLE],
            "physical": PHYSICAL,
            "best-of-3": f"of the three most probable modes, {MODE_RULES['fde']}",
            "intervals": "95 %, bootstrap over recordings, of errors averaged over seeds",
            "failed": {cell.name: reason for cell, reason in campaign.failed.items()},
        }

    def _stored_costs(self) -> dict[str, Any] | None:
        """The measured CPU times of an epoch, in seconds; None without the budget `cpu`."""
        return json.loads(self._costs.read_text()) if self.budget == "cpu" else None


def _defaults(config: Any) -> dict[str, Any]:
    """Defaults of the fields of a dataclass, and of the dataclasses in it."""
    defaults = {each.name: each.default for each in fields(config) if each.default is not MISSING}
    values = {each.name: getattr(config, each.name) for each in fields(config)}
    inner = {name: _defaults(value) for name, value in values.items() if is_dataclass(value)}
    return defaults | inner


@contextmanager
def _claimed(out: Path, fixed: dict[str, Any], *, exclusive: bool) -> Iterator[None]:
    """Creates or checks the folder of the table and, if `exclusive`, locks it.

    Raises:
        AspEnvError: it contains something else, or another command has locked it.
    """
    path = out / PLAN
    # A killed command may have left only the lock and temporary files.
    foreign = out.exists() and (
        not out.is_dir()
        or any(each.name != LOCK and not is_temporary(each) for each in out.iterdir())
    )
    if foreign and not path.exists():
        raise AspEnvError(f"{out}: contains something that is no table; choose another --out")
    out.mkdir(parents=True, exist_ok=True)
    with (out / LOCK).open("w") as lock:
        try:
            if exclusive:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise AspEnvError(
                f"{out}: another asp-env table uses it; --jobs 0 prints the finished cells"
            ) from error
        expected = json.loads(json.dumps(fixed))
        if not path.exists():
            with atomic_file(path) as partial:
                partial.write_text(json.dumps(fixed, indent=1) + "\n")
        elif (plan := _read_plan(path)) != expected:
            both = dict.fromkeys((*expected, *plan))
            names = ", ".join(name for name in both if plan.get(name) != expected.get(name))
            raise AspEnvError(
                f"{out}: contains a table with other {names}; choose another --out or remove it"
            )
        yield


def _read_plan(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (TypeError, ValueError) as error:
        raise AspEnvError(f"{path}: cannot be read ({error}); choose another --out") from error

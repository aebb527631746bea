"""The commands `asp-env rl train` and `asp-env rl evaluate`."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from asp_env.arguments import check_jobs, check_max_scenarios
from asp_env.console import table_console, text_console
from asp_env.data.predictor import feature_size, load_predictor
from asp_env.data.recording import DEFAULT_DT_S, ticks
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError, MissingExtraError, unknown_name
from asp_env.files import check_new, write_text
from asp_env.sim.action_types import ActionType
from policies.settings import (
    REWARD_WEIGHTS,
    Algorithm,
    EnvironmentSettings,
    PolicySettings,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class RLTrain:
    """Train a policy with stable-baselines3; --resume goes on with an interrupted run."""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")]
    """Folder in the inD/rounD or INTERACTION layout, or sample:…, synthetic:… or highway:…."""
    out: Path
    """Folder of the run."""
    algorithm: Algorithm = "ppo"
    predictor: Annotated[str | None, tyro.conf.arg(metavar="NAME[:RUN]")] = None
    """Predictor whose forecasts are observed; none by default."""
    forecast: tuple[str, ...] = ()
    """Options of the forecasts, such as modes=1 features=latent;
    see asp_env.envs.ForecastOptions."""
    scenarios: Annotated[str, tyro.conf.arg(metavar="FILTER")] = ""
    """Tags and comparisons, such as interactive,length>=8."""
    traffic: str | None = None
    """Driver of all other agents; that of the world by default."""
    steps: int = 400_000
    """Steps of training, each of --action-repeat ticks."""
    num_envs: int = 64
    """Number of environments."""
    seed: int = 0
    action_type: ActionType = "route"
    """What actions mean: direct (acceleration and steering), jerk
    (their changes) or route (acceleration, and a correction
    of the steering along the route)."""
    action_repeat: int = 3
    """Number of ticks for which an action is held."""
    reward: tuple[str, ...] = ()
    """Weights of the reward that differ from those of training,
    such as collision=2."""
    neighbours: int = 8
    """Number of nearest agents that are observed."""
    map_lines: int = 0
    """Number of pieces of lines of the map that are observed."""
    view: str | None = None
    """Observe the rasters of this view instead."""
    raster_px: tuple[int, int] | None = None
    """Height and width of the rasters."""
    encoder: Annotated[str | None, tyro.conf.arg(metavar="NAME:RUN")] = None
    """Trained predictor whose encoder reads the rasters."""
    dt: float = DEFAULT_DT_S
    """Duration of a tick in seconds."""
    gamma: float = 0.9
    """Discount factor of a step."""
    learning_rate: float = 6e-4
    """Learning rate at the start; it falls linearly."""
    width: int = 64
    """Width of the layers of the network."""
    hyperparameters: Annotated[
        tuple[str, ...], tyro.conf.arg(name="set", metavar="NAME=VALUE …")
    ] = ()
    """Arguments of the algorithm in stable-baselines3, such as n_steps=64."""
    curriculum: Annotated[str | None, tyro.conf.arg(metavar="COLUMN")] = None
    """Column of the scenarios by which easy ones come first,
    such as density, or =-pet_behind_s for large gaps first."""
    demonstrations: int = 0
    """Epochs of behaviour cloning of the logged drivers before
    the training; with --algorithm bc they are all of it."""
    privileged: bool = False
    """Allow a predictor that uses the recorded future."""
    resume: bool = False
    """Go on with an interrupted run in --out."""

    def settings(self) -> PolicySettings:
        """The settings of the policy.

        Raises:
            AspEnvError: an option is invalid.
        """
        return PolicySettings(
            algorithm=self.algorithm,
            data=self.data,
            environment=EnvironmentSettings(
                scenarios=self.scenarios,
                traffic=self.traffic,
                dt_s=self.dt,
                action_type=self.action_type,
                action_repeat=self.action_repeat,
                reward_weights={**REWARD_WEIGHTS, **_parse("reward", self.reward)},
                predictor=self.predictor,
                forecast=_parse("forecast", self.forecast),
                neighbours=self.neighbours,
                map_lines=self.map_lines,
                view=self.view,
                raster_px=self.raster_px,
            ),
            steps=self.steps,
            num_envs=self.num_envs,
            seed=self.seed,
            width=self.width,
            encoder=self.encoder,
            gamma=self.gamma,
            learning_rate=self.learning_rate,
            hyperparameters=_parse("set", self.hyperparameters),
            curriculum=self.curriculum,
            demonstrations=self.demonstrations,
        )

    def run(self) -> None:
        """Trains, with a progress bar, and prints how to evaluate the policy."""
        train_policy = _training().train_policy
        settings, console = self.settings(), text_console()
        columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
        bar = Progress(*columns, console=console)
        task = bar.add_task(f"{settings.algorithm}, {settings.steps:,} steps", total=settings.steps)

        def show(steps: int) -> None:
            bar.start()  # after all checks
            bar.update(task, completed=steps)

        try:
            train_policy(
                settings,
                self.out,
                resume=self.resume,
                privileged=self.privileged,
                progress=show,
            )
        finally:
            if bar.live.is_started:
                bar.stop()
        console.print(f"{self.out} written: asp-env rl evaluate DATA --runs {self.out}")


@dataclass(frozen=True, slots=True, kw_only=True)
class RLEvaluate:
    """Drive scenarios with trained policies in their environment, and print what became of them."""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")]
    """Folder in the inD/rounD or INTERACTION layout, or sample:…, synthetic:… or highway:…."""
    runs: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="RUN …")]
    """Run folders of policies."""
    scenarios: Annotated[str, tyro.conf.arg(metavar="FILTER")] = ""
    """Tags and comparisons, such as interactive,length>=8."""
    max_scenarios: int | None = None
    """Largest number of scenarios; they are chosen at even spacing."""
    traffic: str | None = None
    """Driver of all other agents; that of the world by default."""
    predictor: Annotated[str | None, tyro.conf.arg(metavar="NAME[:RUN]")] = None
    """Predictor of the forecasts, which must be that of the
    training; for runs that were moved."""
    privileged: bool = False
    """Allow a predictor that uses the recorded future."""
    out: Path | None = None
    """File to write the results to, as JSON."""

    def run(self) -> None:
        """Evaluates all runs and prints a table."""
        training = _training()
        from policies.evaluation import METRICS, evaluate_trained
        from policies.runs import load_policy

        if self.out is not None:
            check_new(self.out)
        if not self.runs:
            raise AspEnvError("--runs: none given; expected at least one run folder of a policy")
        check_max_scenarios(self.max_scenarios)
        open_data(self.data)
        policies = {folder: load_policy(folder) for folder in self.runs}
        console, results = table_console(), {}
        table = Table("run", "scenarios", *METRICS)
        table.columns[0].overflow = "fold"
        columns = (TextColumn("{task.description}", markup=False), BarColumn())
        with Progress(*columns, console=console, transient=True) as bar:
            for folder, trained in policies.items():
                environment = dataclasses.replace(
                    trained.settings.environment,
                    traffic=self.traffic,
                    predictor=self.predictor or trained.settings.environment.predictor,
                )
                trained.settings = dataclasses.replace(trained.settings, environment=environment)
                training.check_environment(folder, trained.settings, self.data, self.privileged)
                task = bar.add_task(str(folder), total=None)
                driven = evaluate_trained(
                    trained,
                    self.data,
                    scenarios=self.scenarios,
                    max_scenarios=self.max_scenarios,
                    privileged=self.privileged,
                    progress=lambda done, of, task=task: bar.update(task, completed=done, total=of),
                )
                estimates = driven.estimates()
                table.add_row(
                    str(folder),
                    str(len(driven.scenarios)),
                    *(f"{estimates[name]:.2f}" for name in METRICS),
                )
                results[str(folder)] = {
                    name: {"value": each.value, "low": each.low, "high": each.high, "n": each.n}
                    for name, each in estimates.items()
                }
        console.print(table)
        if self.out is not None:
            write_text(self.out, json.dumps({"data": self.data, "runs": results}, indent=1))
            console.print(f"wrote {self.out}")


@dataclass(frozen=True, slots=True, kw_only=True)
class RLCompare:
    """Train policies that observe other forecasts, and drive held-out scenarios with all."""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")]
    """Data that all policies are trained on."""
    held_out: Annotated[str, tyro.conf.arg(metavar="DATA")]
    """Data of other places, which all policies, planners and zero and random
    actions drive."""
    out: Path
    """Folder of the comparison. An interrupted one goes on where it was."""
    learned: Annotated[str, tyro.conf.arg(metavar="NAME:RUN")] = "ssp-asp:pretrained"
    """Trained predictor of the rows learned and latent."""
    scenarios: Annotated[str, tyro.conf.arg(metavar="FILTER")] = "interactive"
    """Tags and comparisons, for training and held-out data."""
    max_scenarios: int | None = None
    """Largest number of held-out scenarios, chosen at even spacing."""
    rows: tuple[str, ...] = ()
    """Rows by name; all by default. The first is the reference."""
    seeds: int = 5
    """Number of training seeds of each row."""
    steps: int = 400_000
    """Steps of every training."""
    jobs: int = 1
    """Number of processes."""

    def run(self) -> None:
        """Trains and drives, and writes comparison.json and curves.html.

        Raises:
            AspEnvError: an option is invalid.
        """
        _training()
        from policies import comparison as c

        rows = c.default_rows(self.learned)
        names = self.rows or tuple(rows)
        for name in names:
            if name not in rows:
                raise unknown_name("row", name, rows)
        if len(set(names)) < len(names):
            raise AspEnvError(f"--rows {', '.join(names)}: name each once")
        if self.seeds < 1:
            raise AspEnvError(f"--seeds {self.seeds}: expected at least 1")
        check_jobs(self.jobs)
        horizon = ticks(c.HORIZON_S, DEFAULT_DT_S)
        learned = load_predictor(self.learned, horizon=horizon, dt_s=DEFAULT_DT_S)
        if not feature_size(learned):
            raise AspEnvError(
                f"--learned {self.learned}: it is not trained and has no features; name a trained "
                "predictor, such as ssp-asp:pretrained"
            )
        open_data(self.data)
        console = table_console()
        held_out = c.HeldOut(
            data=self.held_out, scenarios=self.scenarios, max_scenarios=self.max_scenarios
        )
        recording = held_out.choose(DEFAULT_DT_S).recording
        cells = [self._cell(name, rows[name], seed) for seed in range(self.seeds) for name in names]
        shared = {
            "data": self.data,
            "held_out": dataclasses.asdict(held_out),
            "learned": self.learned,
            "policy": dataclasses.asdict(cells[0].settings),
        }
        c.check_out(self.out, shared)
        c.run_cells(cells, held_out, self.jobs, console)
        values = c.baselines(held_out, cells[0].settings.environment)
        by_row = {name: [each] for name, each in values.items()}
        folders = {name: [cell.folder for cell in cells if cell.row == name] for name in names}
        for name, seeds in folders.items():
            by_row[name] = [c.read_values(folder) for folder in seeds]
        early = {
            name: [c.early_success(folder, self.steps) for folder in seeds]
            for name, seeds in folders.items()
        }
        compared = c.compare_rows(by_row, recording, names[0], early=early)
        console.print(c.rendered(compared, names[0]))
        content = {"settings": shared, "rows": c.as_json(compared)}
        write_text(self.out / "comparison.json", json.dumps(content, indent=1))
        figure = c.curves_figure(c.learning_curves(folders))
        write_text(self.out / "curves.html", figure.to_html(include_plotlyjs=True))
        console.print(f"wrote {self.out}/comparison.json and curves.html")

    def _cell(self, name: str, observed: Any, seed: int) -> Any:
        from policies.comparison import Cell

        settings = PolicySettings(
            data=self.data,
            environment=EnvironmentSettings(
                scenarios=self.scenarios,
                predictor=observed.predictor,
                forecast=observed.forecast,
            ),
            steps=self.steps,
            seed=seed,
        )
        folder = self.out / name.replace(" ", "-") / str(seed)
        return Cell(row=name, settings=settings, privileged=observed.privileged, folder=folder)


def _training() -> Any:
    """The module of training, which needs stable-baselines3 and torch."""
    try:
        from policies import training
    except ModuleNotFoundError as error:
        raise MissingExtraError(str(error.name), "rl", "asp-env rl") from error
    return training


def _parse(option: str, texts: tuple[str, ...]) -> dict[str, Any]:
    """Values by name of texts `NAME=VALUE`; values are JSON, or text."""
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise AspEnvError(f"--{option} {text}: expected NAME=VALUE")
        try:
            values[name] = json.loads(value)
        except ValueError:
            values[name] = value
    return values

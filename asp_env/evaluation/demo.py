"""`asp-env demo`: the whole workflow on synthetic traffic, from recordings to a report."""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from rich.console import Console

from asp_env import registry
from asp_env.errors import AspEnvError
from asp_env.evaluation.closed_loop.drive import Drive, drive, save_rollouts
from asp_env.evaluation.closed_loop.scenario_table import write_scenario_table
from asp_env.evaluation.open_loop.evaluate import Evaluate, evaluate
from asp_env.evaluation.report import check_report_possible, write_report
from asp_env.evaluation.results import write_manifest, write_metrics
from asp_env.evaluation.tables import driving_tables, open_loop_tables
from asp_env.files import atomic_folder
from asp_env.metrics.driving.rules import DEFAULT_RULES, RULES

SITE = "intersection"
PREDICTOR = "ffw-asp"
RECIPE = "ours"
TRAINING = {"recordings": 30, "minutes": 2.5, "seed": 0, "locations": 6}
"""Options of `asp-env synthesize` for the traffic that the predictor is trained on."""
HELD_OUT = {"recordings": 9, "minutes": 2.0, "seed": 48_271}
"""Recordings to evaluate on; another seed gives other locations."""
SCENARIOS = 48
"""Number of scenarios that each method drives."""

PLAN = {
    "site": SITE,
    "training": TRAINING,
    "held_out": HELD_OUT,
    "predictor": PREDICTOR,
    "preset": RECIPE,
    "asp-env": metadata.version("asp-env"),
}
"""Options of a demo. Its folder contains them, so that only the same demo is resumed there."""

LEAD = (
    "A predictor is trained on synthetic traffic. On traffic at other locations, its forecasts are "
    "compared with the recorded future, and a planner drives the ego with them. The method expert "
    "replays the recorded drives; its scores are the reference for all others."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Demo:
    """Show the whole workflow: synthesize, train, evaluate, drive, write a report.

    After an interruption, the same command resumes at the unfinished step.
    """

    out: Path = Path("demo")
    """Folder to write: recordings, the trained predictor and the report."""

    def run(self) -> None:
        """Runs the steps that are not finished, then writes the results.

        Raises:
            AspEnvError: a package is missing, or the folder contains something else.
        """
        check_report_possible()
        console = Console()
        _claim(self.out)
        training, held_out = self.out / "traffic", self.out / "held-out"
        for folder, options in ((training, TRAINING), (held_out, HELD_OUT)):
            if not folder.exists():
                console.rule(f"Simulating traffic: {folder}")
                _run_command("synthesize", out=folder, site=SITE, **options)
        run = self.out / PREDICTOR
        if not (run / "config.json").exists():
            console.rule(f"Training the predictor {PREDICTOR}")
            _run_command("train", predictor=PREDICTOR, data=str(training), out=run, recipe=RECIPE)
        console.rule("Evaluating forecasts and driving")
        trained = f"{PREDICTOR}:{run}"
        open_loop = evaluate(
            Evaluate(
                data=str(held_out),
                out=self.out,
                predictors=("constant-velocity", "constant-turn-rate", trained),
            )
        )
        closed_loop = drive(
            Drive(
                data=str(held_out),
                out=self.out,
                predictors=("oracle", "constant-velocity", trained),
                max_scenarios=SCENARIOS,
            )
        )
        open_privileged = open_loop.manifest["privileged"]
        closed_privileged = closed_loop.manifest["privileged"]
        with _replacing(self.out) as folder:
            write_metrics(folder, [*open_loop.rows, *closed_loop.rows])
            privileged = sorted({*open_privileged, *closed_privileged})
            write_manifest(
                folder,
                "demo",
                plan=PLAN,
                privileged=privileged,
                open_loop=open_loop.manifest,
                closed_loop=closed_loop.manifest,
            )
            write_scenario_table(folder, closed_loop.scenarios, closed_loop.methods)
            save_rollouts(folder, closed_loop)
            write_report(
                folder,
                title="Does the predictor make the car drive better?",
                lead=LEAD,
                maps=closed_loop.maps,
                examples=open_loop.examples,
            )
        tables = open_loop_tables(open_loop.rows, open_privileged)
        shown = RULES[DEFAULT_RULES].shown
        for table in (*tables, *driving_tables(closed_loop.rows, closed_privileged, shown)):
            console.print(table)
        console.print(f"wrote {self.out / 'report.html'}")


def _run_command(name: str, **options: Any) -> None:
    """Runs a registered command; options have the names of its fields."""
    registry.find("commands", name)(**options).run()


def _claim(out: Path) -> None:
    """Creates the folder, or checks that it was created by the same demo."""
    path = out / "plan.json"
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        try:
            same = json.loads(path.read_text()) == PLAN
        except (OSError, ValueError):
            same = False
        if not same:
            raise AspEnvError(
                f"{out}: contains no demo of this version; choose another --out or remove it"
            )
        return
    out.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(PLAN, indent=2) + "\n")


@contextmanager
def _replacing(out: Path) -> Iterator[Path]:
    """A new folder whose files and folders then replace those of the same names in `out`."""
    fresh = out / "fresh"
    shutil.rmtree(fresh, ignore_errors=True)
    with atomic_folder(fresh) as folder:
        yield folder
    for new in fresh.iterdir():
        old = out / new.name
        shutil.rmtree(old) if old.is_dir() else old.unlink(missing_ok=True)
        new.rename(old)
    fresh.rmdir()

"""`asp-env demo`: does a predictor make the car drive better? From recordings to a report."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from rich.console import Console

from asp_env import registry
from asp_env.console import text_console
from asp_env.data.scenarios.selection import save_scenarios
from asp_env.errors import AspEnvError
from asp_env.evaluation.closed_loop.drive import ClosedLoopResult, Drive, drive, save_rollouts
from asp_env.evaluation.closed_loop.scenario_table import write_scenario_table
from asp_env.evaluation.open_loop.evaluate import Evaluate, OpenLoopResult, evaluate
from asp_env.evaluation.report import check_report_possible, write_report
from asp_env.evaluation.results import write_manifest, write_metrics
from asp_env.evaluation.tables import driving_tables, headlines, open_loop_tables, regret_tables
from asp_env.files import atomic_folder, is_vacant, write_text
from asp_env.metrics.driving.rules import DEFAULT_RULES, RULES

TRAFFIC = {"site": "intersection", "traffic": "dense"}
"""Options of `asp-env synthesize` for all traffic of the demo."""
HELD_OUT = {"recordings": 24, "locations": 24, "minutes": 2.0, "seed": 48_271}
"""Recordings to evaluate on. Every one has a location of its own, because scenarios of one
location resemble each other."""
TRAINING = {"recordings": 12, "locations": 12, "minutes": 2.0, "seed": 0}
"""Recordings that the predictor is trained on; another seed gives other locations."""

PREDICTOR = "ffw-asp"
RECIPE = {"recipe": "ours", "view": "vectors", "split": "blocks", "epochs": 6}
"""Options of `asp-env train`: six epochs instead of the recipe's eight. Every recording is split
into blocks of time, so that all locations are trained on."""
PRETRAINED = "ssp-asp:pretrained"

PHYSICAL = ("constant-velocity", "constant-turn-rate")
"""Predictors that are compared with the trained ones in open loop. In closed loop these are the
controls of `asp-env drive --controls`."""

PLANNER = "contingency"
SCENARIOS = "interactive"
"""Filter of the scenarios that every method drives."""
MAX_SCENARIOS = 120

PLAN = {
    "traffic": TRAFFIC,
    "training": TRAINING,
    "held_out": HELD_OUT,
    "predictor": PREDICTOR,
    "recipe": RECIPE,
    "asp-env": metadata.version("asp-env"),
}
"""Options of a demo. Its folder contains them, so that only the same demo is resumed there."""

TITLE = "Does the predictor make the car drive better?"
FIRST_LEAD = (
    f"The pretrained predictor {PRETRAINED} forecasts synthetic traffic at locations that it was "
    "not trained on, and its forecasts are compared with the recorded future. Another predictor is "
    "being trained; this report is then replaced by one that also has the driving."
)
LEAD = (
    "Two predictors, one pretrained and one trained briefly, forecast synthetic traffic at "
    "locations that neither was trained on. Their forecasts are compared with the recorded future, "
    "and a planner drives the ego with them. The oracle is the recorded future, and the method "
    "expert replays the recorded drives; their scores are the references for all others."
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
        console = text_console()
        _claim(self.out)
        held_out, run = self.out / "held-out", self.out / "trained"
        _simulate(console, held_out, HELD_OUT)
        if not (run / "config.json").exists():
            console.rule(f"Evaluating the forecasts of {PRETRAINED}")
            first = self._forecast(held_out, PRETRAINED, planner="none")
            _show(console, self.out, first, lead=FIRST_LEAD)
            training = self.out / "traffic"
            _simulate(console, training, TRAINING)
            console.rule(f"Training the predictor {PREDICTOR}")
            _run_command("train", predictor=PREDICTOR, data=(str(training),), out=run, **RECIPE)
        console.rule("Evaluating forecasts and driving")
        learned = (PRETRAINED, f"{PREDICTOR}:{run}")
        closed_loop = drive(
            Drive(
                data=str(held_out),
                out=self.out,
                planner=PLANNER,
                predictors=learned,
                controls=True,
                scenarios=SCENARIOS,
                max_scenarios=MAX_SCENARIOS,
                jobs=os.cpu_count() or 1,
            )
        )
        open_loop = self._forecast(held_out, *learned, planner=PLANNER)
        _show(console, self.out, open_loop, closed_loop, lead=LEAD)

    def _forecast(self, data: Path, *learned: str, planner: str) -> OpenLoopResult:
        """Evaluates trained predictors beside physical ones, and the regret of a planner."""
        return evaluate(
            Evaluate(
                data=str(data), out=self.out, predictors=(*PHYSICAL, *learned), planner=planner
            )
        )


def _simulate(console: Console, folder: Path, options: dict[str, Any]) -> None:
    """Generates traffic, unless the folder exists."""
    if not folder.exists():
        console.rule(f"Simulating traffic: {folder}")
        jobs = os.cpu_count() or 1
        _run_command("synthesize", out=folder, jobs=jobs, **TRAFFIC, **options)


def _show(
    console: Console,
    out: Path,
    open_loop: OpenLoopResult,
    closed_loop: ClosedLoopResult | None = None,
    *,
    lead: str,
) -> None:
    """Writes the results that there are, and prints their tables."""
    results = [open_loop] if closed_loop is None else [open_loop, closed_loop]
    manifests = [result.manifest for result in results]
    with _replacing(out) as folder:
        write_metrics(folder, [row for result in results for row in result.rows])
        write_manifest(
            folder,
            "demo",
            plan=PLAN,
            privileged=sorted({name for each in manifests for name in each["privileged"]}),
            **dict(zip(("open_loop", "closed_loop"), manifests, strict=False)),
        )
        if closed_loop is not None:
            save_scenarios(folder / "scenarios.json", closed_loop.scenarios, closed_loop.recordings)
            write_scenario_table(folder, [closed_loop.driven])
            save_rollouts(folder, closed_loop)
        write_report(
            folder,
            title=TITLE,
            lead=lead,
            maps={} if closed_loop is None else closed_loop.maps,
            examples=open_loop.examples,
        )
    for table in open_loop_tables(open_loop.rows, open_loop.manifest["privileged"]):
        console.print(table)
    if closed_loop is not None:
        for table in regret_tables(open_loop.rows, planner=PLANNER):
            console.print(table)
        rows, privileged = closed_loop.rows, closed_loop.manifest["privileged"]
        for table in driving_tables(rows, privileged, RULES[DEFAULT_RULES].shown):
            console.print(table)
        for sentence in headlines(rows, privileged):
            console.print(sentence)
    console.print(f"wrote {out / 'report.html'}")


def _run_command(name: str, **options: Any) -> None:
    """Runs a registered command; options have the names of its fields."""
    registry.find("commands", name)(**options).run()


def _claim(out: Path) -> None:
    """Creates the folder, or checks that it was created by the same demo."""
    path = out / "plan.json"
    if not is_vacant(out):
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
    write_text(path, json.dumps(PLAN, indent=2) + "\n")


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

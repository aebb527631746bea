"""`asp-env demo`: the main job on embedded data, from traffic to report."""

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
from asp_env.evaluation.open_loop.evaluate import Evaluate, evaluate
from asp_env.evaluation.report import check_report_possible, write_report
from asp_env.evaluation.results import write_manifest, write_metrics
from asp_env.evaluation.tables import driving_table, open_loop_tables
from asp_env.files import atomic_folder
from asp_env.metrics.driving.rules import DEFAULT_RULES, RULES

SITE = "intersection"
PREDICTOR = "ffw-asp"
TRAINING = {"recordings": 30, "minutes": 2.5, "seed": 0, "locations": 6}
HELD_OUT = {"recordings": 9, "minutes": 2.0, "seed": 48_271}
"""Traffic of other seeds, so of other places; no predictor sees it before it is judged."""
SCENARIOS = 48
RECIPE = "ours"
PLAN = {
    "site": SITE,
    "training": TRAINING,
    "held_out": HELD_OUT,
    "predictor": PREDICTOR,
    "preset": RECIPE,
    "asp-env": metadata.version("asp-env"),
}
"""What a demo's folder is made by; kept in it, so that another demo's remains are not taken up."""

LEAD = (
    "Traffic was made, a predictor was trained on it, judged on recordings of places that it has "
    "never seen, and put before a planner there. The logged driver stands first: its scores are "
    "the noise floor."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Demo:
    """Show the main job: make traffic, train, evaluate open loop, drive, write the report.

    What an interrupted demo has finished is kept, and the next one goes on from there.
    """

    out: Path = Path("demo")
    """Folder to write, the report and all it is made from."""

    def run(self) -> None:
        """Runs every step that is not done yet, then writes the results anew."""
        check_report_possible()
        console = Console()
        _claim(self.out)
        training, held_out = self.out / "traffic", self.out / "held-out"
        for folder, what in ((training, TRAINING), (held_out, HELD_OUT)):
            if not folder.exists():
                console.rule(f"making traffic: {folder}")
                _command("synthesize", out=folder, site=SITE, **what)
        run = self.out / PREDICTOR
        if not (run / "config.json").exists():
            console.rule(f"training {PREDICTOR}")
            _command("train", predictor=PREDICTOR, data=str(training), out=run, recipe=RECIPE)
        console.rule("judging forecasts and driving")
        trained = f"{PREDICTOR}:{run}"
        opened = evaluate(
            Evaluate(
                data=str(held_out),
                out=self.out,
                predictors=("constant-velocity", "constant-turn-rate", trained),
            )
        )
        closed = drive(
            Drive(
                data=str(held_out),
                out=self.out,
                predictors=("oracle", "constant-velocity", trained),
                max_scenarios=SCENARIOS,
            )
        )
        with _replacing(self.out) as folder:
            write_metrics(folder, [*opened.rows, *closed.rows])
            privileged = sorted({*opened.manifest["privileged"], *closed.manifest["privileged"]})
            write_manifest(
                folder,
                "demo",
                plan=PLAN,
                privileged=privileged,
                open_loop=opened.manifest,
                closed_loop=closed.manifest,
            )
            save_rollouts(folder, closed)
            write_report(
                folder,
                title="Does the predictor make the car drive better?",
                lead=LEAD,
                maps=closed.maps,
                examples=opened.examples,
            )
        for table in (
            *open_loop_tables(opened.rows, opened.manifest["privileged"]),
            driving_table(closed.rows, closed.manifest["privileged"], RULES[DEFAULT_RULES].shown),
        ):
            console.print(table)
        console.print(f"wrote {self.out / 'report.html'}")


def _command(name: str, **options: Any) -> None:
    """Another package's command, with its options by field name."""
    registry.find("commands", name)(**options).run()


def _claim(out: Path) -> None:
    """Makes the folder this demo's own, or finds that it is already."""
    path = out / "plan.json"
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        try:
            same = json.loads(path.read_text()) == PLAN
        except (OSError, ValueError):
            same = False
        if not same:
            raise AspEnvError(
                f"{out}: holds no demo that this version began; choose another --out or remove it"
            )
        return
    out.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(PLAN, indent=2) + "\n")


@contextmanager
def _replacing(out: Path) -> Iterator[Path]:
    """A folder whose content takes the place of what `out` holds under the same names."""
    fresh = out / "fresh"
    shutil.rmtree(fresh, ignore_errors=True)
    with atomic_folder(fresh) as folder:
        yield folder
    for made in fresh.iterdir():
        old = out / made.name
        shutil.rmtree(old) if old.is_dir() else old.unlink(missing_ok=True)
        made.rename(old)
    fresh.rmdir()

"""`asp-env demo`: the main job on embedded data, from traffic to report."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from asp_env import registry
from asp_env.evaluation.closed_loop import Drive, drive, save_rollouts
from asp_env.evaluation.open_loop import Evaluate, evaluate
from asp_env.evaluation.output import output_folder, write_manifest, write_metrics
from asp_env.evaluation.report import check_report_possible, write_report
from asp_env.evaluation.tables import driving_table, open_loop_tables

SITE = "intersection"
PREDICTOR = "ffw-asp"
TRAINING = {"recordings": 30, "minutes": 2.5, "seed": 0, "locations": 6}
HELD_OUT = {"recordings": 9, "minutes": 2.0, "seed": 1_000}
"""Traffic of other seeds, so of other places; no predictor sees it before it is judged."""
SCENARIOS = 48

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
    """Folder to write; the report is in its folder `results`."""

    def run(self) -> None:
        """Runs every step that is not done yet, then writes the results anew."""
        check_report_possible()
        console = Console()
        training, held_out = self.out / "traffic", self.out / "held-out"
        for folder, what in ((training, TRAINING), (held_out, HELD_OUT)):
            if not folder.exists():
                console.rule(f"making traffic: {folder}")
                _command("synthesize", out=folder, site=SITE, **what)
        run = self.out / PREDICTOR
        if not (run / "config.json").exists():
            console.rule(f"training {PREDICTOR}")
            _command("train", predictor=PREDICTOR, data=str(training), out=run, preset="cpu")
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
                scenarios=SCENARIOS,
            )
        )
        results = self.out / "results"
        shutil.rmtree(results, ignore_errors=True)
        with output_folder(results) as folder:
            write_metrics(folder, [*opened.rows, *closed.rows])
            write_manifest(folder, "demo", open_loop=opened.manifest, closed_loop=closed.manifest)
            save_rollouts(folder, closed)
            write_report(
                folder,
                title="Does the predictor make the car drive better?",
                lead=LEAD,
                maps=closed.maps,
                examples=opened.examples,
            )
        for table in (*open_loop_tables(opened.rows), driving_table(closed.rows)):
            console.print(table)
        console.print(f"wrote {results / 'report.html'}")


def _command(name: str, **options: Any) -> None:
    """Another package's command, with its options by field name."""
    registry.find("commands", name)(**options).run()

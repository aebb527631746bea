"""What the worker process of one cell does: train a predictor, then compute its errors."""

import dataclasses
import hashlib
import json
import sys
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from asp_env.console import printable
from asp_env.data import cache
from asp_env.data.histories import History, histories
from asp_env.data.predictor import load_predictor
from asp_env.data.recording import DEFAULT_DT_S, ticks
from asp_env.data.source import open_readable
from asp_env.errors import AspEnvError
from predictors.experiments.errors import compute_errors, snippets_to_evaluate, stamp_of
from predictors.training.command import Train

FINISHED = "config.json"
"""Every finished run contains this file."""

WEIGHTS = "weights.safetensors"


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationJob:
    """The data that a predictor is evaluated on, and the file of its errors."""

    predictor: str
    """Name of the predictor without its run."""
    run: str
    """Folder of its run; empty for a predictor without training."""
    data: str
    part: Literal["test", "all"]
    """Part of the data."""
    horizon_s: float
    history: History = "recorded"
    """Histories that a predictor without training observes; trained ones observe what they were
    trained on."""
    per_recording: int | None = None
    """Largest number of snippets of each recording; None for all."""
    errors: str
    """Path of the errors without its suffix."""
    data_hash: str
    """Hash of the content of the data."""
    parked: bool = False
    """Whether parked vehicles are targets, too."""
    chainings: tuple[str, ...] = ()
    """Rules for chaining segments that are evaluated besides the predictor's own, if it chains."""

    @property
    def stamp(self) -> str:
        """Hash of everything that the errors depend on, including the finished run."""
        fields = dataclasses.asdict(self)
        content = {k: v for k, v in fields.items() if k not in ("data", "run", "errors")}
        if not self.parked:  # as in the stamps of versions without this option
            del content["parked"]
        text = json.dumps(content, sort_keys=True).encode()
        if self.run:
            text += (Path(self.run) / FINISHED).read_bytes()
        return hashlib.sha256(text).hexdigest()

    @property
    def done(self) -> bool:
        """Whether the file of the errors exists and has the current stamp."""
        if self.run and not (Path(self.run) / FINISHED).exists():
            return False
        return stamp_of(errors_path(self.errors)) == self.stamp

    def execute(self) -> None:
        """Computes the errors and writes their files.

        The file of the predictor's own chaining is the last, so its stamp marks the job as done.

        Raises:
            AspEnvError: the predictor cannot be loaded, or there is nothing to evaluate on.
        """
        name = f"{self.predictor}:{self.run}" if self.run else self.predictor
        dt_s = DEFAULT_DT_S
        horizon = ticks(self.horizon_s, dt_s)
        own = load_predictor(name, horizon=horizon, dt_s=dt_s)
        predictors = {"": own}
        if "chaining" in own.metadata:
            for chaining in self.chainings:
                other = load_predictor(f"{name}@{chaining}", horizon=horizon, dt_s=dt_s)
                predictors[chaining] = other
        recordings = open_readable(self.data, dt_s=dt_s)
        index = snippets_to_evaluate(
            recordings,
            horizon_s=self.horizon_s,
            dt_s=dt_s,
            part=self.part,
            per_recording=self.per_recording,
            parked=self.parked,
        )
        history: Any = own.metadata.get("history", self.history)
        scenes = histories(recordings, history)
        errors = compute_errors(
            predictors, index, scenes=scenes, recorded=recordings, stamp=self.stamp
        )
        for chaining in reversed(errors):
            errors[chaining].save(errors_path(self.errors, chaining))


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """The work of one cell; what is done already is skipped."""

    train: dict[str, Any] | None
    """Options of the command `train`, as strings and numbers; None without training."""
    evaluation: EvaluationJob | None
    """None for a run that only other runs start from."""
    recipe: dict[str, Any] | None = None
    """Configuration that the run must have."""
    defaults: dict[str, Any] | None = None
    """Defaults of the recipe's fields, for runs that are older than some fields."""

    def check(self) -> None:
        """Checks that a finished run is of the current recipe and started from current weights.

        Raises:
            AspEnvError: it is not.
        """
        if self.train is None or self.recipe is None or not self.trained:
            return
        out = Path(self.train["out"])
        provenance = json.loads((out / FINISHED).read_text())["provenance"]
        config = _with_defaults(provenance["config"], self.defaults or {})
        if names := _different_fields(config, self.recipe):
            raise AspEnvError(
                f"{out} was trained with other {', '.join(names)} than the recipe has now: "
                "delete it to train it again, or choose another --out"
            )
        start = self.train.get("start")
        if start is None and provenance.get("start") is not None:
            raise AspEnvError(
                f"{out} started from another run, but the recipe now trains from scratch: delete "
                "it to train it again, or choose another --out"
            )
        if start is None or not (Path(start) / FINISHED).exists():
            return
        if provenance.get("start") != cache.digest(Path(start) / WEIGHTS):
            raise AspEnvError(
                f"{out} started from other weights than {start} has now: delete it to train it "
                "again, or choose another --out"
            )

    @property
    def trained(self) -> bool:
        """Whether the run is finished, or there is none."""
        return self.train is None or (Path(self.train["out"]) / FINISHED).exists()

    @property
    def done(self) -> bool:
        """Whether the run is finished and its errors are computed."""
        return self.trained and (self.evaluation is None or self.evaluation.done)

    def execute(self) -> float:
        """Trains and computes the errors.

        Returns:
            CPU time of the training in seconds, with the opening of the data.

        Raises:
            AspEnvError: the run or the data are bad.
        """
        self.check()
        start_s = trained_s = time.process_time()
        if self.train is not None and not self.trained:
            options = dict(self.train)
            for name in ("data", "validation"):
                options[name] = () if options.get(name) is None else (options[name],)
            for name in ("out", "costs"):
                options[name] = None if options.get(name) is None else Path(options[name])
            Train(**options).run()
            trained_s = time.process_time()
        elif self.train is not None:
            from predictors.training.fitting import remove_state

            remove_state(Path(self.train["out"]))
        if self.evaluation is not None and not self.evaluation.done:
            self.evaluation.execute()
        return trained_s - start_s


def run_job(job: Job) -> float:
    """Executes a job in a worker process; the last line of its output states an error.

    Returns:
        CPU time of the training in seconds.

    Raises:
        AspEnvError: the run or the data are bad.
    """
    try:
        return job.execute()
    except AspEnvError as error:
        sys.stdout.flush()
        sys.stderr.write(f"asp-env: {printable(' '.join(str(error).split()))}\n")
        raise
    except Exception:
        sys.stdout.flush()
        traceback.print_exc()
        raise


def errors_path(stem: str, chaining: str = "") -> Path:
    """File of the errors of a cell.

    Args:
        stem: path without suffix.
        chaining: way of chaining segments; empty for the predictor's own.
    """
    return Path(f"{stem}@{chaining}.npz" if chaining else f"{stem}.npz")


def _with_defaults(config: dict[str, Any], defaults: dict[str, Any]) -> dict[str, Any]:
    """A configuration with the defaults of the fields that it lacks."""
    whole = defaults | config
    for name, value in defaults.items():
        if isinstance(value, dict) and isinstance(whole[name], dict):
            whole[name] = _with_defaults(whole[name], value)
    return whole


def _different_fields(config: dict[str, Any], expected: dict[str, Any]) -> list[str]:
    """Names of the common fields that differ, except the source of the validation data."""
    names = []
    for name in sorted((set(config) & set(expected)) - {"validation"}):
        if isinstance(expected[name], dict) and isinstance(config[name], dict):
            names += _different_fields(config[name], expected[name])
        elif config[name] != expected[name]:
            names.append(name)
    return names

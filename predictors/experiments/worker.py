"""One cell in a process of its own: `python -m predictors.experiments.worker JOB`.

JOB is JSON. The process never outlives the command that started it, so that two never train the
same run.
"""

import dataclasses
import hashlib
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from asp_env import registry
from asp_env.data import cache
from asp_env.data.causal import causal_histories
from asp_env.data.predictor import load_predictor
from asp_env.data.recording import DEFAULT_DT_S, ticks
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError
from asp_env.workers import end_with_starter
from predictors.experiments.errors import judge_snippets, snippets_to_judge, stamp_of

FINISHED = "config.json"
"""A run that has it is finished."""

WEIGHTS = "weights.safetensors"

FAILED = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Judging:
    """What a predictor is judged on, and where its errors go."""

    predictor: str
    """The name that it is loaded by, less its run."""
    run: str
    """Its run; empty for one that learns nothing."""
    data: str
    part: Literal["test", "all"]
    horizon_s: float
    history: Literal["recorded", "causal"] = "recorded"
    """For one that learns nothing; the others have what they were trained on."""
    per_recording: int | None = None
    errors: str
    """Path of its errors, less the suffix."""
    data_hash: str
    chainings: tuple[str, ...] = ()
    """Ways to chain segments that are judged besides its own, if it chains any."""

    @property
    def stamp(self) -> str:
        """A hash of everything that decides the errors, the finished run included."""
        fields = dataclasses.asdict(self)
        content = {k: v for k, v in fields.items() if k not in ("data", "run", "errors")}
        text = json.dumps(content, sort_keys=True).encode()
        if self.run:
            text += (Path(self.run) / FINISHED).read_bytes()
        return hashlib.sha256(text).hexdigest()

    @property
    def done(self) -> bool:
        """Whether the errors are there already."""
        if self.run and not (Path(self.run) / FINISHED).exists():
            return False
        return stamp_of(errors_path(self.errors)) == self.stamp


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """What one process does: train, if need be, then judge."""

    train: dict[str, Any] | None
    """Options of the command `train` that are no paths, and `out` and `start`."""
    judging: Judging | None
    """None for a run that others start from, and nobody asked for."""
    recipe: dict[str, Any] | None = None
    """What the run's configuration must be."""
    defaults: dict[str, Any] | None = None
    """Of the recipe's fields, for a run that is older than some of them."""

    def check(self) -> None:
        """Looks whether a finished run is the one that was asked for.

        Raises:
            AspEnvError: it was trained by another recipe, or from other weights.
        """
        if self.train is None or self.recipe is None or not self.trained:
            return
        out = Path(self.train["out"])
        provenance = json.loads((out / FINISHED).read_text())["provenance"]
        found = _completed(provenance["config"], self.defaults or {})
        if other := _unlike(found, self.recipe):
            raise AspEnvError(
                f"{out} was trained with other {', '.join(other)} than the recipe has now: "
                "delete it to train it again, or choose another --out"
            )
        start = self.train.get("start")
        if start is None and provenance.get("start") is not None:
            raise AspEnvError(
                f"{out} went on from another run, the recipe now learns from the start: delete it "
                "to train it again, or choose another --out"
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
        """Whether there is nothing to train."""
        return self.train is None or (Path(self.train["out"]) / FINISHED).exists()

    @property
    def done(self) -> bool:
        """Whether there is nothing to do."""
        return self.trained and (self.judging is None or self.judging.done)

    def dump(self) -> str:
        """As JSON."""
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def load(cls, text: str) -> "Job":
        """From what `dump` gave."""
        fields = json.loads(text)
        judging = fields["judging"]
        if judging is not None:
            judging = Judging(**judging | {"chainings": tuple(judging["chainings"])})
        return cls(**fields | {"judging": judging})

    def run(self) -> None:
        """Does what is not done yet.

        Raises:
            AspEnvError: the run or the data are bad.
        """
        self.check()
        if self.train is not None and not self.trained:
            paths = {
                name: Path(self.train[name])
                for name in ("out", "start")
                if self.train.get(name) is not None
            }
            registry.find("commands", "train")(**self.train | paths).run()
        if self.judging is not None and not self.judging.done:
            judge(self.judging)


def _completed(found: dict[str, Any], defaults: dict[str, Any]) -> dict[str, Any]:
    """A configuration with the defaults of what it does not know."""
    whole = defaults | found
    for name, value in defaults.items():
        if isinstance(value, dict) and isinstance(whole[name], dict):
            whole[name] = _completed(whole[name], value)
    return whole


def _unlike(found: dict[str, Any], expected: dict[str, Any]) -> list[str]:
    """Fields that both have and that differ; not where the data were read from."""
    names = []
    for name in sorted((set(found) & set(expected)) - {"validation"}):
        if isinstance(expected[name], dict) and isinstance(found[name], dict):
            names += _unlike(found[name], expected[name])
        elif found[name] != expected[name]:
            names.append(name)
    return names


def errors_path(stem: str, chaining: str = "") -> Path:
    """Where the errors of a cell lie, under a way to chain that is not its own."""
    return Path(f"{stem}@{chaining}.npz" if chaining else f"{stem}.npz")


def judge(judging: Judging) -> None:
    """Judges a predictor and keeps its errors; those of its own chaining last, as a seal.

    Raises:
        AspEnvError: it cannot be loaded, or there is nothing to judge on.
    """
    name = f"{judging.predictor}:{judging.run}" if judging.run else judging.predictor
    dt_s = DEFAULT_DT_S
    horizon = ticks(judging.horizon_s, dt_s)
    own = load_predictor(name, horizon=horizon, dt_s=dt_s)
    predictors = {"": own}
    if "chaining" in own.metadata:
        for chaining in judging.chainings:
            other = load_predictor(f"{name}@{chaining}", horizon=horizon, dt_s=dt_s)
            predictors[chaining] = other
    recordings = open_data(judging.data)
    index = snippets_to_judge(
        recordings,
        horizon_s=judging.horizon_s,
        dt_s=dt_s,
        part=judging.part,
        per_recording=judging.per_recording,
    )
    causal = own.metadata.get("history", judging.history) == "causal"
    scenes = causal_histories(recordings) if causal else recordings
    found = judge_snippets(
        predictors, index, scenes=scenes, recorded=recordings, stamp=judging.stamp
    )
    for chaining in reversed(found):
        found[chaining].save(errors_path(judging.errors, chaining))


def main(argv: Sequence[str]) -> int:
    """Runs a job; 2 with a line on stderr where the input is bad."""
    (text,) = argv
    end_with_starter()
    try:
        Job.load(text).run()
    except AspEnvError as error:
        sys.stderr.write(f"asp-env: {' '.join(str(error).split())}\n")
        return FAILED
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""The saved rollouts of a run folder: what each is of, and the command that reproduces it."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from asp_env.evaluation.results import Condition
from asp_env.evaluation.selection import short_names

OUT = "OUT"
"""Stands in commands for the folder of the page, which the page itself fills in."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Episode:
    """A saved rollout, and what the page states about it."""

    path: Path
    label: str
    """Name of its method, with the training run."""
    planner: str = ""
    predictor: str = ""
    """The predictor as in `metrics.csv`; empty if the planner uses no forecasts."""
    condition: Condition | None = None
    """The condition that it was driven in, if it is known."""
    command: str = ""
    """A shell command that drives it again; `OUT` stands for the run folder."""


def find_episodes(out: Path, manifest: Mapping[str, Any]) -> list[Episode]:
    """The rollouts below `rollouts/` in the order of their paths.

    The name of the folder of a rollout is the label of its method. Commands and conditions are
    known of methods that the manifest of `drive`, `benchmark` or `demo` describes.

    Args:
        out: The run folder.
        manifest: Its manifest.
    """
    folder = out / "rollouts"
    methods = {label: each for drive in _drives(manifest) for label, each in _methods(drive)}
    episodes = []
    for path in sorted(folder.rglob("*.npz")):
        group = path.parent.relative_to(folder).as_posix()
        label = "" if group == "." else group
        method = methods.get(label)
        if method is None:
            episodes.append(Episode(path=path, label=label))
        else:
            episodes.append(method.episode(path, label))
    return episodes


@dataclass(frozen=True, slots=True, kw_only=True)
class _Method:
    """A method of a drive, with the manifest of the drive."""

    planner: str
    predictor: str
    run: str
    drive: Mapping[str, Any]

    def episode(self, path: Path, label: str) -> Episode:
        drive = self.drive
        words = ["asp-env", "drive", drive.get("data", ""), "--planner", drive["planner"]]
        words += ["--predictors", self.run] if self.run else []
        words += ["--scenarios", f"{OUT}/scenarios.json#{path.stem}", "--part", "all"]
        rules = drive.get("metrics")
        options = {
            "traffic": drive.get("traffic"),
            "rules": rules.get("preset") if isinstance(rules, Mapping) else None,
            "horizon": drive.get("horizon_s"),
            "dt": drive.get("dt_s"),
        }
        for name, value in options.items():
            words += [f"--{name}", str(value)] if value is not None else []
        words += ["--out", "episode"]
        return Episode(
            path=path,
            label=label,
            planner=self.planner,
            predictor=self.predictor,
            condition=Condition(
                data=str(drive.get("data", "")),
                traffic=str(drive.get("traffic") or ""),
                latency_ticks=int(drive.get("latency_ticks") or 0),
            ),
            command=shlex.join(map(str, words)),
        )


def _drives(manifest: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The manifests of `drive` that a manifest is or contains."""
    drives = manifest.get("drives")
    inside = [*drives.values()] if isinstance(drives, Mapping) else []
    every = [manifest, manifest.get("closed_loop"), *inside]
    return [
        each
        for each in every
        if isinstance(each, Mapping) and isinstance(each.get("predictors"), Mapping)
        and "planner" in each
    ]  # fmt: skip


def _methods(drive: Mapping[str, Any]) -> list[tuple[str, _Method]]:
    """The methods of a drive by their labels."""
    planner, runs = str(drive["planner"]), [*drive["predictors"]]
    patterns = drive.get("runs")
    groups: dict[str, Sequence[str]] = {**patterns} if isinstance(patterns, Mapping) else {}
    given: dict[str, str] = {run: name for name, each in groups.items() for run in each}
    short = short_names(runs)
    first = runs[0] if runs else ""
    found = [
        ("expert", _Method(planner="expert", predictor="", run=first, drive=drive)),
        (planner, _Method(planner=planner, predictor="", run="", drive=drive)),
    ]
    found += [
        (
            f"{planner} + {short[run]}",
            _Method(planner=planner, predictor=given.get(run) or run, run=run, drive=drive),
        )
        for run in runs
    ]
    return found

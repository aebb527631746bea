"""Predictors against what was recorded: every metric of every snippet, a batch at a time."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Bool, Float, Int
from rich.progress import track

from asp_env.data.classes import AgentClass
from asp_env.data.forecast import Forecast
from asp_env.data.predictor import Predictor
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future, SnippetIndex, gather_scene
from asp_env.errors import AspEnvError
from asp_env.evaluation.earlier import Earlier
from asp_env.evaluation.forecast_errors import Said, forecast_errors, keeps_to_road
from asp_env.evaluation.recorded import Recorded, gather_recorded
from asp_env.metrics.calibration import nearest_modes
from asp_env.metrics.manoeuvres import Manoeuvre, manoeuvres
from asp_env.metrics.masked import Masked
from asp_env.metrics.mode_choice import ModeRule
from asp_env.metrics.open_loop import inconsistency

BATCH = 256
"""Snippets whose scenes are held at once."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """One metric of one predictor on every snippet."""

    name: str
    selection: str
    metric: str
    values: Float[np.ndarray, " n"]
    valid: Bool[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeProbabilities:
    """What one predictor of several modes said of each, and which came nearest."""

    name: str
    probabilities: Float[np.ndarray, "n m"]
    nearest: Float[np.ndarray, "n m"]
    valid: Bool[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """All that was found out about N snippets; averages and intervals are made of it."""

    judged: list[Judged]
    modes: list[ModeProbabilities]
    subsets: dict[str, Bool[np.ndarray, " n"]]
    """By name; `all` has everybody, `moving` and `standing` part them, and so do `manoeuvre:…`
    and `class:…`."""
    recording: Int[np.ndarray, " n"]
    """Whom each snippet is from: what is resampled."""

    def of(self, name: str, metric: str, selection: str) -> Judged:
        """One metric of one predictor.

        Raises:
            AspEnvError: there is none.
        """
        for each in self.judged:
            if (each.name, each.metric, each.selection) == (name, metric, selection):
                return each
        raise AspEnvError(f"{name}: no metric {metric!r} of {selection or 'all modes'} was judged")


def judge(
    predictors: Mapping[str, Predictor],
    index: SnippetIndex,
    *,
    scenes: Sequence[Any],
    recorded: Sequence[Any],
    best_by: ModeRule = "fde",
) -> Judgement:
    """Runs every predictor on every snippet.

    Args:
        predictors: by the name that results carry.
        index: the snippets, which must have their full past and future.
        scenes: the recordings that scenes are made of, as predictors see them.
        recorded: the same recordings as they were recorded: what is true, subsets included.
        best_by: how the best mode is chosen.

    Raises:
        AspEnvError: a predictor leaves targets out, or forecasts less than the horizon.
    """
    count = len(index)
    columns = _Columns(count)
    modes: dict[str, ModeProbabilities] = {}
    earlier = Earlier(index)
    kinds = _Kinds(count)
    for rows, scene, truth in batches(scenes, recorded, index, "evaluating"):
        kinds.put(rows, truth)
        on_road = keeps_to_road(truth)
        for name, predictor in predictors.items():
            forecast = ask(predictor, scene, truth.future, index.horizon)
            states = forecast.states[:, :, : index.horizon]
            said = Said(states=states, log_probs=forecast.log_probs, now=scene.target_states)
            columns.put(name, rows, forecast_errors(said, truth, best_by, on_road, dt_s=index.dt_s))
            columns.put(name, rows, _against_earlier(earlier, name, rows, said))
            if said.log_probs.shape[1] > 1:
                _keep_modes(modes, name, count, rows, said, truth)
    return Judgement(
        judged=columns.judged(),
        modes=list(modes.values()),
        subsets=kinds.subsets(),
        recording=index.recording,
    )


def batches(
    scenes: Sequence[Any], recorded: Sequence[Any], index: SnippetIndex, description: str
) -> Iterator[tuple[slice, Scene, Recorded]]:
    """Scenes of the snippets and what was recorded of them, some at a time, with a progress bar.

    Args:
        scenes: the recordings that scenes are made of.
        recorded: as many recordings, of the same tracks, that hold what happened.
        index: the snippets.
        description: stands before the bar.
    """
    for start in track(range(0, len(index), BATCH), description=description, transient=True):
        rows = slice(start, min(start + BATCH, len(index)))
        some = index.select(np.arange(rows.start, rows.stop))
        yield rows, gather_scene(scenes, some), gather_recorded(recorded, some)


def ask(predictor: Predictor, scene: Scene, future: Future, horizon: int) -> Forecast:
    """The forecast; only privileged predictors are handed the future.

    Raises:
        AspEnvError: a target is left out, so that tables would compare different targets, or the
            forecast is too short.
    """
    forecast = predictor.predict(scene, future if predictor.privileged else None)
    if not forecast.valid.all():
        raise AspEnvError(f"{predictor.name} leaves out targets with a full history")
    if forecast.states.shape[2] < horizon:
        raise AspEnvError(f"{predictor.name} forecasts less than {horizon} ticks")
    return forecast


def _against_earlier(
    earlier: Earlier, name: str, rows: slice, said: Said
) -> dict[tuple[str, str], Masked]:
    sure = said.states[np.arange(len(said.now)), said.log_probs.argmax(axis=1), :, :2]
    before, paired = earlier.exchange(name, rows, sure)
    value = inconsistency(before, sure, paired, apart=earlier.apart)
    return {("most-probable", "inconsistency"): value}


def _keep_modes(
    modes: dict[str, ModeProbabilities],
    name: str,
    count: int,
    rows: slice,
    said: Said,
    truth: Recorded,
) -> None:
    shape = (count, said.log_probs.shape[1])
    kept = modes.get(name) or ModeProbabilities(
        name=name,
        probabilities=np.zeros(shape, dtype=np.float32),
        nearest=np.zeros(shape, dtype=np.float32),
        valid=np.zeros(count, dtype=bool),
    )
    future = truth.future
    kept.probabilities[rows] = np.exp(said.log_probs)
    kept.nearest[rows] = nearest_modes(said.states[:, :, -1, :2], future.states[:, -1, :2])
    kept.valid[rows] = future.valid[:, -1]
    modes[name] = kept


@final
class _Columns:
    """Values of every snippet, filled in by batches."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._columns: dict[tuple[str, str, str], Judged] = {}

    def put(self, name: str, rows: slice, errors: Mapping[tuple[str, str], Masked]) -> None:
        """Keeps some rows of one predictor's metrics."""
        for (selection, metric), error in errors.items():
            key = (name, selection, metric)
            if key not in self._columns:
                self._columns[key] = Judged(
                    name=name,
                    selection=selection,
                    metric=metric,
                    values=np.zeros(self._count, dtype=np.float32),
                    valid=np.zeros(self._count, dtype=bool),
                )
            self._columns[key].values[rows] = np.where(error.valid, error.value, 0)
            self._columns[key].valid[rows] = error.valid

    def judged(self) -> list[Judged]:
        """All columns, in the order in which they first came."""
        return list(self._columns.values())


@final
class _Kinds:
    """What kind of target each snippet has, by what was recorded."""

    def __init__(self, count: int) -> None:
        self._manoeuvre = np.zeros(count, dtype=np.int8)
        self._class = np.zeros(count, dtype=np.int8)

    def put(self, rows: slice, truth: Recorded) -> None:
        """Keeps some rows."""
        self._manoeuvre[rows] = manoeuvres(truth.states, truth.valid, now=truth.now)
        self._class[rows] = truth.classes

    def subsets(self) -> dict[str, Bool[np.ndarray, " n"]]:
        """Those that every table has, then manoeuvres and classes that somebody is of."""
        standing = self._manoeuvre == Manoeuvre.STANDING
        found = {"all": np.ones(len(standing), dtype=bool), "moving": ~standing}
        found["standing"] = standing
        for prefix, kinds, of in (
            ("manoeuvre", Manoeuvre, self._manoeuvre),
            ("class", AgentClass, self._class),
        ):
            for kind in kinds:
                if (of == kind).any():
                    found[f"{prefix}:{kind.name.lower()}"] = of == kind
        return found

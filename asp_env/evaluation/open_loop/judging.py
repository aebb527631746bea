"""What was recorded around snippets: all that forecasts are judged by.

MERGED: What predictors said of the same targets before: forecasts of consecutive snippets.
MERGED: All open-loop metrics of one batch of forecasts.
MERGED: Predictors against what was recorded: every metric of every snippet, a batch at a time.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Bool, Float, Int
from rich.progress import track

from asp_env.data.classes import AgentClass
from asp_env.data.predictor import Forecast, Predictor
from asp_env.data.recording import Recording, frames_per_tick, ticks
from asp_env.data.road_map import RoadMap
from asp_env.data.scene import Scene
from asp_env.data.snippets import (
    SNIPPET_INTERVAL_S,
    Future,
    SnippetIndex,
    gather_scene,
    gather_ticks,
    gather_window,
)
from asp_env.errors import AspEnvError
from asp_env.metrics.forecast.calibration import brier, mixture_nll, nearest_modes
from asp_env.metrics.forecast.errors import (
    SELECTIONS,
    Manoeuvre,
    ModeRule,
    errors_over_time,
    inconsistency,
    manoeuvres,
    open_loop_errors,
    select_mode,
)
from asp_env.metrics.forecast.feasibility import (
    infeasible_modes,
    off_road_modes,
    overlapping_modes,
)
from asp_env.metrics.masked import Masked


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundTruth:
    """N targets before and after now, and everybody around them afterwards.

    Situations are the distinct ticks of the recordings that the targets are from.
    """

    states: Float[np.ndarray, "n ticks 4"]
    """Of the targets: past, present, future."""
    valid: Bool[np.ndarray, "n ticks"]
    now: int
    """The tick of the present."""
    sizes: Float[np.ndarray, "n 2"]
    classes: Int[np.ndarray, " n"]
    maps: tuple[RoadMap, ...]
    map_index: Int[np.ndarray, " n"]
    situation: Int[np.ndarray, " n"]
    slot: Int[np.ndarray, " n"]
    """The target's own, in its situation; -1 if it is not there after now."""
    others: Float[np.ndarray, "b a steps 4"]
    """Everybody's states after now, whenever they came into view."""
    others_valid: Bool[np.ndarray, "b a steps"]
    others_sizes: Float[np.ndarray, "b a 2"]

    @property
    def present(self) -> Float[np.ndarray, "n 4"]:
        """The targets' states now."""
        return self.states[:, self.now]

    @property
    def future(self) -> Future:
        """What the targets went on to do."""
        return Future(states=self.states[:, self.now + 1 :], valid=self.valid[:, self.now + 1 :])


def gather_ground_truth(recordings: Sequence[Any], index: SnippetIndex) -> GroundTruth:
    """What the recordings hold of some snippets, targets in the index's order."""
    keys = np.stack([index.recording, index.tick], axis=-1)
    found, inverse = np.unique(keys, axis=0, return_inverse=True)
    situation = inverse.reshape(-1)
    offsets = np.arange(-index.history, index.horizon_ticks + 1)
    states, valid = gather_ticks(recordings, index, offsets)
    sizes = np.zeros((len(index), 2), dtype=np.float32)
    classes = np.zeros(len(index), dtype=np.int64)
    slot = np.full(len(index), -1)
    map_index = np.zeros(len(index), dtype=np.int64)
    maps: list[RoadMap] = []
    around: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for number in np.unique(index.recording):
        recording = recordings[int(number)]
        mine = np.flatnonzero(index.recording == number)
        track = index.track[mine]
        sizes[mine], classes[mine] = recording.sizes[track], recording.classes[track]
        map_index[mine] = _place(maps, recording.road_map)
        for tick in found[found[:, 0] == number, 1]:
            tracks, others, there = _after(recording, int(tick), index)
            rows = mine[index.tick[mine] == tick]
            same = index.track[rows][:, None] == tracks
            slot[rows] = np.where(same.any(axis=1), same.argmax(axis=1), -1)
            around.append((recording.sizes[tracks], others, there))
    shape = (len(found), max((len(each[0]) for each in around), default=0))
    others_sizes = np.zeros((*shape, 2), dtype=np.float32)
    others = np.zeros((*shape, index.horizon_ticks, 4), dtype=np.float32)
    others_valid = np.zeros((*shape, index.horizon_ticks), dtype=bool)
    for number, each in enumerate(around):
        count = len(each[0])
        others_sizes[number, :count], others[number, :count], others_valid[number, :count] = each
    return GroundTruth(
        states=states,
        valid=valid,
        now=index.history,
        sizes=sizes,
        classes=classes,
        maps=tuple(maps),
        map_index=map_index,
        situation=situation,
        slot=slot,
        others=others,
        others_valid=others_valid,
        others_sizes=others_sizes,
    )


def _after(
    recording: Recording, tick: int, index: SnippetIndex
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(tracks, states, presence) of everybody seen after a tick."""
    stride = frames_per_tick(recording.frame_rate_hz, index.dt_s)
    tracks = recording.tracks_between((tick + 1) * stride, (tick + index.horizon_ticks) * stride)
    window = gather_window(
        recording, tracks, first_tick=tick + 1, num_ticks=index.horizon_ticks, stride=stride
    )
    return (tracks, *window)


def _place(maps: list[RoadMap], road_map: RoadMap) -> int:
    for number, known in enumerate(maps):
        if known is road_map:
            return number
    maps.append(road_map)
    return len(maps) - 1


@final
class ForecastHistory:
    """The most probable forecasts of earlier snippets, as far back as later ones need them.

    Attributes:
        apart: ticks between consecutive snippets of one target.
    """

    def __init__(self, index: SnippetIndex) -> None:
        """Finds, for every snippet, the one of the same track 0.6 s before."""
        self.apart = ticks(SNIPPET_INTERVAL_S, index.dt_s)
        count = len(index)
        order = np.lexsort((index.tick, index.track, index.recording))
        before, after = order[:-1], order[1:]
        follows = (index.recording[before] == index.recording[after]) & (before < after)
        follows &= index.track[before] == index.track[after]
        follows &= index.tick[before] + self.apart == index.tick[after]
        self._rows = np.full(count, -1)
        self._rows[after[follows]] = before[follows]
        needed = np.where(self._rows >= 0, self._rows, count)
        self._needed_from = np.append(np.minimum.accumulate(needed[::-1])[::-1], count)
        self._kept: dict[str, tuple[int, np.ndarray]] = {}

    def exchange(
        self, name: str, rows: slice, positions: Float[np.ndarray, "n t 2"]
    ) -> tuple[Float[np.ndarray, "n t 2"], Bool[np.ndarray, " n"]]:
        """Takes a predictor's forecasts of the next rows; gives those made before and where.

        Args:
            name: of the predictor.
            rows: the rows after those of its last call.
            positions: of the most probable modes.
        """
        first, kept = self._kept.get(name, (rows.start, positions[:0]))
        kept = np.concatenate([kept, positions])
        earlier = self._rows[rows]
        paired = earlier >= 0
        before = kept[np.where(paired, earlier - first, 0)]
        start = min(int(self._needed_from[rows.stop]), rows.stop)
        self._kept[name] = (start, kept[start - first :].copy())
        return before, paired


ALL_MODES = ""
"""The selection of metrics that speak of all modes together."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ForecastSample:
    """A forecast as it is judged: states cut to the horizon, and the state that it starts from."""

    states: Float[np.ndarray, "n m t 4"]
    log_probs: Float[np.ndarray, "n m"]
    now: Float[np.ndarray, "n 4"]


def forecast_errors(
    said: ForecastSample,
    truth: GroundTruth,
    best_by: ModeRule,
    on_road: Bool[np.ndarray, " n"],
    *,
    dt_s: float,
) -> dict[tuple[str, str], Masked]:
    """All metrics of a batch of forecasts, by (selection, metric).

    Args:
        said: the forecasts.
        truth: what was recorded.
        best_by: how the best mode is chosen.
        on_road: whom leaving the drivable area counts for: `keeps_to_road`.
        dt_s: the time step.
    """
    future, origin = truth.future, truth.present[:, None, :2]
    known = future.valid[:, -1]
    local = said.states[..., :2] - origin[:, None]
    true = future.states[..., :2] - origin
    nearest = nearest_modes(local[:, :, -1], true[:, -1])
    found = {
        (ALL_MODES, "NLL"): mixture_nll(local[:, :, -1], said.log_probs, true[:, -1], known),
        (ALL_MODES, "Brier"): brier(said.log_probs, nearest, known),
    }
    broken = _broken_rules(said, truth, on_road, dt_s=dt_s)
    for metric, (breaks, applies) in broken.items():
        found[ALL_MODES, metric] = Masked(value=breaks.mean(axis=1), valid=applies)
    for selection in SELECTIONS:
        shown = (local, said.log_probs, true, future.valid, selection, best_by)
        errors = open_loop_errors(*shown) | errors_over_time(*shown, dt_s=dt_s)
        found |= {(selection, metric): error for metric, error in errors.items()}
        chosen = select_mode(local, said.log_probs, true, selection, best_by)
        for metric, (breaks, applies) in broken.items():
            value = breaks[np.arange(len(breaks)), chosen].astype(np.float32)
            found[selection, metric] = Masked(value=value, valid=applies)
    return found


def _broken_rules(
    said: ForecastSample, truth: GroundTruth, on_road: Bool[np.ndarray, " n"], *, dt_s: float
) -> dict[str, tuple[Bool[np.ndarray, "n m"], Bool[np.ndarray, " n"]]]:
    """(which modes break it, which targets it applies to), by metric."""
    future = truth.future
    known = np.asarray(future.valid.all(axis=1))
    off_road, _ = off_road_modes(truth.maps, truth.map_index, said.states[..., :2])
    overlap = overlapping_modes(
        said.states,
        future.states,
        truth.sizes,
        situation=truth.situation,
        slot=truth.slot,
        others=truth.others,
        others_valid=truth.others_valid,
        others_sizes=truth.others_sizes,
    )
    infeasible = infeasible_modes(said.now, said.states, dt_s=dt_s)
    return {
        "off-road": (off_road, on_road),
        "overlap": (overlap, known),
        "infeasible": (infeasible, np.ones(len(known), dtype=bool)),
    }


def keeps_to_road(truth: GroundTruth) -> Bool[np.ndarray, " n"]:
    """Whether there is a drivable area, and the target keeps to it from now to the horizon's end.

    Who leaves it, as on the way to a parking place, cannot be forecast well and stay on it.
    """
    way = truth.states[:, None, truth.now :, :2]
    off, known = off_road_modes(truth.maps, truth.map_index, way)
    return known & ~off[:, 0] & truth.valid[:, truth.now :].all(axis=1)


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
    earlier = ForecastHistory(index)
    kinds = _Kinds(count)
    for rows, scene, truth in batches(scenes, recorded, index, "evaluating"):
        kinds.put(rows, truth)
        on_road = keeps_to_road(truth)
        for name, predictor in predictors.items():
            forecast = ask(predictor, scene, truth.future, index.horizon_ticks)
            states = forecast.states[:, :, : index.horizon_ticks]
            said = ForecastSample(
                states=states, log_probs=forecast.log_probs, now=scene.target_states
            )
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
) -> Iterator[tuple[slice, Scene, GroundTruth]]:
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
        yield rows, gather_scene(scenes, some), gather_ground_truth(recorded, some)


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
    earlier: ForecastHistory, name: str, rows: slice, said: ForecastSample
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
    said: ForecastSample,
    truth: GroundTruth,
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

    def put(self, rows: slice, truth: GroundTruth) -> None:
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

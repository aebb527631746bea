"""Forecasts as part of the observation: their options, when they are made, and how they are shown.

A `ForecastObserver` makes the forecasts of one predictor for B episodes, stores those that are
still to be shown, and writes the observation entries. `ReplayEpisodes` holds the observers of an
environment; the wrappers `PredictionFeatures` and `VectorPredictionFeatures` hold one of their own.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol, no_type_check, runtime_checkable

import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Float, Int

from asp_env.arguments import flag, positive_number, shown, text, whole_number
from asp_env.compiled import njit
from asp_env.data.predictor import (
    Predictor,
    continued,
    feature_size,
    fill_missing,
    load_predictor,
    needs_simulation,
    reads_past,
)
from asp_env.data.recording import ticks
from asp_env.data.scene import EGO, Scene
from asp_env.data.snippets import Future
from asp_env.errors import AspEnvError, unknown_name
from asp_env.sim.traffic.driver import Shared

MAX_POSITION_M = 100.0
"""Forecast positions are clipped to this distance along each axis of the ego's frame. Chosen by
hand."""

FORECAST_TIMES_S = (1.0, 2.0, 3.0)
"""Default times ahead of the forecast positions."""

MAX_FEATURE = 100.0
"""Features are clipped to this size. Chosen by hand: normalised features stay below 30."""

_PARTS_OF_PREDICTORS = ("name", "privileged", "dt_s", "horizon", "predict")

NO_AGENT = -1
"""Slot and id where there is no agent."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ForecastOptions:
    """Which forecasts the observation shows, and how old they are.

    With the period k = `every_ticks` and the latency n = `latency_ticks`, a predictor is called at
    the ticks 0, k, 2k, … of an episode, and a forecast is shown from n ticks after its scene on.
    Until the first forecast is n ticks old, it is shown earlier. The age of the forecast that is
    shown is thus at most n + k - 1 ticks. A forecast that is older than 0 ticks is moved along: its
    positions are those of the asked times ahead of now, in the present frame of the ego.
    """

    agents: int = 8
    """Number K of nearest agents."""
    modes: int = 3
    """Number M of most probable modes."""
    at_s: Sequence[float] = FORECAST_TIMES_S
    """Times ahead of the positions in seconds, whole ticks."""
    privileged: bool = False
    """Allows a predictor that uses the recorded future."""
    features: bool | Literal["latent"] = False
    """True adds the features of the predictor's network, which must be a trained one; `latent`
    shows them alone, without positions and probabilities."""
    every_ticks: int = 1
    """Period of the forecasts in ticks."""
    latency_ticks: int = 0
    """Ticks from the scene of a forecast until it is shown."""
    prefix: str = ""
    """Text before the names of the entries, with an underscore: `cv` gives `cv_forecast`."""

    def __post_init__(self) -> None:
        """Checks the options.

        Raises:
            AspEnvError: an option is of another type, or out of range.
        """
        counts = (
            ("agents", self.agents, 1),
            ("modes", self.modes, 1),
            ("every_ticks", self.every_ticks, 1),
            ("latency_ticks", self.latency_ticks, 0),
        )
        for name, count, least in counts:
            whole_number(name, count, least=least)
        is_sequence = isinstance(self.at_s, Sequence | np.ndarray) and not isinstance(
            self.at_s, str
        )
        if not is_sequence or not len(self.at_s):
            raise AspEnvError(f"at_s {shown(self.at_s)}: expected at least one time")
        for time_s in self.at_s:
            positive_number("at_s: time", time_s, "s")
        flag("privileged", self.privileged)
        if self.features != "latent" and not isinstance(self.features, bool):
            raise AspEnvError(f"features {shown(self.features)}: expected True, False or 'latent'")
        text("prefix", self.prefix)

    @property
    def max_age_ticks(self) -> int:
        """The largest age of a forecast that is shown, in ticks."""
        return self.latency_ticks + self.every_ticks - 1


NamedPredictor = str | Predictor | Shared[Predictor]
"""A predictor or its name; specifications of environments hold predictors by `Shared`."""

PredictorSpec = NamedPredictor | Mapping[str, NamedPredictor]
"""A predictor or its name, or several with the prefixes of their entries."""

ForecastSpec = ForecastOptions | Mapping[str, Any]
"""`ForecastOptions` or a mapping of its fields; for several predictors also a mapping from their
prefixes to either."""


class Present(NamedTuple):
    """The present tick of R episodes."""

    states: Float[np.ndarray, "r a 4"]
    """[x m, y m, heading rad, speed m/s]."""
    valid: Bool[np.ndarray, "r a"]
    ids: Int[np.ndarray, "r a"]
    elapsed: Int[np.ndarray, " r"]
    """Ticks since the start of the episode."""
    serials: Int[np.ndarray, " r"]
    """A number that no other episode of this environment has."""


@runtime_checkable
class ForecastSource(Protocol):
    """Episodes whose agents can be forecast."""

    @property
    def dt_s(self) -> float:
        """Length of a tick in seconds."""
        ...

    def __len__(self) -> int:
        """The number B of episodes."""
        ...

    def present(self, rows: Int[np.ndarray, " r"]) -> Present:
        """Returns the present tick of some episodes."""
        ...

    def scene(
        self,
        rows: Int[np.ndarray, " r"],
        targets: Int[np.ndarray, "t 2"],
        history: int | None = None,
    ) -> Scene:
        """Returns the scene of some episodes, in their order, with the targets in it.

        `history` is its number of past ticks, by default the usual one.
        """
        ...

    def recorded_future(self, scene: Scene, horizon: int, rows: Int[np.ndarray, " r"]) -> Future:
        """Returns the recorded future of the targets of such a scene."""
        ...


@dataclass(slots=True, kw_only=True)
class _Made:
    """The forecasts of B episodes that are or will be shown, in S places each.

    The forecast made at the tick s of an episode is in place (s // k) mod S.
    """

    serials: Int[np.ndarray, " b"]
    origin: Int[np.ndarray, " b"]
    """Elapsed ticks of each episode when it was first seen; 0 unless it was restored."""
    tick: Int[np.ndarray, "b s"]
    """Ticks since `origin` at which the forecast was made; -1 for none."""
    ids: Int[np.ndarray, "b s k"]
    """Ids of the agents, nearest first; `NO_AGENT` for none."""
    points: Float[np.ndarray, "b s k m steps 2"]
    """Positions in the recording's frame, m."""
    probabilities: Float[np.ndarray, "b s k m"]
    features: Float[np.ndarray, "b s k f"]
    num_modes: Int[np.ndarray, "b s"]
    """Number of modes that are shown."""

    def copy(self) -> "_Made":
        """Returns a deep copy."""
        names = [field.name for field in dataclasses.fields(self)]
        return _Made(**{name: getattr(self, name).copy() for name in names})


class ForecastObserver:
    """Makes the forecasts of a predictor and converts them to observation entries.

    | entry | space | content |
    |---|---|---|
    | `forecast` | `Box(±100, (K · M · times · 2,))` | positions in m, x ahead and y to the left, \
in the present frame of the ego |
    | `forecast_probabilities` | `Box(0, 1, (K · M,))` | probabilities of the modes, in descending \
order |
    | `forecast_valid` | `Box(0, 1, (K,))` | 1 where there is an agent |
    | `forecast_features` | `Box(±100, (K · F,))` | with `features`: what the predictor's network \
encodes of each agent, `Forecast.features` |
    | `forecast_age` | `Box(0, max, (K,))` | with a period above 1 tick or a latency: seconds \
since the scene of each agent's forecast |

    All entries are flat float32 arrays. The nearest agent comes first; entries without an agent or
    a mode are zero. Agents without a forecast get constant velocity, as for planners, and features
    of zero. So do agents that were not among the nearest ones in the scene of the forecast that is
    shown: their constant velocity is that of now, in one mode, with age 0. Names
    start with the prefix and, for a privileged predictor, before it with `oracle_`.

    Every episode depends on its own scenes only, not on which others are observed with it.
    """

    def __init__(self, predictor: NamedPredictor, options: ForecastOptions, dt_s: float) -> None:
        """Loads the predictor and defines the spaces.

        Args:
            predictor: a predictor or its name. The object is shared by copies of the observer.
            options: what to show.
            dt_s: length of a tick of the environment in seconds.

        Raises:
            AspEnvError: an option or the predictor is invalid.
        """
        self._options = options
        self._times_ticks = np.array([ticks(time_s, dt_s) for time_s in options.at_s])
        if options.features == "latent":  # No positions are shown: one tick is enough.
            self._times_ticks = np.ones(1, dtype=np.int64)
        wanted = int(self._times_ticks.max())
        horizon = wanted + options.max_age_ticks
        if isinstance(predictor, str):
            predictor = load_predictor(predictor, horizon=horizon, dt_s=dt_s)
        elif isinstance(predictor, Shared):
            predictor = predictor.value
        missing = [name for name in _PARTS_OF_PREDICTORS if not hasattr(predictor, name)]
        if missing:
            raise AspEnvError(
                f"predictor {shown(predictor)}: expected a name such as 'constant-velocity', or a "
                f"Predictor; it has no {', '.join(missing)}"
            )
        _check_predictor(predictor, wanted, dt_s, options)
        self._predictor = Shared(predictor)
        self._reads_past = reads_past(predictor)
        ages = np.arange(options.max_age_ticks + 1)
        self._stored = np.unique(self._times_ticks + ages[:, None])
        """Ticks ahead of its scene at which the positions of a forecast are stored."""
        self._places = np.searchsorted(self._stored, self._times_ticks + ages[:, None])
        """(ages, times) index of each asked time in `_stored`."""
        self._feature_size = feature_size(predictor) if options.features else 0
        if options.features and not self._feature_size:
            raise AspEnvError(
                f"predictor {predictor.name} has no features, only trained ones do: take one, such "
                f"as ssp-asp:pretrained, or omit features={options.features!r}"
            )
        self._num_slots = -(-options.latency_ticks // options.every_ticks) + 1
        self._made: _Made | None = None
        self.spaces = self._make_spaces(dt_s)

    @property
    def predictor(self) -> Predictor:
        """The predictor."""
        return self._predictor.value

    def observe(
        self, source: ForecastSource, rows: Int[np.ndarray, " r"]
    ) -> dict[str, Float[np.ndarray, "r size"]]:
        """Returns an array for each entry, with at most one call of the predictor.

        Args:
            source: the episodes, the same ones in every call.
            rows: numbers of the R episodes to observe.
        """
        options, present = self._options, source.present(rows)
        slots = nearest_slots(present.states, present.valid, present.ids, options.agents)
        made, since = self._make_due(source, rows, present, slots)
        every = options.every_ticks
        shown = np.maximum(since - options.latency_ticks, 0) // every * every
        age, place = since - shown, shown // every % self._num_slots
        return self._show(made, rows, present, slots, age, place, source.dt_s)

    def make(self, source: ForecastSource, rows: Int[np.ndarray, " r"]) -> None:
        """Makes the forecasts that are due now, for callers that step without observing.

        Args:
            source: the episodes, the same ones in every call.
            rows: numbers of the R episodes.
        """
        if self._options.max_age_ticks:
            present = source.present(rows)
            slots = nearest_slots(present.states, present.valid, present.ids, self._options.agents)
            self._make_due(source, rows, present, slots)

    def snapshot(self) -> Any:
        """Returns the forecasts that are or will be shown, for `restore`."""
        if self._made is None or not self._options.max_age_ticks:
            return None
        return self._made.copy()

    def restore(self, snapshot: Any, serials: Int[np.ndarray, " b"]) -> None:
        """Restores a snapshot.

        Args:
            snapshot: what `snapshot` returned.
            serials: the present serial numbers of the episodes.
        """
        self._made = None if snapshot is None else snapshot.copy()
        if self._made is not None:
            self._made.serials = serials.copy()

    def _make_due(
        self,
        source: ForecastSource,
        rows: Int[np.ndarray, " r"],
        present: Present,
        slots: Int[np.ndarray, "r k"],
    ) -> tuple[_Made, Int[np.ndarray, " r"]]:
        """Forecasts the episodes that are due; returns all forecasts and ticks since `origin`."""
        made = self._made
        if made is None or len(made.serials) != len(source):
            made = self._made = self._empty(len(source))
        begun = made.serials[rows] != present.serials
        if begun.any():
            fresh = rows[begun]
            made.serials[fresh], made.origin[fresh] = present.serials[begun], present.elapsed[begun]
            made.tick[fresh] = -1
        since = present.elapsed - made.origin[rows]
        every = self._options.every_ticks
        place = since // every % self._num_slots
        due = np.flatnonzero((since % every == 0) & (made.tick[rows, place] != since))
        if len(due):
            where = rows[due], place[due]
            made.tick[where] = since[due]
            self._forecast(source, where, slots[due], present.ids[due[:, None], slots[due]])
        return made, since

    def _forecast(
        self,
        source: ForecastSource,
        where: tuple[Int[np.ndarray, " r"], Int[np.ndarray, " r"]],
        slots: Int[np.ndarray, "r k"],
        ids: Int[np.ndarray, "r k"],
    ) -> None:
        """Makes and stores the forecasts of some agents in the places `where`."""
        made, rows = self._made, where[0]
        assert made is not None
        exists = slots >= 0
        made.ids[where] = np.where(exists, ids, NO_AGENT)
        situation, rank = np.nonzero(exists)
        if not len(situation):
            return
        targets = np.stack([situation, slots[exists]], axis=-1)
        predictor = self.predictor
        scene = source.scene(rows, targets, None if self._reads_past else 0)
        future = None
        if predictor.privileged:
            future = source.recorded_future(scene, predictor.horizon, rows)
        forecast = fill_missing(predictor.predict(scene, future), scene)
        states = forecast.states
        if states.shape[2] < self._stored[-1]:
            states = continued(states, int(self._stored[-1]), forecast.dt_s)
        modes = self._options.modes
        # A stable sort keeps the predictor's order of equally probable modes.
        order = np.argsort(-forecast.log_probs, axis=1, kind="stable")[:, :modes]
        made.num_modes[where] = order.shape[1]
        _store(
            (states, forecast.probabilities, order),
            (*where, situation, rank, self._stored - 1),
            (made.points, made.probabilities),
        )
        if self._feature_size:
            features = 0.0 if forecast.features is None else forecast.features
            made.features[rows[situation], where[1][situation], rank] = features

    def _show(
        self,
        made: _Made,
        rows: Int[np.ndarray, " r"],
        present: Present,
        slots: Int[np.ndarray, "r k"],
        age: Int[np.ndarray, " r"],
        place: Int[np.ndarray, " r"],
        dt_s: float,
    ) -> dict[str, Float[np.ndarray, "r size"]]:
        options, count = self._options, len(rows)
        agents, modes, times = options.agents, options.modes, len(self._times_ticks)
        ego = present.states[:, EGO]
        values = {
            "forecast": np.zeros((count, agents, modes, times, 2), dtype=np.float32),
            "forecast_probabilities": np.zeros((count, agents, modes), dtype=np.float32),
            "forecast_valid": np.zeros((count, agents), dtype=np.float32),
            "forecast_features": np.zeros((count, agents, self._feature_size), dtype=np.float32),
            "forecast_age": np.zeros((count, agents), dtype=np.float32),
        }
        _write(
            (made.ids, made.points, made.probabilities, made.features, made.num_modes),
            (rows, place, self._places[age], (age * dt_s).astype(np.float32)),
            (slots, present.ids, present.states, np.cos(ego[:, 2]), np.sin(ego[:, 2])),
            (self._times_ticks * dt_s).astype(np.float32),
            tuple(values.values()),
        )
        return {
            name: values[key].reshape(count, -1)
            for name, key in zip(self.spaces, self._keys(), strict=True)
        }

    def _keys(self) -> list[str]:
        """The entries that are shown, without prefixes."""
        options = self._options
        latent = options.features == "latent"
        keys = [] if latent else ["forecast", "forecast_probabilities"]
        keys.append("forecast_valid")
        if options.features:
            keys.append("forecast_features")
        if options.max_age_ticks:
            keys.append("forecast_age")
        return keys

    def _make_spaces(self, dt_s: float) -> dict[str, spaces.Box]:
        options = self._options
        agents, points = options.agents, options.modes * len(self._times_ticks) * 2
        bounds = {
            "forecast": (-MAX_POSITION_M, MAX_POSITION_M, agents * points),
            "forecast_probabilities": (0.0, 1.0, agents * options.modes),
            "forecast_valid": (0.0, 1.0, agents),
            "forecast_features": (-MAX_FEATURE, MAX_FEATURE, agents * self._feature_size),
            "forecast_age": (0.0, float(np.float32(options.max_age_ticks * dt_s)), agents),
        }
        start = "oracle_" if self.predictor.privileged else ""
        start += f"{options.prefix}_" if options.prefix else ""
        return {
            start + key: spaces.Box(bounds[key][0], bounds[key][1], (bounds[key][2],), np.float32)
            for key in self._keys()
        }

    def _empty(self, count: int) -> _Made:
        options = self._options
        shape = count, self._num_slots, options.agents
        return _Made(
            serials=np.full(count, -1),
            origin=np.zeros(count, dtype=np.int64),
            tick=np.full(shape[:2], -1),
            ids=np.full(shape, NO_AGENT),
            points=np.zeros((*shape, options.modes, len(self._stored), 2), dtype=np.float32),
            probabilities=np.zeros((*shape, options.modes), dtype=np.float32),
            features=np.zeros((*shape, self._feature_size), dtype=np.float32),
            num_modes=np.zeros(shape[:2], dtype=np.int64),
        )


def forecast_observers(
    predictor: PredictorSpec | None,
    forecast: ForecastSpec | None,
    dt_s: float,
) -> tuple[ForecastObserver, ...]:
    """Makes the observers of the predictors of an environment.

    Args:
        predictor: a predictor or its name; several with the prefixes of their entries; or None.
        forecast: the options of all of them, or a mapping from prefixes to options.
        dt_s: length of a tick in seconds.

    Raises:
        AspEnvError: an option or a predictor is invalid, or there are options without a predictor.
    """
    if predictor is None:
        if forecast is not None:
            raise AspEnvError(
                "forecast without a predictor: name one, such as predictor='constant-velocity'"
            )
        return ()
    if not isinstance(predictor, Mapping):
        return (ForecastObserver(predictor, _options_of(forecast), dt_s),)
    if not predictor:
        raise AspEnvError("predictor {}: expected a predictor or a mapping with at least one")
    own = forecast if isinstance(forecast, Mapping) and set(forecast) & set(predictor) else None
    if unknown := sorted(set(own or {}) - set(predictor)):
        raise unknown_name("predictor in forecast", unknown[0], sorted(predictor))
    observers = []
    for prefix, each in predictor.items():
        text("prefix of a predictor", prefix)
        options = _options_of(forecast if own is None else own.get(prefix))
        full = "_".join(part for part in (options.prefix, prefix) if part)
        observers.append(ForecastObserver(each, dataclasses.replace(options, prefix=full), dt_s))
    return tuple(observers)


def extended_space(
    space: spaces.Space[Any], added: Mapping[str, spaces.Space[Any]]
) -> spaces.Space[Any]:
    """Returns a Dict space with additional entries.

    Raises:
        AspEnvError: the space is no Dict, or has an entry of that name.
    """
    if not isinstance(space, spaces.Dict):
        raise AspEnvError(f"observation space {space}: expected a Dict")
    if taken := sorted(set(space.keys()) & set(added)):
        raise AspEnvError(
            f"the observation has an entry {taken[0]!r} already: give the predictor a prefix"
        )
    return spaces.Dict([*space.spaces.items(), *added.items()])  # a mapping would be sorted


def nearest_agents(
    scene: Scene, count: int
) -> tuple[Int[np.ndarray, "t 2"], Int[np.ndarray, " t"]]:
    """Finds the agents nearest to the ego of each situation.

    Args:
        scene: B situations.
        count: the largest number of agents per situation.

    Returns:
        (T, 2) situation and slot of the agents, and (T,) their rank in the situation, 0 for the
        nearest. Agents at the same distance are ordered by id, since the order of slots is
        arbitrary.
    """
    slots = nearest_slots(scene.states[:, :, -1], scene.valid[:, :, -1], scene.ids, count)
    situation, rank = np.nonzero(slots >= 0)
    return np.stack([situation, slots[situation, rank]], axis=-1), rank


def nearest_slots(
    states: Float[np.ndarray, "b a 4"],
    valid: Bool[np.ndarray, "b a"],
    ids: Int[np.ndarray, "b a"],
    count: int,
) -> Int[np.ndarray, "b count"]:
    """Finds the slots of the agents nearest to the ego of each situation, see `nearest_agents`.

    Args:
        states: present states [x m, y m, heading rad, speed m/s].
        valid: mask of the present agents.
        ids: track ids.
        count: number of slots to return.

    Returns:
        The slots, nearest first, `NO_AGENT` where there are fewer agents.
    """
    offset_m = states[..., :2] - states[:, EGO, None, :2]
    slots = np.full((len(states), count), NO_AGENT)
    _nearest(np.hypot(offset_m[..., 0], offset_m[..., 1]), valid, ids, slots)
    return slots


@njit(cache=True, nogil=True)
@no_type_check
def _nearest(distances_m, valid, ids, slots):
    """Writes the slots (B, K) of the present agents but the ego, by distance, then by id."""
    num_agents, most = valid.shape[1], slots.shape[1]
    for b in range(len(slots)):
        found = 0
        for a in range(1, num_agents):
            if not valid[b, a]:
                continue
            at = found
            while at > 0:
                other = slots[b, at - 1]
                apart, apart_other = distances_m[b, a], distances_m[b, other]
                if apart > apart_other or (apart == apart_other and ids[b, a] > ids[b, other]):
                    break
                at -= 1
            if at == most:
                continue
            found = min(found + 1, most)
            for k in range(found - 1, at, -1):
                slots[b, k] = slots[b, k - 1]
            slots[b, at] = a


@njit(cache=True, nogil=True)
@no_type_check
def _store(forecast, where, out):
    """Stores the most probable modes of N targets.

    Args:
        forecast: states (N, modes, ticks, 4), probabilities (N, modes), and the modes to store
            (N, M) in their order.
        where: rows and places (R,), situation and rank (N,) of the targets, ticks to store.
        out: points and probabilities, see `_Made`.
    """
    states, probabilities, order = forecast
    rows, places, situation, rank, steps = where
    points, stored_probabilities = out
    for n in range(len(order)):
        b, s, k = rows[situation[n]], places[situation[n]], rank[n]
        for m in range(order.shape[1]):
            mode = order[n, m]
            stored_probabilities[b, s, k, m] = probabilities[n, mode]
            for i in range(len(steps)):
                points[b, s, k, m, i, 0] = states[n, mode, steps[i], 0]
                points[b, s, k, m, i, 1] = states[n, mode, steps[i], 1]


@njit(cache=True, nogil=True)
@no_type_check
def _write(made, where, now, times_s, out):
    """Writes the observation entries of R episodes.

    Args:
        made: ids (B, S, K), points, probabilities, features and numbers of modes (B, S), see
            `_Made`.
        where: rows (R,), places (R,), index of the asked times in the points (R, times), ages (R,)
            in seconds.
        now: slots (R, K) of the nearest agents, ids (R, A), states (R, A, 4), and the cosine and
            sine (R,) of the egos' headings.
        times_s: asked times ahead (times,).
        out: positions, probabilities, valid, features and ages, zeros.
    """
    ids_then, points, probabilities_then, features_then, num_modes = made
    rows, places, steps, ages_s = where
    slots, ids, states, cosines, sines = now
    positions, probabilities, valid, features, ages = out
    num_times = positions.shape[3]
    limit, most, one = np.float32(MAX_POSITION_M), np.float32(MAX_FEATURE), np.float32(1.0)
    points_now = np.empty((num_times, 2), dtype=np.float32)
    for r in range(len(rows)):
        b, s = rows[r], places[r]
        x, y, cos, sin = states[r, EGO, 0], states[r, EGO, 1], cosines[r], sines[r]
        for k in range(slots.shape[1]):
            a = slots[r, k]
            if a < 0:
                break
            valid[r, k] = 1.0
            then = _index_of(ids[r, a], ids_then[b, s])
            if then < 0:
                probabilities[r, k, 0] = 1.0
                _continue_straight(states[r, a], times_s, points_now)
            else:
                ages[r, k] = ages_s[r]
                for f in range(features.shape[2]):
                    features[r, k, f] = _clipped(features_then[b, s, then, f], most)
            for m in range(num_modes[b, s] if then >= 0 else 1):
                if then >= 0:
                    probability = probabilities_then[b, s, then, m]
                    probabilities[r, k, m] = min(max(probability, np.float32(0.0)), one)
                    for t in range(num_times):
                        points_now[t] = points[b, s, then, m, steps[r, t]]
                for t in range(num_times):
                    dx, dy = points_now[t, 0] - x, points_now[t, 1] - y
                    positions[r, k, m, t, 0] = _clipped(cos * dx + sin * dy, limit)
                    positions[r, k, m, t, 1] = _clipped(cos * dy - sin * dx, limit)


@njit(cache=True, inline="always")
@no_type_check
def _clipped(value, limit):
    return min(max(value, -limit), limit)


@njit(cache=True)
@no_type_check
def _index_of(wanted, ids):
    """Index of an id, or -1."""
    for j in range(len(ids)):
        if ids[j] == wanted:
            return j
    return -1


@njit(cache=True)
@no_type_check
def _continue_straight(state, times_s, points):
    """Writes the positions (times, 2) of an agent at constant velocity."""
    cos, sin = math.cos(state[2]), math.sin(state[2])
    for t in range(len(points)):
        points[t, 0] = state[0] + state[3] * times_s[t] * cos
        points[t, 1] = state[1] + state[3] * times_s[t] * sin


def _options_of(forecast: ForecastSpec | None) -> ForecastOptions:
    if isinstance(forecast, ForecastOptions):
        return forecast
    known = [field.name for field in dataclasses.fields(ForecastOptions)]
    if not isinstance(forecast, Mapping | None):
        raise AspEnvError(
            f"forecast {shown(forecast)}: expected ForecastOptions or a mapping of "
            f"{', '.join(known)}"
        )
    for name in forecast or {}:
        if name not in known:
            raise unknown_name("forecast option", str(name), known)
    return ForecastOptions(**(forecast or {}))


def _check_predictor(
    predictor: Predictor, horizon: int, dt_s: float, options: ForecastOptions
) -> None:
    if needs_simulation(predictor):
        raise AspEnvError(
            f"predictor {predictor.name} simulates the ego's plan, which an environment does not "
            "know: use oracle, or asp-env drive"
        )
    if predictor.privileged and not options.privileged:
        raise AspEnvError(
            f"predictor {predictor.name} uses the recorded future, which is not known while "
            "driving: allow it with privileged=True"
        )
    if abs(predictor.dt_s - dt_s) > 1e-6:
        raise AspEnvError(
            f"predictor {predictor.name} was made for a time step of {predictor.dt_s:g} s, "
            f"the environment has {dt_s:g} s"
        )
    if predictor.horizon < horizon:
        raise AspEnvError(
            f"predictor {predictor.name} forecasts {predictor.horizon * dt_s:g} s: at_s has times "
            f"up to {horizon * dt_s:g} s"
        )

"""Maps, forecasts and rollouts as JSON values that the scripts of the page draw.

Points are in centimetres: the first point, then the steps from point to point, which keeps the text
short. Headings are in thousandths of a radian. What happens in a rollout is compressed, and the
script decompresses it when the rollout is shown.
"""

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from asp_env.data.classes import AgentClass
from asp_env.data.predictor import Forecast
from asp_env.data.road_map import LineType, Ragged, RoadMap
from asp_env.data.rollout import Rollout
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.errors import AspEnvError, DataError
from asp_env.evaluation.report.episodes import Episode
from asp_env.evaluation.results import Condition

FORECAST_POINT_S = 0.4
"""Time between the drawn points of a forecast; its last point is always drawn. Chosen by hand: a
longer time bends sharp turns, a shorter one enlarges the file."""
FORECAST_DECIMALS = 1
"""Decimals of the points of a rollout's forecasts, m: a pixel is about as large. Two of them make
the page half as large again."""
MIN_PICTURE_M = 50.0
MAX_PICTURE_M = 110.0
"""Bounds on the side of an example's picture. Chosen by hand."""
MARGIN_M = 10.0
"""Room around the targets of an example."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ForecastExamples:
    """Situations with the forecasts of several predictors, shown as pictures over the map."""

    scene: Scene
    """Each of its situations becomes a row of pictures."""
    future: Future
    """The recorded future of the scene's targets."""
    forecasts: Mapping[str, Forecast]
    """Forecasts of this scene by predictor; each predictor becomes a column of pictures."""
    captions: tuple[str, ...]
    """A caption for each situation."""

    def __post_init__(self) -> None:
        """Checks that all parts have the same situations and targets.

        Raises:
            AspEnvError: A count does not match.
        """
        situations, targets = len(self.scene.tick), len(self.scene.targets)
        if len(self.captions) != situations:
            raise AspEnvError(f"{len(self.captions)} captions for {situations} situations")
        counts = {"the future": len(self.future.states)}
        counts |= {name: len(forecast.ids) for name, forecast in self.forecasts.items()}
        for name, count in counts.items():
            if count != targets:
                raise AspEnvError(f"{name} has {count} targets, the scene has {targets}")


class MapTable:
    """The maps of the page, each stored once and referenced by its number."""

    def __init__(self) -> None:
        self._numbers: dict[int, int] = {}
        self.payloads: list[dict[str, Any]] = []

    def number(self, road_map: RoadMap) -> int:
        """The number of a map, which is added if it is new."""
        key = id(road_map)
        if key not in self._numbers:
            self._numbers[key] = len(self.payloads)
            self.payloads.append(_map_payload(road_map))
        return self._numbers[key]


def points_payload(points: Float[np.ndarray, "n 2"]) -> list[int]:
    """Points in centimetres: the first one, then the steps from point to point.

    Args:
        points: the points, m.
    """
    cm = np.rint(100 * points).astype(np.int64)
    return np.diff(cm, axis=0, prepend=0).reshape(-1).tolist()


def _map_payload(road_map: RoadMap) -> dict[str, Any]:
    lines = [
        [int(kind), points_payload(road_map.lines[number])]
        for number, kind in enumerate(road_map.line_types)
        if kind != LineType.VIRTUAL
    ]
    return {
        "name": road_map.name,
        "extent": [round(side, 1) for side in road_map.extent_m],
        "drivable": [points_payload(ring) for ring in _anticlockwise(road_map.drivable)],
        "lines": lines,
    }


def _anticlockwise(rings: Ragged) -> list[np.ndarray]:
    """Rings of the same orientation: filled together, they leave no holes."""
    turned = []
    for number in range(len(rings)):
        x, y = rings[number].T
        area = np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
        turned.append(rings[number] if area >= 0 else rings[number][::-1])
    return turned


def poses_payload(states: Float[np.ndarray, "... 4"]) -> list[Any]:
    """Positions in centimetres and headings in thousandths of a radian.

    Args:
        states: states [x m, y m, heading rad, speed m/s].
    """
    return _poses(states).tolist()


def _poses(states: Float[np.ndarray, "... 4"]) -> np.ndarray:
    return np.rint(states[..., :3] * np.array([100, 100, 1000])).astype(np.int64)


def _thinned(states: Float[np.ndarray, "... steps n"], dt_s: float) -> np.ndarray:
    stride = max(1, round(FORECAST_POINT_S / dt_s))
    return states[..., ::-1, :2][..., ::stride, :][..., ::-1, :]


def _modes(
    states: Float[np.ndarray, "m steps n"], log_probs: Float[np.ndarray, " m"], dt_s: float
) -> list:
    return [
        [round(float(np.exp(log_prob)), 3), points_payload(mode)]
        for log_prob, mode in zip(log_probs, _thinned(states, dt_s), strict=True)
    ]


def examples_payload(examples: ForecastExamples, maps: MapTable) -> list[dict[str, Any]]:
    """A row of pictures for each situation.

    Args:
        examples: The situations and their forecasts.
        maps: The table that receives the maps.

    Returns:
        For each situation its caption, map, window, agents, targets, recorded future and, by
        predictor, modes and final errors.
    """
    return [_picture_row(examples, number, maps) for number in range(len(examples.captions))]


def _picture_row(examples: ForecastExamples, number: int, maps: MapTable) -> dict[str, Any]:
    scene, future = examples.scene, examples.future
    targets = np.flatnonzero(scene.targets[:, 0] == number)
    present = np.flatnonzero(scene.valid[number, :, -1])
    states = scene.states[number]
    centre, extent_m = _picture_window(scene, future, targets)
    return {
        "caption": examples.captions[number],
        "map": maps.number(scene.maps[int(scene.map_index[number])]),
        "window": [round(value, 1) for value in (*centre, extent_m)],
        "agents": [
            [
                int(scene.classes[number, slot]),
                *_box(scene.sizes[number, slot]),
                *_poses(states[slot, -1]).tolist(),
                points_payload(states[slot, scene.valid[number, slot], :2]),
            ]
            for slot in present
        ],
        "targets": [int(np.flatnonzero(present == scene.targets[t, 1])[0]) for t in targets],
        "truth": [
            points_payload(
                np.concatenate(
                    [states[scene.targets[t, 1], -1:, :2], future.states[t, future.valid[t], :2]]
                )
            )
            for t in targets
        ],
        "forecasts": {
            name: {
                "modes": [
                    _modes(forecast.states[t], forecast.log_probs[t], forecast.dt_s)
                    if forecast.valid[t]
                    else []
                    for t in targets
                ],
                **_final_errors(forecast, future, targets),
            }
            for name, forecast in examples.forecasts.items()
        },
    }


def _picture_window(
    scene: Scene, future: Future, targets: np.ndarray
) -> tuple[tuple[float, float], float]:
    """Centre and side of the square that shows the targets and their recorded future."""
    points = np.concatenate(
        [scene.target_states[targets, :2], future.states[targets][future.valid[targets]][:, :2]]
    )
    low, high = points.min(axis=0), points.max(axis=0)
    extent_m = float(np.clip((high - low).max() + 2 * MARGIN_M, MIN_PICTURE_M, MAX_PICTURE_M))
    x, y = (low + high) / 2
    return (float(x), float(y)), extent_m


def _final_errors(
    forecast: Forecast, future: Future, targets: np.ndarray
) -> dict[str, float | None]:
    """Mean FDE of the most probable and of the nearest mode over the targets of a situation."""
    steps = min(forecast.states.shape[2], future.states.shape[1])
    rows = targets[forecast.valid[targets] & future.valid[targets, steps - 1]]
    if not len(rows):
        return {"fde": None, "best": None}
    miss = forecast.states[rows, :, steps - 1, :2] - future.states[rows, None, steps - 1, :2]
    distance_m = np.hypot(miss[..., 0], miss[..., 1])
    probable = distance_m[np.arange(len(rows)), forecast.most_probable[rows]]
    return {
        "fde": round(float(probable.mean()), 2),
        "best": round(float(distance_m.min(axis=1).mean()), 2),
    }


def _box(size: Float[np.ndarray, " 2"]) -> list[int]:
    return np.rint(100 * size).astype(np.int64).tolist()


def rollouts_payload(
    out: Path,
    episodes: Sequence[Episode],
    road_maps: Mapping[str, RoadMap],
    maps: MapTable,
    conditions: Sequence[Condition],
) -> list[dict[str, Any]]:
    """The rollouts of some episodes, in their order.

    Args:
        out: The run folder.
        episodes: The episodes.
        road_maps: Road maps by the name of the recording, or by `DATA/RECORDING`.
        maps: The table that receives the maps.
        conditions: The conditions of the page; an episode has the index of its own.

    Raises:
        DataError: A rollout cannot be read, or the map of its recording is missing.
    """
    rollouts = []
    for episode in episodes:
        rollout = Rollout.load(episode.path)
        road_map = map_of(rollout, episode.path, road_maps)
        condition = episode.condition
        head = {
            "driver": episode.label,
            "name": episode.path.stem,
            "condition": conditions.index(condition) if condition in conditions else 0,
            "command": episode.command,
            "file": episode.path.relative_to(out).as_posix(),
            "tags": " · ".join(rollout.scenario.tags),
            "ticks": len(rollout.states),
            "dt": round(rollout.dt_s, 4),
        }
        body = _rollout(rollout, maps.number(road_map))
        rollouts.append(head | {"body": _compressed(body)})
    return rollouts


def map_of(rollout: Rollout, path: Path, road_maps: Mapping[str, RoadMap]) -> RoadMap:
    """The road map of a rollout.

    Args:
        rollout: The rollout.
        path: Its file, for the error.
        road_maps: Road maps by the name of the recording, or by `DATA/RECORDING`.

    Raises:
        DataError: The map of its recording is missing.
    """
    name = rollout.scenario.recording_name
    own = f"{rollout.scenario.source}/{name}"
    name = own if own in road_maps else name
    if name not in road_maps:
        known = ", ".join(sorted(road_maps)) or "none"
        raise DataError(f"{path}: no map of recording {name!r} was given; given were {known}")
    return road_maps[name]


def _compressed(value: object) -> str:
    """A JSON value as text: compressed by gzip, in base64."""
    text = json.dumps(value, separators=(",", ":")).encode()
    return base64.b64encode(gzip.compress(text, mtime=0)).decode()


def _rollout(rollout: Rollout, map_number: int) -> dict[str, Any]:
    return {
        "map": map_number,
        "agents": [_track(rollout, slot) for slot in range(len(rollout.ids))],
        "log": [
            pose if valid else None
            for pose, valid in zip(
                _poses(rollout.log_states[:, 0]).tolist(), rollout.log_valid[:, 0], strict=True
            )
        ],
        "speed": _speeds(rollout.states[:, 0, 3], rollout.valid[:, 0]),
        "log_speed": _speeds(rollout.log_states[:, 0, 3], rollout.log_valid[:, 0]),
        "route": points_payload(rollout.route),
        "plans": [points_payload(plan) for plan in rollout.plans],
        "forecasts": _forecasts(rollout),
        "events": _event_intervals(rollout),
    }


def _track(rollout: Rollout, slot: int) -> dict[str, Any]:
    """Poses of an agent from its first to its last valid tick, None where it is not valid."""
    ticks = np.flatnonzero(rollout.valid[:, slot])
    kind = AgentClass(int(rollout.classes[slot]))
    head = {"class": int(kind), "size": _box(rollout.sizes[slot])}
    if not len(ticks):
        return head | {"first": 0, "poses": []}
    first, last = int(ticks[0]), int(ticks[-1])
    poses = _poses(rollout.states[first : last + 1, slot]).tolist()
    valid = rollout.valid[first : last + 1, slot]
    return head | {
        "first": first,
        "poses": [pose if present else None for pose, present in zip(poses, valid, strict=True)],
    }


def _speeds(speeds_mps: Float[np.ndarray, " ticks"], valid: np.ndarray) -> list[float | None]:
    return [
        round(float(speed), 2) if present else None
        for speed, present in zip(speeds_mps, valid, strict=True)
    ]


def _event_intervals(rollout: Rollout) -> list[list]:
    """[name, first tick, last tick] of every interval in which an event holds."""
    edges = np.diff(rollout.events.astype(np.int8), axis=0, prepend=0, append=0)
    return [
        [name, int(first), int(last) - 1]
        for kind, name in enumerate(rollout.event_names)
        for first, last in zip(
            np.flatnonzero(edges[:, kind] == 1), np.flatnonzero(edges[:, kind] == -1), strict=True
        )
    ]


def _forecasts(rollout: Rollout) -> list[list]:
    """Forecasts [slot, [[probability, points], …]] by tick."""
    forecasts: list[list] = [[] for _ in range(len(rollout.states))]
    rounded = np.round(rollout.forecast_states, FORECAST_DECIMALS)
    for row, tick in enumerate(rollout.forecast_ticks):
        modes = _modes(rounded[row], rollout.forecast_log_probs[row], rollout.dt_s)
        forecasts[int(tick)].append([int(rollout.forecast_slots[row]), modes])
    return forecasts

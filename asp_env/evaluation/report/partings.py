"""Pictures of where two methods part that drive the same scenario from the same state.

The two rollouts of a scenario begin alike and differ in the predictor. They part at the first tick
at which the positions of the egos differ by more than `PARTED_M`.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from asp_env.data.road_map import RoadMap
from asp_env.data.rollout import Rollout
from asp_env.evaluation.report.episodes import Episode
from asp_env.evaluation.report.payload import MapTable, map_of, points_payload, poses_payload
from asp_env.evaluation.report.scenario_values import ListedDrive

PARTED_M = 0.5
"""Distance from which on egos are apart. Chosen by hand: a tenth of a car's length."""

MIN_PICTURE_M = 40.0
MAX_PICTURE_M = 120.0
MARGIN_M = 8.0
"""Bounds on the width of a picture, and the room around the paths. Chosen by hand."""


def parting_tick(first: Rollout, second: Rollout) -> int | None:
    """The tick at which the egos of two rollouts part; None if they never do.

    Args:
        first: a rollout.
        second: another rollout of the same scenario.
    """
    ticks = min(len(first.states), len(second.states))
    both = first.valid[:ticks, 0] & second.valid[:ticks, 0]
    apart_m = np.hypot(*(first.states[:ticks, 0, :2] - second.states[:ticks, 0, :2]).T)
    apart = np.flatnonzero(both & (apart_m > PARTED_M))
    return int(apart[0]) if len(apart) else None


def parting_figures(
    drives: Sequence[ListedDrive],
    episodes: Mapping[tuple[str, tuple[str, str]], Episode],
    road_maps: Mapping[str, RoadMap],
    maps: MapTable,
    *,
    condition: int,
    most: int,
) -> list[dict[str, Any]]:
    """A figure for each drive of two methods that part.

    Args:
        drives: scenarios, each with two methods.
        episodes: the saved rollouts by name of the scenario, and by planner and predictor.
        road_maps: road maps as for `rollouts_payload`.
        maps: the table that receives the maps.
        condition: number of the condition, for the link to the player.
        most: largest number of figures; they are those of the first drives that part.

    Raises:
        DataError: a rollout cannot be read, or the map of its recording is missing.
    """
    figures = []
    for drive in drives:
        if len(figures) == most:
            break
        pair = [episodes.get((drive.name, method)) for method in (drive.first, drive.second)]
        first, second = pair
        if first is None or second is None or first.path == second.path:
            continue
        rollouts = [Rollout.load(first.path), Rollout.load(second.path)]
        tick = parting_tick(*rollouts)
        if tick is None:
            continue
        road_map = map_of(rollouts[0], first.path, road_maps)
        figures.append(
            {
                "kind": "parting",
                "title": f"{drive.name}: the methods part after {tick * rollouts[0].dt_s:.1f} s",
                "map": maps.number(road_map),
                "window": _window(rollouts),
                "tick": tick,
                "ticks_per_s": max(1, round(1 / rollouts[0].dt_s)),
                "methods": [
                    {
                        "label": episode.label,
                        "score": round(score, 4),
                        "path": points_payload(rollout.states[rollout.valid[:, 0], 0, :2]),
                        "forecasts": _forecasts_at(rollout, tick),
                    }
                    for episode, score, rollout in zip(
                        (first, second), drive.scores, rollouts, strict=True
                    )
                ],
                "agents": _agents_at(rollouts, tick),
                "open": {
                    "drive": drive.name,
                    "a": first.label,
                    "b": second.label,
                    "tick": tick,
                    "condition": condition,
                },
            }
        )
    return figures


def _window(rollouts: Sequence[Rollout]) -> list[float]:
    """Left, bottom, width and height in metres of what both egos pass through."""
    points = np.concatenate([each.states[each.valid[:, 0], 0, :2] for each in rollouts])
    low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
    extent_m = np.clip(high - low, MIN_PICTURE_M, MAX_PICTURE_M)
    return [round(float(v), 1) for v in (*((low + high - extent_m) / 2), *extent_m)]


def _agents_at(rollouts: Sequence[Rollout], tick: int) -> list[list[int]]:
    """Class, size and pose of the agents at a tick, and the number of their rollout.

    Agents other than the ego are those of the first rollout.
    """
    first, second = rollouts
    boxes = [(0, slot) for slot in np.flatnonzero(first.valid[tick])[::-1]]
    return [
        [
            -1 - number if slot == 0 else int(rollout.classes[slot]),
            *np.rint(100 * rollout.sizes[slot]).astype(int).tolist(),
            *poses_payload(rollout.states[tick, slot]),
        ]
        for number, slot in [*boxes, (1, 0)]
        for rollout in [(first, second)[number]]
    ]


def _forecasts_at(rollout: Rollout, tick: int) -> list[list[int]]:
    """The most probable mode of every agent's forecast at a tick."""
    rows = np.flatnonzero(rollout.forecast_ticks == tick)
    best = rollout.forecast_log_probs[rows].argmax(axis=1) if len(rows) else []
    return [
        points_payload(rollout.forecast_states[row, mode])
        for row, mode in zip(rows, best, strict=True)
    ]

"""Scores of the logged ego under all driving rules: the reference of every comparison."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from asp_env.data.recording import Recording
from asp_env.data.road_map import Ragged, RoadMap
from asp_env.data.scenarios.scenario import Scenario, find_scenarios
from asp_env.data.source import Recordings, open_data
from asp_env.evaluation.closed_loop.episodes import (
    DrivenEpisodes,
    EpisodeSettings,
    drive_episodes,
)
from asp_env.metrics.driving.rules import NUPLAN, RULES, Rules
from asp_env.metrics.driving.scores import driving_metrics
from asp_env.metrics.lanes import covering_lanes
from asp_env.planning.planner import load_planner
from asp_env.sim.world import Ending
from predictors.physical import ConstantVelocity
from tests.real_data import real_data
from tests.sim.worlds import DT_S, HISTORY


def drive_expert(
    recordings: Recordings | list[Recording],
    rules: Rules,
    scenarios: Sequence[Scenario] | None = None,
) -> tuple[DrivenEpisodes, dict[str, np.ndarray]]:
    """The episodes of the expert, and its metrics where they are valid."""
    chosen = scenarios or list(find_scenarios(recordings, source="", dt_s=DT_S, history=HISTORY))
    driven = drive_episodes(
        recordings,
        chosen,
        load_planner("expert"),
        ConstantVelocity(horizon=15, dt_s=DT_S),
        EpisodeSettings(rules=rules, traffic="log", horizon=15, history=HISTORY, dt_s=DT_S),
    )
    metrics = driving_metrics(driven.drives, rules)
    return driven, {name: metric.value[metric.valid] for name, metric in metrics.items()}


@pytest.mark.parametrize("rules", RULES.values(), ids=RULES)
@pytest.mark.parametrize("site", ["intersection", "roundabout"])
def test_on_synthetic_traffic(site: str, rules: Rules) -> None:
    """No collision, all of the route, on its log, its road, its side, its limit, to the goal.

    Only the time to collision, which extrapolates turning vehicles straight on, and the comfort
    are below 1.
    """
    driven, metrics = drive_expert(open_data(f"sample:{site}"), rules)
    for name in (
        *("no collision", "no at-fault collision", "no hit from behind", "direction"),
        *("right way", "making progress", "feasible"),
    ):
        assert metrics[name].tolist() == [1.0] * len(driven.rollouts), name
    assert metrics["log divergence"].max() == 0
    assert metrics["route deviation"].max() < 0.1
    assert metrics["progress"].min() > 0.99
    assert metrics["speed"].min() > 0.95
    assert metrics["TTC"].mean() > 0.8
    assert metrics["comfort"].mean() > 0.9
    assert metrics["near misses"].mean() < 0.005
    assert metrics["required deceleration"].max() < 6
    assert np.abs(metrics["time lost"]).max() == 0
    assert metrics["driving cost"].max() < 10
    if rules.weights:
        assert 0.88 < metrics["score"].mean() <= 1
        assert metrics["on road"].tolist() == [1.0] * len(driven.rollouts)
    assert set(driven.endings.tolist()) == {int(Ending.GOAL)}


def without_lane(road_map: RoadMap, lane: int) -> RoadMap:
    """The map without a lane, its area and its ring of the drivable area."""
    lanes = [number for number in range(len(road_map.lanes)) if number != lane]
    rings = [number for number in range(len(road_map.drivable)) if number != lane]
    edges = road_map.successors[(road_map.successors != lane).all(axis=1)]
    return replace(
        road_map,
        drivable=Ragged.pack([road_map.drivable[number] for number in rings]),
        lanes=Ragged.pack([road_map.lanes[number] for number in lanes]),
        areas=Ragged.pack([road_map.areas[number] for number in lanes]),
        successors=edges - (edges > lane),
        two_way=road_map.two_way[lanes],
        limits_mps=road_map.limits_mps[lanes],
        limited=road_map.limited[lanes],
    )


def test_a_missing_lanelet_is_not_charged_to_the_expert() -> None:
    """A roundabout without its busiest lanelet; a published map lacks one too.

    The expert neither leaves the road nor drives in the wrong direction or off its route. Only the
    metric `on mapped road` shows the gap.
    """
    recordings = open_data("sample:roundabout")
    scenarios = list(find_scenarios(recordings, source="", dt_s=DT_S, history=HISTORY))
    recording = recordings[0]
    road_map = recording.road_map
    positions = np.concatenate([recording.track(i)[::25, :2] for i in range(len(recording))])
    busiest = int(covering_lanes(road_map, positions).sum(axis=0).argmax())
    with_gap = replace(recording, road_map=without_lane(road_map, busiest))
    driven, metrics = drive_expert([with_gap], NUPLAN, scenarios)
    for name in ("on road", "direction", "right way", "no at-fault collision", "progress"):
        assert metrics[name].min() > 0.99, name
    assert metrics["on mapped road"].mean() < 0.9
    assert set(driven.endings.tolist()) == {int(Ending.GOAL)}


@pytest.mark.data
def test_on_a_real_map_with_gaps() -> None:
    """At Karlsruhe, over half of the episodes leave the mapped road; none is charged for it.

    Recorded boxes that are too large overlap, so an episode may end with a collision.
    """
    driven, metrics = drive_expert(open_data(real_data("karlsruhe")), NUPLAN)
    assert metrics["on mapped road"].mean() < 0.5
    assert metrics["on road"].min() == 1
    assert metrics["right way"].min() == 1
    assert metrics["direction"].mean() > 0.97
    assert metrics["no at-fault collision"].mean() > 0.97
    assert Ending.OFF_ROAD not in driven.endings
    assert metrics["log divergence"].max() == 0
    assert metrics["near misses"].mean() < 0.005
    assert np.median(np.abs(metrics["time lost"])) == 0


def test_episodes_side_by_side_score_as_alone() -> None:
    """Every metric under all driving rules."""
    recordings = open_data("sample:intersection")
    scenarios = list(find_scenarios(recordings, source="", dt_s=DT_S, history=HISTORY))[:40:8]
    for rules in RULES.values():
        together, _ = drive_expert(recordings, rules, scenarios)
        metrics = driving_metrics(together.drives, rules)
        for b, scenario in enumerate(scenarios):
            alone, _ = drive_expert(recordings, rules, [scenario])
            for name, metric in driving_metrics(alone.drives, rules).items():
                assert metric.value[0] == pytest.approx(metrics[name].value[b], abs=1e-12), name
                assert metric.valid[0] == metrics[name].valid[b]
            assert alone.rollouts[0].events.tolist() == together.rollouts[b].events.tolist()

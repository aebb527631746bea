"""The logged ego judged by every preset: what data and metrics themselves cost."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from asp_env.data.recording import Recording
from asp_env.data.road_map import Ragged, RoadMap
from asp_env.data.scenarios.scenario import Scenario, find_scenarios
from asp_env.data.source import Recordings, open_data
from asp_env.evaluation.closed_loop.episodes import DrivenEpisodes, drive_episodes
from asp_env.metrics.driving.rules import NUPLAN, RULES, Rules
from asp_env.metrics.driving.scores import driving_metrics
from asp_env.metrics.lanes import covering_lanes
from asp_env.planning.planner import load_planner
from asp_env.sim.world import Ending
from predictors.physical import ConstantVelocity
from tests.real_data import real_data
from tests.sim.worlds import DT_S, HISTORY


def judged(
    recordings: Recordings | list[Recording],
    preset: Rules,
    scenarios: Sequence[Scenario] | None = None,
) -> tuple[DrivenEpisodes, dict[str, np.ndarray]]:
    """The expert's drives, and its metrics where they apply."""
    found = scenarios or list(find_scenarios(recordings, source="", dt_s=DT_S, history=HISTORY))
    driven = drive_episodes(
        recordings,
        found,
        load_planner("expert"),
        ConstantVelocity(horizon=15, dt_s=DT_S),
        preset=preset,
        traffic="log",
        horizon=15,
        history=HISTORY,
        dt_s=DT_S,
    )
    metrics = driving_metrics(driven.drives, preset)
    return driven, {name: metric.value[metric.valid] for name, metric in metrics.items()}


@pytest.mark.parametrize("preset", RULES.values(), ids=RULES)
@pytest.mark.parametrize("site", ["intersection", "roundabout"])
def test_on_synthetic_traffic(site: str, preset: Rules) -> None:
    """No collision, all of the way, on its log, its road, its side, its limit; every drive ends.

    What is left are times to collision, which take turning vehicles for straight on, and comfort.
    """
    driven, found = judged(open_data(f"sample:{site}"), preset)
    for name in (
        *("no collision", "no at-fault collision", "no hit from behind", "direction"),
        *("right way", "making progress", "feasible"),
    ):
        assert found[name].tolist() == [1.0] * len(driven.rollouts), name
    assert found["log divergence"].max() == 0
    assert found["route deviation"].max() < 0.1
    assert found["progress"].min() > 0.99
    assert found["speed"].min() > 0.95
    assert found["TTC"].mean() > 0.8
    assert found["comfort"].mean() > 0.9
    if preset.weights:
        assert 0.9 < found["score"].mean() <= 1
        assert found["on road"].tolist() == [1.0] * len(driven.rollouts)
    assert set(driven.endings.tolist()) == {int(Ending.GOAL)}


def without_lane(road_map: RoadMap, lane: int) -> RoadMap:
    """The map with a lane, its area and its piece of road left out."""
    kept = [number for number in range(len(road_map.lanes)) if number != lane]
    rings = [number for number in range(len(road_map.drivable)) if number != lane]
    edges = road_map.successors[(road_map.successors != lane).all(axis=1)]
    return replace(
        road_map,
        drivable=Ragged.pack([road_map.drivable[number] for number in rings]),
        lanes=Ragged.pack([road_map.lanes[number] for number in kept]),
        areas=Ragged.pack([road_map.areas[number] for number in kept]),
        successors=edges - (edges > lane),
        two_way=road_map.two_way[kept],
        limits_mps=road_map.limits_mps[kept],
        limited=road_map.limited[kept],
    )


def test_a_missing_lanelet_raises_no_alarm() -> None:
    """A roundabout without its busiest lanelet, as a published map lacks one, accuses nobody.

    Neither of leaving the road nor of the wrong direction or way; only the map's own test shows it.
    """
    recordings = open_data("sample:roundabout")
    scenarios = list(find_scenarios(recordings, source="", dt_s=DT_S, history=HISTORY))
    recording = recordings[0]
    road_map = recording.road_map
    followed = np.concatenate([recording.track(i)[::25, :2] for i in range(len(recording))])
    busiest = int(covering_lanes(road_map, followed).sum(axis=0).argmax())
    gappy = replace(recording, road_map=without_lane(road_map, busiest))
    driven, found = judged([gappy], NUPLAN, scenarios)
    for name in ("on road", "direction", "right way", "no at-fault collision", "progress"):
        assert found[name].min() > 0.99, name
    assert found["on mapped road"].mean() < 0.9
    assert set(driven.endings.tolist()) == {int(Ending.GOAL)}


@pytest.mark.data
def test_on_a_real_map_with_gaps() -> None:
    """Of the drives at Karlsruhe over half leave the mapped road; none is held against the log.

    Recorded boxes overlap where a tracker takes them for too large, so one drive may end in that.
    """
    driven, found = judged(open_data(real_data("karlsruhe")), NUPLAN)
    assert found["on mapped road"].mean() < 0.5
    assert found["on road"].min() == 1
    assert found["right way"].min() == 1
    assert found["direction"].mean() > 0.97
    assert found["no at-fault collision"].mean() > 0.97
    assert Ending.OFF_ROAD not in driven.endings
    assert found["log divergence"].max() == 0


def test_episodes_side_by_side_are_judged_as_alone() -> None:
    """Every metric of every preset, whoever drives beside."""
    recordings = open_data("sample:intersection")
    scenarios = list(find_scenarios(recordings, source="", dt_s=DT_S, history=HISTORY))[:40:8]
    for preset in RULES.values():
        together, _ = judged(recordings, preset, scenarios)
        metrics = driving_metrics(together.drives, preset)
        for b, scenario in enumerate(scenarios):
            alone, _ = judged(recordings, preset, [scenario])
            for name, metric in driving_metrics(alone.drives, preset).items():
                assert metric.value[0] == pytest.approx(metrics[name].value[b], abs=1e-12), name
                assert metric.valid[0] == metrics[name].valid[b]
            assert alone.rollouts[0].events.tolist() == together.rollouts[b].events.tolist()

"""Dense traffic: demand, drivers, sites, and recordings without overlap."""

import hashlib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from asp_env.data.source import open_data
from asp_env.errors import AspEnvError
from asp_env.geometry import boxes_overlap
from scenarios.sumo import synthesize
from scenarios.sumo.demand import demand, usual_mix
from scenarios.sumo.drivers import TEMPERAMENTS, dense_driver
from scenarios.sumo.sites import LEFT_TURN_RAD, Arm, crossroads, right_turn_rad, two_lane_roundabout
from scenarios.synthesize import Synthesize


def left_share(traffic: str) -> float:
    """Share of left turns among 10 hours of vehicles at a crossroads."""
    site = crossroads(np.random.default_rng(0), left_lanes=True)
    angle = {arm.enter: arm.angle_rad for arm in site.arms}
    angle |= {arm.leave: arm.angle_rad for arm in site.arms}
    mix = usual_mix(site.kind, traffic)  # pyright: ignore
    wanted = demand(np.random.default_rng(1), site, 36000.0, mix)
    trips = [trip.attrib for trip in ElementTree.fromstring(f"<r>{wanted.routes}</r>").iter("trip")]
    turns = [right_turn_rad(angle[trip["from"]], angle[trip["to"]]) for trip in trips]
    return float(np.mean(np.array(turns) < -LEFT_TURN_RAD))


def test_left_turns_are_more_frequent_in_dense_traffic() -> None:
    """At odds of 1.8, a share of a quarter becomes one of 0.375; 1.3 leaves room for the sample."""
    assert left_share("dense") > 1.3 * left_share("normal")


def test_vehicles_follow_each_other_after_3_to_6_s_on_the_main_road() -> None:
    """3600 s divided by the vehicles per hour of each main arm, mean over 20 crossroads."""
    gaps = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        site = crossroads(rng, left_lanes=True)
        wanted = demand(rng, site, 3600.0, usual_mix(site.kind, "dense"))
        main = sorted(site.arms, key=lambda arm: -arm.weight)[:2]
        gaps += [3600.0 / wanted.routes.count(f'from="{arm.enter}"') for arm in main]
    assert 3.0 < np.mean(gaps) < 7.0


def test_temperaments_differ_in_whether_they_yield() -> None:
    """Half of 4000 drivers may ignore a foe for certain or never, in the shares of the table."""
    rng = np.random.default_rng(0)
    ignore = np.array([dense_driver(rng)["jmIgnoreFoeProb"] for _ in range(4000)])
    assert abs((ignore == 1.0).mean() - TEMPERAMENTS["pushing"]) < 0.03
    never = TEMPERAMENTS["courteous"] + TEMPERAMENTS["hesitant"]
    assert abs((ignore == 0.0).mean() - never) < 0.03
    assert sum(TEMPERAMENTS.values()) == pytest.approx(1.0)


def test_vehicles_leave_the_wide_arms_from_both_lanes_of_the_ring() -> None:
    """Both lanes lead to the exits 0 and 2, the outer one also past them; 1 and 3 have one lane."""
    site = two_lane_roundabout(np.random.default_rng(0), leave_inside=True)
    links = {
        (link.attrib["from"], link.attrib["to"], link.attrib["fromLane"])
        for link in ElementTree.fromstring(f"<c>{site.connections}</c>").iter("connection")
    }
    for arm in range(4):
        before = f"ring{(arm - 1) % 4}"
        assert {(before, f"ring{arm}", "1"), (before, f"ring{arm}", "2")} <= links
        assert (before, f"exit{arm}", "1") in links
        assert ((before, f"exit{arm}", "2") in links) == (arm % 2 == 0)


def test_the_left_lane_of_a_main_road_is_for_left_turns_only() -> None:
    """At a crossroads, lane 2 has one connection per main arm, and trips on it turn left."""
    rng = np.random.default_rng(3)
    site = crossroads(rng, left_lanes=True)
    arms: dict[str, Arm] = {arm.enter: arm for arm in site.arms}
    ends = {arm.leave: arm for arm in site.arms}
    assert sorted(arm.lanes for arm in site.arms) == [1, 1, 2, 2]
    wanted = demand(rng, site, 3600.0, usual_mix(site.kind, "dense"))
    for trip in ElementTree.fromstring(f"<r>{wanted.routes}</r>").iter("trip"):
        begin, end = arms[trip.attrib["from"]], ends[trip.attrib["to"]]
        left = right_turn_rad(begin.angle_rad, end.angle_rad) < -LEFT_TURN_RAD
        assert trip.attrib["departLane"] == str(begin.lanes if left else 1)


@pytest.fixture(scope="module", params=["intersection", "roundabout"])
def dense(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings of a minute, one for each kind of location of a site."""
    out = tmp_path_factory.mktemp("dense") / request.param
    synthesize(
        out, site=request.param, recordings=2, minutes=1.0, seed=5, locations=2, traffic="dense"
    )
    return out


def test_no_vehicle_overlaps_anything(dense: Path) -> None:
    """No box touches another at 5 Hz, parked cars included; pedestrians may touch each other."""
    for recording in open_data(dense):
        moving = 0
        for frame in range(0, recording.num_frames, 5):
            present = np.flatnonzero(
                (recording.first_frames <= frame) & (recording.last_frames >= frame)
            )
            states = np.stack(
                [recording.track(i)[frame - recording.first_frames[i]] for i in present.tolist()]
            )
            boxes = np.column_stack([states[:, :3], recording.sizes[present]])
            walking = recording.classes[present] == 8
            a, b = np.triu_indices(len(present), 1)
            a, b = a[~(walking[a] & walking[b])], b[~(walking[a] & walking[b])]
            assert not boxes_overlap(boxes[a], boxes[b]).any()
            moving = max(moving, int((~recording.parked[present]).sum()))
        assert moving >= 15


@pytest.mark.parametrize("traffic", ["dense", "varied"])
def test_bytes_do_not_depend_on_the_number_of_processes(tmp_path: Path, traffic: str) -> None:
    """Three locations, written by one process and by two."""
    contents = []
    for jobs in (1, 2):
        out = tmp_path / str(jobs)
        Synthesize(
            out=out, recordings=3, locations=3, minutes=0.05, seed=2, jobs=jobs,
            traffic=traffic,  # pyright: ignore
        ).run()  # fmt: skip
        contents.append(
            {
                str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest()
                for path in out.rglob("*")
                if path.is_file()
            }
        )
    assert contents[0] == contents[1]
    assert len(contents[0]) == 15


def test_impossible_options_are_refused(tmp_path: Path) -> None:
    """No processes, and dense traffic of highway-env: one line each, and no folder."""
    with pytest.raises(AspEnvError, match="--jobs 0"):
        Synthesize(out=tmp_path / "x", recordings=1, minutes=0.05, jobs=0).run()
    with pytest.raises(AspEnvError, match="--traffic dense: highway:roundabout has traffic of"):
        Synthesize(out=tmp_path / "x", site="highway:roundabout", traffic="dense").run()
    assert not list(tmp_path.iterdir())

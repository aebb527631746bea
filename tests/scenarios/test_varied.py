"""Varied traffic: sites, demand, maps and trackers from wide ranges."""

import hashlib
from importlib import metadata
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from asp_env.data.source import open_data
from asp_env.geometry import arc_lengths, boxes_overlap
from scenarios.lanelet2 import Border, Lanelet
from scenarios.sumo import synthesize
from scenarios.sumo.motion import PathStyle, reconstruct
from scenarios.sumo.place import draw_site
from scenarios.sumo.ranges import RANGES
from scenarios.sumo.tracker import Tracker, draw_tracker, observe
from scenarios.sumo.varied_map import draw_map
from scenarios.sumo.varied_mix import varied_mix
from scenarios.tables import Track

SITES = ("intersection", "roundabout")

FROZEN = {
    ("intersection", "normal"): "0073729b56da8999",
    ("intersection", "dense"): "6fa55549881edbaa",
    ("roundabout", "normal"): "c67e52fbff08b003",
    ("roundabout", "dense"): "1cc3ef84337c25ca",
}
"""First digits of the SHA-256 of all files but images, of two locations with seed 11, noise and
6 s, as they were before varied traffic was added."""


FROZEN_WITH = "1.28.0"
"""Version of SUMO that wrote these files."""


def digest(folder: Path) -> str:
    """A hash of the names and contents of all files but images, which depend on the encoder."""
    total = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix != ".png":
            total.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return total.hexdigest()[:16]


@pytest.mark.parametrize(("site", "traffic"), FROZEN)
def test_normal_and_dense_traffic_have_the_bytes_of_before(
    tmp_path: Path, site: str, traffic: str
) -> None:
    """Seed 11 gives the files that it gave when the dimensions were drawn while building."""
    if metadata.version("eclipse-sumo") != FROZEN_WITH:
        pytest.skip(f"the hashes belong to eclipse-sumo {FROZEN_WITH}")
    out = tmp_path / "out"
    synthesize(
        out, site=site, recordings=2, minutes=0.1, seed=11, noise=True, locations=2,
        traffic=traffic,  # pyright: ignore
    )  # fmt: skip
    assert digest(out) == FROZEN[site, traffic]


@pytest.fixture(scope="module", params=SITES)
def varied(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three locations with a recording of 24 s each, with noise."""
    out = tmp_path_factory.mktemp("varied") / request.param
    synthesize(
        out, site=request.param, recordings=3, minutes=0.4, seed=1, locations=3, noise=True,
        traffic="varied",
    )  # fmt: skip
    return out


def test_recordings_are_read_without_faults(varied: Path) -> None:
    """Three frame rates of the ranges or fewer; each recording has a map with lanes."""
    recordings = open_data(varied)
    assert len(recordings) == 3
    for recording in recordings:
        assert recording.frame_rate_hz in RANGES.tracker.frame_rates_hz
        assert recording.num_frames == round(24 * recording.frame_rate_hz)
        assert len(recording.road_map.lanes) > 5
        assert recording.background is not None


def test_true_tracks_neither_overlap_nor_jump(varied: Path) -> None:
    """At 5 Hz no boxes of vehicles touch; no agent accelerates by more than 15 m/s²."""
    for recording in open_data(varied):
        true = pd.read_csv(varied / "truth" / f"{recording.name}_trueTracks.csv")
        assert np.hypot(true.xAcceleration, true.yAcceleration).max() < 15.0
        sized = true[(true.length > 0) & (true.frame % round(recording.frame_rate_hz / 5) == 0)]
        for _, frame in sized.groupby("frame"):
            poses = [frame.xCenter, frame.yCenter, np.radians(frame.heading)]
            boxes = np.column_stack([*poses, frame.length, frame.width])
            a, b = np.triu_indices(len(boxes), 1)
            assert not boxes_overlap(boxes[a], boxes[b]).any()


@pytest.mark.parametrize("name", SITES)
def test_sites_differ_within_the_ranges(tmp_path: Path, name: str) -> None:
    """Eight sound sites: limits of 10 to 60 km/h, three to five arms, not all alike."""
    sites = [
        draw_site(np.random.default_rng(seed), name, "varied", 0, tmp_path / str(seed))
        for seed in range(8)
    ]
    limits = [site.speed_limit_mps * 3.6 for site in sites]
    assert 9.9 < min(limits) < max(limits) < 60.1
    assert {len(site.arms) for site in sites} <= {3, 4, 5}
    assert len({len(site.arms) for site in sites}) > 1
    for site in sites:
        assert sum(arm.enters and arm.leaves for arm in site.arms) >= 2


def test_mixes_differ_within_the_ranges() -> None:
    """Of 200 locations some are quiet, some have many bicycles; tight ones no buses."""
    rng = np.random.default_rng(0)
    mixes = [varied_mix(rng, narrowest_m=3.0, tight=True) for _ in range(200)]
    rates = np.array([mix.vehicles_per_hour[0] for mix in mixes])
    low, high = RANGES.traffic.vehicles_per_hour
    assert low <= rates.min() < 1.2 * low < 0.8 * high < rates.max() <= high
    assert all(mix.shares["bus"] == mix.shares["truck"] == 0.0 for mix in mixes)
    bicycles = [mix.shares["bicycle"] / sum(mix.shares.values()) for mix in mixes]
    assert min(bicycles) < 0.03 < 0.2 < max(bicycles)


def test_a_path_style_moves_the_path_to_the_left() -> None:
    """Eastwards at 10 m/s, half a metre to the left is y = 0.5 m; the heading stays 0."""
    times = np.arange(0.0, 8.0, 0.1)
    points = np.stack([10.0 * times, np.zeros_like(times)], axis=1)
    motion = reconstruct(
        times, points, kind="car", length_m=4.5, style=PathStyle(offset_m=0.5), frame_rate_hz=10.0
    )
    assert motion is not None
    assert len(motion.xy) == 80
    assert np.allclose(motion.xy[:, 1], 0.5, atol=1e-6)
    assert np.allclose(motion.heading_rad, 0.0, atol=1e-6)


def straight_road() -> list[Lanelet]:
    """Two lanes of 3 m side by side, 60 m long, one in each direction, in two parts of 30 m."""
    lanelets = []
    for begin, end in ((0.0, 30.0), (30.0, 60.0)):
        x = np.linspace(begin, end, 7)
        middle, low, high = (np.stack([x, np.full(7, y)], axis=1) for y in (0.0, -3.0, 3.0))
        for left, right in ((middle, low), (middle[::-1], high[::-1])):
            lanelets.append(
                Lanelet(
                    subtype="road",
                    left=(Border(line=left, marking="dashed"),),
                    right=(Border(line=right, marking="curb"),),
                    speed_limit_mps=13.9,
                )
            )
    return lanelets


def test_map_styles_cover_the_same_road() -> None:
    """In 60 styles the area is that of the road, 360 m², counted once or twice per direction.

    A lane for both directions covers 6 m; every map lies within its largest offset: 1 m and a
    rotation of 1 degree about the middle, at most 0.53 m at 30 m.
    """
    found = set()
    for seed in range(60):
        rng = np.random.default_rng(seed)
        drawn, _ = draw_map(rng, straight_road(), np.zeros((0, 4, 2)), middle=np.array([30.0, 0.0]))
        area = 0.0
        for lanelet in drawn:
            ring = lanelet.outline
            x, y = ring.T
            area += 0.5 * abs(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
        assert area == pytest.approx(360.0, rel=1e-6)
        points = np.concatenate([lanelet.outline for lanelet in drawn])
        assert (points.min(axis=0) > [-1.6, -4.6]).all()
        assert (points.max(axis=0) < [61.6, 4.6]).all()
        lengths = [arc_lengths(lanelet.left_line)[-1] for lanelet in drawn]
        found.add("short" if max(lengths) < 26.0 else "long" if min(lengths) > 50.0 else "as is")
        if not all(lanelet.one_way for lanelet in drawn):
            found.add("two-way")
        if len(drawn) == 1:
            found.add("shared")
        if all(border.marking == "virtual" for each in drawn for border in each.right):
            found.add("no curbs")
    assert found == {"short", "long", "as is", "two-way", "shared", "no curbs"}


def moving_track(frames: int = 400) -> Track:
    """A bicycle that rides eastwards at 5 m/s, 20 Hz."""
    x = 5.0 * np.arange(frames) / 20.0
    velocity = np.tile([5.0, 0.0], (frames, 1))
    return Track(
        kind="bicycle", length_m=2.0, width_m=0.6, first_frame=7,
        xy=np.stack([x, np.zeros(frames)], axis=1), heading_rad=np.zeros(frames),
        velocity_mps=velocity, acceleration_mps2=np.zeros((frames, 2)),
    )  # fmt: skip


def tracker(**changes: float) -> Tracker:
    """A tracker without gaps and wrong classes."""
    usual = {
        "seed": 0, "frame_rate_hz": 20.0, "position_m": 0.1, "slow_share": 0.5,
        "correlation_s": 1.0, "heading_rad": 0.02, "standstill": 0.2, "wobble_rad": 0.0,
        "window_s": 0.0, "velocity_window_s": 0.5, "gaps_per_minute": 0.0, "wrong_class": 0.0,
    }  # fmt: skip
    return Tracker(**{**usual, **changes})  # pyright: ignore[reportArgumentType]


def test_errors_have_the_drawn_deviations() -> None:
    """Over 60 tracks of 20 s the deviations are 0.1 m and 0.02 rad, half of the variance slow.

    At a lag of 1 s, one correlation time, the slow half keeps e⁻¹: 0.5 · 0.37 = 0.18 of the whole.
    """
    true = [moving_track() for _ in range(60)]
    seen = observe(tracker(), true)
    errors = np.stack([track.xy - moving_track().xy for track in seen])
    assert errors.std() == pytest.approx(0.1, rel=0.05)
    assert np.stack([t.heading_rad for t in seen]).std() == pytest.approx(0.02, rel=0.1)
    lagged = np.mean(errors[:, 20:] * errors[:, :-20]) / errors.var()
    assert lagged == pytest.approx(0.18, abs=0.05)
    factors = [track.length_m / 2.0 for track in seen]
    assert 0.85 - 0.01 < min(factors) < 0.9 < 1.1 < max(factors) < 1.15 + 0.01


def test_headings_wobble_only_at_standstill() -> None:
    """A wobble of 0.2 rad: none at 5 m/s, 0.2 rad at rest."""
    moves = moving_track()
    stands = Track(
        kind="car", length_m=4.5, width_m=1.8, first_frame=0, xy=np.zeros((4000, 2)),
        heading_rad=np.zeros(4000), velocity_mps=np.zeros((4000, 2)),
        acceleration_mps2=np.zeros((4000, 2)),
    )  # fmt: skip
    wobbling = tracker(heading_rad=0.0, wobble_rad=0.2)
    first, second = observe(wobbling, [moves, stands])
    assert np.abs(first.heading_rad).max() == 0.0
    assert second.heading_rad.std() == pytest.approx(0.2, rel=0.25)


def test_gaps_are_filled_or_cut_the_track() -> None:
    """Parts of a track do not share frames; the later ones stand behind all first ones."""
    true = [moving_track() for _ in range(30)]
    seen = observe(tracker(gaps_per_minute=6.0, position_m=0.02), true)
    assert len(seen) > 30
    assert sum(len(track.xy) for track in seen) < 30 * 400
    assert all(track.first_frame == 7 for track in seen[:30])
    assert all(track.first_frame > 7 for track in seen[30:])
    for part in seen[30:]:
        expected = 5.0 * (part.first_frame - 7 + np.arange(len(part.xy))) / 20.0
        assert np.abs(part.xy[:, 0] - expected).max() < 0.2


def test_some_bicycles_become_motorcycles() -> None:
    """A share of 0.08 of 400 bicycles is 32, with a standard deviation of 5."""
    seen = observe(tracker(wrong_class=0.08), [moving_track(30) for _ in range(400)])
    assert 15 < sum(track.kind == "motorcycle" for track in seen) < 50


def test_trackers_cover_all_frame_rates() -> None:
    """100 trackers have all five rates, and deviations within the ranges."""
    drawn = [draw_tracker(np.random.default_rng(seed)) for seed in range(100)]
    assert {each.frame_rate_hz for each in drawn} == set(RANGES.tracker.frame_rates_hz)
    low, high = RANGES.tracker.position_m
    assert all(low <= each.position_m <= high for each in drawn)
    assert all(each.velocity_window_s >= each.window_s for each in drawn)

"""Motion of synthetic agents."""

from pathlib import Path

import numpy as np
import pandas as pd

from asp_env.dynamics import inverse, rollout
from asp_env.geometry import boxes_overlap
from scenarios.sumo.demand import SHARES, demand
from scenarios.sumo.sites import crossroads, right_turn_rad

STEP = 5
"""Frames in 0.2 s."""


def vehicles(site: Path, name: str) -> list[pd.DataFrame]:
    """The tracks of all moving vehicles with two axles."""
    meta = pd.read_csv(site / "data" / f"{name}_tracksMeta.csv")
    tracks = pd.read_csv(site / "data" / f"{name}_tracks.csv")
    ids = meta.trackId[~meta["class"].isin(["pedestrian", "bicycle"])]
    kept = (track for key, track in tracks.groupby("trackId") if key in set(ids))
    return [track for track in kept if track.lonVelocity.abs().max() > 0.1]


def states_of(track: pd.DataFrame) -> np.ndarray:
    """[x, y, heading, speed] as the motion model defines them."""
    speed = np.hypot(track.xVelocity, track.yVelocity) * np.sign(track.lonVelocity)
    return np.column_stack([track.xCenter, track.yCenter, np.radians(track.heading), speed])


def test_inferred_actions_lead_back_to_the_log(site: Path) -> None:
    """99 % of vehicle windows drift less than 0.3 m in 6 s; half of them less than 3 cm."""
    drifts = []
    for name in ("00", "01"):
        for track in vehicles(site, name):
            states, length = states_of(track)[::STEP], float(track.length.iloc[0])
            starts = np.arange(0, len(states) - 30, 3)
            windows = states[starts[:, None] + np.arange(31)]
            lengths = np.full(len(starts), length)
            actions = inverse(windows[:, :-1], windows[:, 1:], lengths[:, None] + np.zeros(30), 0.2)
            driven = rollout(windows[:, 0], actions, lengths, 0.2)
            drifts.append(np.hypot(*(driven[:, -1, :2] - windows[:, -1, :2]).T))
    drift = np.concatenate(drifts)
    assert len(drift) > 500
    assert np.percentile(drift, 99) < 0.3
    assert np.median(drift) < 0.03


def test_agents_neither_move_backwards_nor_creep_while_standing(site: Path) -> None:
    """Speed along the heading is never negative; a standing agent stays at one point."""
    standing = 0
    for name in ("00", "01"):
        for track in vehicles(site, name):
            assert track.lonVelocity.min() >= 0.0
            still = np.flatnonzero(track.lonVelocity.to_numpy()[1:-1] == 0.0) + 1
            xy = track[["xCenter", "yCenter"]].to_numpy()
            assert np.abs(xy[still + 1] - xy[still - 1]).max(initial=0.0) < 0.0005
            standing += len(still)
    assert standing > 100


def test_vehicles_do_not_overlap(site: Path) -> None:
    """No two boxes of vehicles overlap in any fifth frame."""
    for name in ("00", "01"):
        rows = pd.concat(vehicles(site, name))
        poses = [rows.xCenter, rows.yCenter, np.radians(rows.heading)]
        boxes = np.column_stack([*poses, rows.length, rows.width])
        rows = rows.assign(number=np.arange(len(rows)))
        for _, frame in rows[rows.frame % STEP == 0].groupby("frame"):
            a, b = np.triu_indices(len(frame), 1)
            number = frame.number.to_numpy()
            assert not boxes_overlap(boxes[number[a]], boxes[number[b]]).any()


def test_tracks_begin_and_end_at_the_rim(site: Path) -> None:
    """Agents that appear or disappear during a recording do so near the edge of the image."""
    for name in ("00", "01"):
        meta = pd.read_csv(site / "data" / f"{name}_tracksMeta.csv")
        tracks = pd.read_csv(site / "data" / f"{name}_tracks.csv")
        width, height = tracks.xCenter.max(), -tracks.yCenter.min()
        for number, first, last in meta[["trackId", "initialFrame", "finalFrame"]].to_numpy():
            track = tracks[tracks.trackId == number]
            for end in [0] * int(first > 0) + [-1] * int(last < 2999):
                x, y = track.xCenter.iloc[end], -track.yCenter.iloc[end]
                assert min(x, y, width - x, height - y) < 5.0


def test_all_turns_occur(site: Path) -> None:
    """Vehicles go right (over 45°), straight on and left, in each recording."""
    for name in ("00", "01"):
        heading = [np.unwrap(np.radians(track.heading)) for track in vehicles(site, name)]
        turned = np.degrees([angle[-1] - angle[0] for angle in heading])
        assert min((turned < -45).sum(), (np.abs(turned) < 45).sum(), (turned > 45).sum()) >= 1


def test_the_demand_has_all_classes() -> None:
    """The demand of an hour has every class, mostly cars, and all pairs of arms."""
    rng = np.random.default_rng(0)
    place = crossroads(rng)
    wanted = demand(rng, place, 3600.0)
    kinds = [user.kind for user in wanted.users.values()]
    assert set(kinds) == {*SHARES, "pedestrian"}
    assert kinds.count("car") > len(kinds) / 2
    pairs = [(a, b) for a in place.arms for b in place.arms if a is not b]
    assert all(f'from="{a.enter}" to="{b.leave}"' in wanted.routes for a, b in pairs)
    assert len({round(right_turn_rad(a.angle_rad, b.angle_rad), 6) for a, b in pairs}) == len(pairs)


def test_removing_an_agent_leaves_the_others_unchanged() -> None:
    """Only the agent's entry is missing in the demand."""
    rng = np.random.default_rng(1)
    wanted = demand(rng, crossroads(rng), 300.0)
    fewer = wanted.without({"v3"})
    assert len(fewer.entries) == len(wanted.entries) - 1
    assert 'id="v3"' not in fewer.routes
    assert [e for e in wanted.entries if e[1] != "v3"] == list(fewer.entries)

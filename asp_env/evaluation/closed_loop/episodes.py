"""How much like the recording the simulated traffic of some drives was.

MERGED: Driving many episodes at once, and what is kept of them.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from asp_env.data.predictor import Forecast, Predictor, fill_missing
from asp_env.data.rollout import Rollout
from asp_env.data.scenarios.scenario import Scenario
from asp_env.data.scene import EGO, Scene
from asp_env.metrics.driving.map_context import map_context
from asp_env.metrics.driving.realism import realism, realism_features
from asp_env.metrics.driving.rules import Rules
from asp_env.metrics.driving.scores import (
    COMPLIANT_M,
    OVERSPEED_MPS,
    EpisodeRecord,
    against_traffic_in_window_m,
    at_fault,
    overspeed_mps,
)
from asp_env.metrics.driving.ttc import time_to_collision
from asp_env.metrics.masked import Masked
from asp_env.planning.planner import Plan, Planner
from asp_env.sim.simulation import Simulation, ending
from asp_env.sim.traffic.assignment import TrafficSpec, make_traffic
from asp_env.sim.world import Ending, Events, ReplayWorld, World, recorded_future


def traffic_realism(world: World, active: Bool[np.ndarray, "b t"]) -> dict[str, Masked]:
    """`realism` (b,) of each episode's traffic, simulated once; missing where all was replayed.

    Of the agents present at the first tick, but the ego, those count that ever were elsewhere than
    in their log.
    """
    episodes = world.episodes
    found: dict[str, list[Masked]] = {}
    for b, count in enumerate(active.sum(axis=1).tolist()):
        ticks = slice(world.history, world.history + count)
        states, valid = episodes.states[b, ticks], episodes.valid[b, ticks]
        logged, there = episodes.log_states[b, ticks], episodes.log_valid[b, ticks]
        differs = ((states != logged).any(axis=-1) | (valid != there)).any(axis=0)
        asked = differs & valid[0]
        asked[EGO] = False
        about = (
            episodes.sizes[b],
            world.recordings[int(episodes.recording[b])].road_map,
            asked,
            world.dt_s,
        )
        simulated = realism_features(states, valid, *about)
        for name, each in realism(realism_features(logged, there, *about), [simulated]).items():
            found.setdefault(name, []).append(each)
    return {
        name: Masked(
            value=np.concatenate([each.value for each in parts]),
            valid=np.concatenate([each.valid for each in parts]),
        )
        for name, parts in found.items()
    }


FORECAST_WITHIN_M = 60.0
"""Agents further from the ego than this are not forecast."""

EVENTS = ("collision", "at-fault collision", "off-road", "short TTC", "wrong way", "speeding")
"""What rollouts mark. An at-fault collision where it begins, the wrong way where over 2 m of it are
driven within 1 s, speeding where the limit is exceeded by over 2.23 m/s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """What was forecast and planned at one tick of all episodes."""

    running: Bool[np.ndarray, " b"]
    forecast: Forecast
    plan: Plan


@dataclass(frozen=True, slots=True, kw_only=True)
class DrivenEpisodes:
    """Episodes that have been driven, side by side, with everything that was said on the way."""

    drives: EpisodeRecord
    realism: Mapping[str, Masked]
    """Of the traffic; missing where it was replayed."""
    endings: Int[np.ndarray, " b"]
    rollouts: tuple[Rollout, ...]


def drive_episodes(
    recordings: Sequence[Any],  # of Recording: checking its items at run time opens them
    scenarios: Sequence[Scenario],
    planner: Planner,
    predictor: Predictor,
    *,
    preset: Rules,
    traffic: TrafficSpec | None,
    kind: type[World] = ReplayWorld,
    horizon: int,
    history: int,
    dt_s: float,
) -> DrivenEpisodes:
    """Drives every scenario to its end, all at once: one forecast and one plan call per tick.

    A planner that is privileged is the logged driver: the world replays its ego. What costs more
    than contacts and the road is measured at the end, of all ticks at once, as `preset` has it.
    """
    simulation = Simulation(
        recordings,
        make_traffic(traffic, dt_s=dt_s, default=kind.traffic),
        num_episodes=len(scenarios),
        dt_s=dt_s,
        history=history,
        world_class=kind,
    )
    world = simulation.world
    generators = [np.random.default_rng(scenario.seed) for scenario in scenarios]
    simulation.reset(scenarios, generators)
    events = [world.events()]
    said: list[Decision] = []
    endings = np.zeros(len(scenarios), dtype=np.int64)
    active = [np.ones(len(scenarios), dtype=bool)]
    while (endings == Ending.RUNNING).any():
        running = endings == Ending.RUNNING
        actions = np.zeros((len(scenarios), 2), dtype=np.float32)
        if not planner.privileged:
            said.append(_decide(world, running, planner, predictor, horizon))
            actions = said[-1].plan.actions[:, 0].astype(np.float32)
        simulation.step(actions, running & (not planner.privileged))
        events.append(world.events())
        active.append(running)
        endings = np.where(running, ending(events[-1]), endings)
    drives = _measure(world, events, np.stack(active, axis=1), preset)
    return _collect(world, scenarios, drives, preset, said, endings)


def _decide(
    world: World,
    running: Bool[np.ndarray, " b"],
    planner: Planner,
    predictor: Predictor,
    horizon: int,
) -> Decision:
    scene = world.scene()
    scene = scene.with_targets(_near(scene, running))
    future = recorded_future(world, scene, horizon) if predictor.privileged else None
    forecast = predictor.predict(scene, future)
    forecast = dataclasses.replace(  # all plan equally far, whatever their predictor can
        forecast,
        states=forecast.states[:, :, :horizon],
        actions=forecast.actions[:, :, :horizon],
    )
    forecast = fill_missing(forecast, scene)
    return Decision(running=running, forecast=forecast, plan=planner.plan(scene, forecast))


def _near(scene: Scene, running: Bool[np.ndarray, " b"]) -> Int[np.ndarray, "t 2"]:
    situation, slot = scene.targets[:, 0], scene.targets[:, 1]
    egos = scene.states[situation, EGO, -1, :2]
    away = np.linalg.norm(scene.states[situation, slot, -1, :2] - egos, axis=-1)
    return scene.targets[(away <= FORECAST_WITHIN_M) & running[situation]]


def _measure(
    world: World,
    events: Sequence[Events],
    active: Bool[np.ndarray, "b t"],
    preset: Rules,
) -> EpisodeRecord:
    episodes = world.episodes
    ticks = slice(world.history, world.history + len(events))
    states, valid = episodes.states[:, ticks], episodes.valid[:, ticks]
    contacts = np.stack([each.contacts for each in events], axis=1)
    off_road_m = np.stack([each.off_road_m for each in events], axis=1)
    limits = [world.recordings[int(i)].speed_limit_mps for i in episodes.recording]
    found = map_context(
        *world.maps(),
        states[:, :, EGO],
        episodes.sizes[:, EGO],
        [route[there] for route, there in zip(episodes.route, episodes.route_valid, strict=True)],
        Masked(
            value=np.array([limit or 0.0 for limit in limits]),
            valid=np.array([limit is not None for limit in limits]),
        ),
    )
    return EpisodeRecord(
        states=states[:, :, EGO],
        log_states=episodes.log_states[:, ticks, EGO],
        contacts=contacts,
        off_road_m=off_road_m,
        ttc_s=time_to_collision(
            states,
            valid,
            episodes.sizes,
            contacts=contacts,
            ignored=episodes.own_trailer,
            wide_sector=found.several_lanes | found.at_crossing | (off_road_m > preset.off_road_m),
            num_ticks=active.sum(axis=1),
            rule=preset.ttc,
            dt_s=world.dt_s,
        ),
        route_m=np.stack([each.route_m for each in events], axis=1),
        route_offset_m=np.stack([each.route_offset_m for each in events], axis=1),
        goal_m=events[0].goal_m,
        map_context=found,
        active=active,
        dt_s=world.dt_s,
    )


def _collect(
    world: World,
    scenarios: Sequence[Scenario],
    drives: EpisodeRecord,
    preset: Rules,
    said: Sequence[Decision],
    endings: Int[np.ndarray, " b"],
) -> DrivenEpisodes:
    over = overspeed_mps(drives)
    flags = np.stack(
        [
            (drives.contacts > 0).any(axis=2),
            at_fault(drives, preset),
            drives.off_road_m > preset.off_road_m,
            drives.ttc_s <= preset.ttc.min_ttc_s,
            against_traffic_in_window_m(drives) > COMPLIANT_M,
            over.valid & (over.value > OVERSPEED_MPS),
        ],
        axis=-1,
    )
    rollouts = tuple(
        _rollout(world, scenario, b, int(drives.active[b].sum()), flags[b], said)
        for b, scenario in enumerate(scenarios)
    )
    return DrivenEpisodes(
        drives=drives,
        realism=traffic_realism(world, drives.active),
        endings=endings,
        rollouts=rollouts,
    )


def _rollout(
    world: World,
    scenario: Scenario,
    b: int,
    count: int,
    flags: Bool[np.ndarray, "t kinds"],
    said: Sequence[Decision],
) -> Rollout:
    episodes = world.episodes
    ticks = slice(world.history, world.history + count)
    agents = int((episodes.ids[b] >= 0).sum())
    told = [(k, each) for k, each in enumerate(said) if each.running[b]]
    rows = [
        (k, each.forecast, np.flatnonzero(each.forecast.targets[:, 0] == b)) for k, each in told
    ]
    modes, steps = said[0].forecast.states.shape[1:3] if said else (1, 1)
    return Rollout(
        scenario=scenario,
        dt_s=world.dt_s,
        states=episodes.states[b, ticks, :agents],
        valid=episodes.valid[b, ticks, :agents],
        log_states=episodes.log_states[b, ticks, :agents],
        log_valid=episodes.log_valid[b, ticks, :agents],
        sizes=episodes.sizes[b, :agents],
        classes=episodes.classes[b, :agents],
        ids=episodes.ids[b, :agents],
        route=episodes.route[b, episodes.route_valid[b]],
        plans=np.stack([each.plan.states[b, :, :2] for _, each in told])
        if told
        else np.zeros((0, 1, 2), dtype=np.float32),
        forecast_states=np.concatenate(
            [np.zeros((0, modes, steps, 2), dtype=np.float32)]
            + [forecast.states[at, ..., :2] for _, forecast, at in rows]
        ),
        forecast_log_probs=np.concatenate(
            [np.zeros((0, modes), dtype=np.float32)]
            + [forecast.log_probs[at] for _, forecast, at in rows]
        ),
        forecast_slots=np.concatenate(
            [np.zeros(0, dtype=np.int64)] + [forecast.targets[at, 1] for _, forecast, at in rows]
        ),
        forecast_ticks=np.concatenate(
            [np.zeros(0, dtype=np.int64)] + [np.full(len(at), k) for k, _, at in rows]
        ),
        events=flags[:count],
        event_names=EVENTS,
    )

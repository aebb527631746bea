"""Driving many episodes at once, and what is kept of them."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.forecast import Forecast, fill_missing
from asp_env.data.predictor import Predictor
from asp_env.data.rollout import Rollout
from asp_env.data.scenario import Scenario
from asp_env.data.scene import Scene
from asp_env.data.source import Recordings
from asp_env.metrics.boxes import time_to_collision
from asp_env.metrics.drivable import OFF_ROAD_M
from asp_env.metrics.driving import MIN_TTC_S, Drives
from asp_env.planning.planner import Plan, Planner
from asp_env.sim.recorded import recorded_future
from asp_env.sim.replay import ReplayWorld
from asp_env.sim.simulation import Simulation, ending
from asp_env.sim.traffic import TrafficSpec, make_traffic
from asp_env.sim.world import EGO, Ending, Events

FORECAST_WITHIN_M = 60.0
"""Agents further from the ego than this are not forecast."""

EVENTS = ("collision", "at-fault collision", "off-road", "TTC under 0.95 s")


@dataclass(frozen=True, slots=True, kw_only=True)
class Said:
    """What was forecast and planned at one tick of all episodes."""

    running: Bool[np.ndarray, " b"]
    forecast: Forecast
    plan: Plan


@dataclass(frozen=True, slots=True, kw_only=True)
class Driven:
    """Episodes that have been driven, side by side, with everything that was said on the way."""

    drives: Drives
    endings: Int[np.ndarray, " b"]
    rollouts: tuple[Rollout, ...]


def drive_episodes(
    recordings: Recordings,
    scenarios: Sequence[Scenario],
    planner: Planner,
    predictor: Predictor,
    *,
    traffic: TrafficSpec,
    horizon: int,
    history: int,
    dt_s: float,
) -> Driven:
    """Drives every scenario to its end, all at once: one forecast and one plan call per tick.

    A planner that is privileged is the logged driver: the world replays its ego.
    """
    driver = make_traffic(traffic, dt_s=dt_s)
    simulation = Simulation(
        recordings, driver, num_episodes=len(scenarios), dt_s=dt_s, history=history
    )
    world = simulation.world
    generators = [np.random.default_rng(scenario.seed) for scenario in scenarios]
    simulation.reset(scenarios, generators)
    events = [world.events()]
    ttc = [_ttc(world, events[-1])]
    said: list[Said] = []
    endings = np.zeros(len(scenarios), dtype=np.int64)
    lasted = [np.ones(len(scenarios), dtype=bool)]
    while (endings == Ending.RUNNING).any():
        running = endings == Ending.RUNNING
        actions = np.zeros((len(scenarios), 2), dtype=np.float32)
        if not planner.privileged:
            said.append(_decide(world, running, planner, predictor, horizon))
            actions = said[-1].plan.actions[:, 0].astype(np.float32)
        simulation.step(actions, running & (not planner.privileged))
        events.append(world.events())
        ttc.append(_ttc(world, events[-1]))
        lasted.append(running)
        endings = np.where(running, ending(events[-1]), endings)
    return _collect(world, scenarios, events, ttc, lasted, said, endings)


def _decide(
    world: ReplayWorld,
    running: Bool[np.ndarray, " b"],
    planner: Planner,
    predictor: Predictor,
    horizon: int,
) -> Said:
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
    return Said(running=running, forecast=forecast, plan=planner.plan(scene, forecast))


def _near(scene: Scene, running: Bool[np.ndarray, " b"]) -> Int[np.ndarray, "t 2"]:
    situation, slot = scene.targets[:, 0], scene.targets[:, 1]
    egos = scene.states[situation, EGO, -1, :2]
    away = np.linalg.norm(scene.states[situation, slot, -1, :2] - egos, axis=-1)
    return scene.targets[(away <= FORECAST_WITHIN_M) & running[situation]]


def _ttc(world: ReplayWorld, events: Events) -> Float[np.ndarray, " b"]:
    episodes, rows = world.episodes, np.arange(len(world))
    return time_to_collision(
        np.ascontiguousarray(episodes.states[rows, world.now]),
        episodes.sizes,
        np.ascontiguousarray(episodes.valid[rows, world.now]),
        (events.contacts > 0) | episodes.own_trailer,
    )


def _collect(
    world: ReplayWorld,
    scenarios: Sequence[Scenario],
    events: Sequence[Events],
    ttc: Sequence[Float[np.ndarray, " b"]],
    lasted: Sequence[Bool[np.ndarray, " b"]],
    said: Sequence[Said],
    endings: Int[np.ndarray, " b"],
) -> Driven:
    episodes = world.episodes
    ticks = slice(world.history, world.history + len(events))
    drives = Drives(
        states=episodes.states[:, ticks, EGO],
        log_states=episodes.log_states[:, ticks, EGO],
        contacts=np.stack([each.contacts for each in events], axis=1),
        off_road_m=np.stack([each.off_road_m for each in events], axis=1),
        ttc_s=np.stack(ttc, axis=1),
        route_m=np.stack([each.route_m for each in events], axis=1),
        goal_m=events[0].goal_m,
        lasted=np.stack(lasted, axis=1),
        dt_s=world.dt_s,
    )
    flags = np.stack(
        [
            (drives.contacts > 0).any(axis=2),
            np.stack([each.at_fault for each in events], axis=1),
            drives.off_road_m > OFF_ROAD_M,
            drives.ttc_s < MIN_TTC_S,
        ],
        axis=-1,
    )
    rollouts = tuple(
        _rollout(world, scenario, b, int(drives.lasted[b].sum()), flags[b], said)
        for b, scenario in enumerate(scenarios)
    )
    return Driven(drives=drives, endings=endings, rollouts=rollouts)


def _rollout(
    world: ReplayWorld,
    scenario: Scenario,
    b: int,
    count: int,
    flags: Bool[np.ndarray, "t kinds"],
    said: Sequence[Said],
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

"""Episodes driven side by side by one method, and what is measured of them."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.predictor import Forecast, Predictor, fill_missing, needs_simulation
from asp_env.data.rollout import Rollout
from asp_env.data.scenarios.scenario import Scenario
from asp_env.data.scene import EGO, Scene
from asp_env.data.snippets import Future
from asp_env.evaluation.closed_loop.containment import Containment, Fault, coasting_plan
from asp_env.evaluation.closed_loop.forecast_quality import forecast_quality
from asp_env.metrics.drivable import OFF_ROAD_M
from asp_env.metrics.driving.cost import log_route_m
from asp_env.metrics.driving.map_context import map_context
from asp_env.metrics.driving.margins import (
    bounded_ttc_s,
    near_misses,
    required_deceleration,
)
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
from asp_env.sim.simulated_future import simulated_future
from asp_env.sim.simulation import Simulation, ending
from asp_env.sim.traffic.assignment import TrafficSpec, make_traffic
from asp_env.sim.world import Ending, Events, ReplayWorld, World, recorded_future

FORECAST_WITHIN_M = 60.0
"""Agents farther from the ego than this are not forecast. Chosen by hand."""

EVENTS = ("collision", "at-fault collision", "off-road", "short TTC", "wrong way", "speeding")
"""Events that rollouts mark at every tick. An at-fault collision is marked at its first tick, the
wrong way where the ego drives over 2 m against the traffic within 1 s, and speeding where it
exceeds the limit by over 2.23 m/s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeSettings:
    """Settings that all episodes of a comparison share."""

    rules: Rules
    traffic: TrafficSpec | None
    """Drivers of the other agents; None for the default of the world."""
    world: type[World] = ReplayWorld
    horizon: int
    """Number of ticks of every forecast and plan."""
    history: int
    """Number of ticks of history; a predictor that needs more is shown more."""
    dt_s: float
    contain_faults: bool = False
    """Whether a faulty predictor or planner is filled in for by constant velocity, and its episodes
    are marked, instead of raising; see `asp_env.evaluation.closed_loop.containment`."""
    budget_ms: float | None = None
    """Largest wall time of a forecast and of a plan, with `contain_faults`; None for no limit."""
    measure_forecasts: bool = False
    """Whether the forecasts are measured, see `asp_env.evaluation.closed_loop.forecast_quality`;
    they are then made while an expert is replayed, too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """Forecast and plan at one tick of B episodes."""

    running: Bool[np.ndarray, " b"]
    """Mask of the episodes that have not ended."""
    forecast: Forecast
    plan: Plan


@dataclass(frozen=True, slots=True, kw_only=True)
class DrivenEpisodes:
    """B episodes that have ended."""

    drives: EpisodeRecord
    realism: Mapping[str, Masked]
    """Realism of the traffic (b,); missing where it was replayed."""
    fallback: Masked
    """Share of the forecasts (b,) that a guard has blended to constant velocity, over all targets
    and ticks of an episode; missing for a predictor without a guard."""
    endings: Int[np.ndarray, " b"]
    """`Ending` of each episode."""
    rollouts: tuple[Rollout, ...]
    faults: tuple[Fault | None, ...]
    """The first fault of each episode; None for one without."""
    forecasts: Mapping[str, Masked]
    """Measures of the forecasts (b,), if they are measured."""


def drive_episodes(
    recordings: Sequence[Any],  # of Recording: checking its items at run time opens them
    scenarios: Sequence[Scenario],
    planner: Planner,
    predictor: Predictor,
    settings: EpisodeSettings,
) -> DrivenEpisodes:
    """Drives all scenarios to their ends, side by side: one forecast and one plan per tick.

    If the planner is privileged, the world replays the logged egos instead. Contacts and the
    drivable area end episodes, so they are measured at every tick; all else is measured at the
    end, for all ticks at once.

    Args:
        recordings: DATA.
        scenarios: B scenarios.
        planner: drives the egos.
        predictor: forecasts the agents near running egos.
        settings: settings of the episodes.
    """
    simulation = Simulation(
        recordings,
        make_traffic(settings.traffic, dt_s=settings.dt_s, default=settings.world.traffic),
        num_episodes=len(scenarios),
        dt_s=settings.dt_s,
        history=max(settings.history, predictor.history),
        world_class=settings.world,
    )
    world = simulation.world
    generators = [np.random.default_rng(scenario.seed) for scenario in scenarios]
    simulation.reset(scenarios, generators)
    events = [world.events()]
    decisions: list[Decision] = []
    endings = np.zeros(len(scenarios), dtype=np.int64)
    active = [np.ones(len(scenarios), dtype=bool)]
    containment = None
    if settings.contain_faults:
        containment = Containment(len(scenarios), budget_ms=settings.budget_ms)
    while (endings == Ending.RUNNING).any():
        running = endings == Ending.RUNNING
        actions = np.zeros((len(scenarios), 2), dtype=np.float32)
        if not planner.privileged or settings.measure_forecasts:
            last_plan = decisions[-1].plan if decisions else None
            decisions.append(
                _decide(
                    simulation,
                    running,
                    (planner, predictor),
                    settings.horizon,
                    last_plan,
                    containment,
                )
            )
        if not planner.privileged:
            actions = decisions[-1].plan.actions[:, 0].astype(np.float32)
        simulation.step(actions, running & (not planner.privileged))
        events.append(world.events())
        active.append(running)
        endings = np.where(running, ending(events[-1]), endings)
    drives = _measure(world, events, np.stack(active, axis=1), settings.rules)
    flags = _event_flags(drives, settings.rules)
    made = [decision.forecast for decision in decisions]
    return DrivenEpisodes(
        drives=drives,
        realism=traffic_realism(world, drives.active),
        fallback=fallback_share(made, len(scenarios)),
        forecasts=_measured(world, made, drives.active) if settings.measure_forecasts else {},
        endings=endings,
        faults=(None,) * len(scenarios) if containment is None else tuple(containment.faults),
        rollouts=tuple(
            _rollout(world, scenario, b, int(drives.active[b].sum()), flags[b], decisions)
            for b, scenario in enumerate(scenarios)
        ),
    )


def _measured(
    world: World, forecasts: Sequence[Forecast], active: Bool[np.ndarray, "b t"]
) -> dict[str, Masked]:
    """Measures of the forecasts, by what happens in the episodes."""
    ticks = slice(world.history, world.history + active.shape[1])
    valid = world.episodes.valid[:, ticks] & active[..., None]
    return forecast_quality(forecasts, world.episodes.states[:, ticks], valid)


def _decide(
    simulation: Simulation,
    running: Bool[np.ndarray, " b"],
    method: tuple[Planner, Predictor],
    horizon: int,
    last_plan: Plan | None,
    containment: Containment | None,
) -> Decision:
    planner, predictor = method
    scene = simulation.world.scene()
    scene = scene.with_targets(targets_near_egos(scene, running))
    future = None
    if needs_simulation(predictor):
        actions = continued_actions(last_plan, len(running), horizon)
        future = simulated_future(simulation, scene, actions, running)
    elif predictor.privileged:
        future = recorded_future(simulation.world, scene, horizon)
    if containment is None:
        forecast = forecast_for_planner(predictor, scene, future, horizon)
    else:
        given = future if predictor.privileged else None
        made = containment.predict(predictor, scene, given, running)
        forecast = fill_missing(_cut(made, horizon), scene)
    if planner.privileged:
        plan = coasting_plan(scene, horizon)
    elif containment is None:
        plan = planner.plan(scene, forecast)
    else:
        plan = containment.plan(planner, scene, forecast, running)
    if containment is not None:
        containment.next_tick()
    return Decision(running=running, forecast=forecast, plan=plan)


def continued_actions(
    last_plan: Plan | None, num_episodes: int, horizon: int
) -> Float[np.ndarray, "b horizon 2"]:
    """The actions that carry on with the plans of the last tick.

    Args:
        last_plan: the plans, whose first action has been executed; None before the first plans.
        num_episodes: B.
        horizon: number of actions. The last action of a plan is repeated.

    Returns:
        [acceleration m/s², steering rad]; zeros, which is constant speed, without plans.
    """
    if last_plan is None:
        return np.zeros((num_episodes, horizon, 2), dtype=np.float32)
    ticks = np.minimum(1 + np.arange(horizon), last_plan.actions.shape[1] - 1)
    return last_plan.actions[:, ticks].astype(np.float32)


def forecast_for_planner(
    predictor: Predictor, scene: Scene, future: Future | None, horizon: int
) -> Forecast:
    """The forecast that a planner plans with: of every target, and over the planner's horizon.

    Args:
        predictor: the predictor.
        scene: the scene.
        future: recorded future of the targets; only privileged predictors receive it.
        horizon: number of ticks; longer forecasts are cut, so that plans are equally long.
    """
    forecast = predictor.predict(scene, future if predictor.privileged else None)
    return fill_missing(_cut(forecast, horizon), scene)


def _cut(forecast: Forecast, horizon: int) -> Forecast:
    return dataclasses.replace(
        forecast,
        states=forecast.states[:, :, :horizon],
        actions=forecast.actions[:, :, :horizon],
    )


def targets_near_egos(scene: Scene, running: Bool[np.ndarray, " b"]) -> Int[np.ndarray, "t 2"]:
    """The targets of a scene that are within `FORECAST_WITHIN_M` of the ego.

    Args:
        scene: the scene.
        running: mask of the situations whose targets are returned.
    """
    situation, slot = scene.targets[:, 0], scene.targets[:, 1]
    egos = scene.states[situation, EGO, -1, :2]
    distance_m = np.linalg.norm(scene.states[situation, slot, -1, :2] - egos, axis=-1)
    return scene.targets[(distance_m <= FORECAST_WITHIN_M) & running[situation]]


def _measure(
    world: World,
    events: Sequence[Events],
    active: Bool[np.ndarray, "b t"],
    rules: Rules,
) -> EpisodeRecord:
    episodes = world.episodes
    ticks = slice(world.history, world.history + len(events))
    states, valid = episodes.states[:, ticks], episodes.valid[:, ticks]
    contacts = np.stack([each.contacts for each in events], axis=1)
    off_road_m = np.stack([each.off_road_m for each in events], axis=1)
    limits = [world.recordings[int(i)].speed_limit_mps for i in episodes.recording]
    context = map_context(
        *world.maps(),
        states[:, :, EGO],
        episodes.sizes[:, EGO],
        [route[mask] for route, mask in zip(episodes.route, episodes.route_valid, strict=True)],
        Masked(
            value=np.array([limit or 0.0 for limit in limits]),
            valid=np.array([limit is not None for limit in limits]),
        ),
    )
    lane_is_ambiguous = context.several_lanes | context.at_crossing
    agents = (states, valid, episodes.sizes)
    shared: dict[str, Any] = {
        "contacts": contacts,
        "ignored": episodes.own_trailer,
        "num_ticks": active.sum(axis=1),
        "dt_s": world.dt_s,
    }
    margins: dict[str, Any] = shared | {
        "wide_sector": lane_is_ambiguous | (off_road_m > OFF_ROAD_M)
    }
    return EpisodeRecord(
        states=states[:, :, EGO],
        log_states=episodes.log_states[:, ticks, EGO],
        contacts=contacts,
        off_road_m=off_road_m,
        ttc_s=time_to_collision(
            *agents,
            wide_sector=lane_is_ambiguous | (off_road_m > rules.off_road_m),
            rule=rules.ttc,
            **shared,
        ),
        route_m=np.stack([each.route_m for each in events], axis=1),
        route_offset_m=np.stack([each.route_offset_m for each in events], axis=1),
        goal_m=events[0].goal_m,
        log_route_m=log_route_m(
            episodes.route, episodes.route_valid, episodes.log_states[:, world.history :, EGO]
        ),
        scenario_ticks=episodes.length.copy(),
        near_miss=near_misses(*agents, ignored=episodes.own_trailer),
        bounded_ttc_s=bounded_ttc_s(*agents, **margins),
        required_mps2=required_deceleration(*agents, **margins),
        map_context=context,
        active=active,
        dt_s=world.dt_s,
    )


def fallback_share(forecasts: Sequence[Forecast], num_episodes: int) -> Masked:
    """Share of the forecasts of each episode that are blended to constant velocity.

    Args:
        forecasts: the forecasts at all ticks.
        num_episodes: B.

    Returns:
        Shares (b,) of the targets that the predictor forecasts, over all ticks; missing for
        episodes without any, and for a predictor without a guard.
    """
    targets, blended = np.zeros(num_episodes), np.zeros(num_episodes)
    for forecast in forecasts:
        if forecast.fallback is not None:
            episode = forecast.targets[:, 0]
            made = np.isfinite(forecast.fallback)
            targets += np.bincount(episode[made], minlength=num_episodes)
            blended += np.bincount(episode[forecast.fallback > 0], minlength=num_episodes)
    return Masked(value=blended / np.maximum(targets, 1), valid=targets > 0)


def traffic_realism(world: World, active: Bool[np.ndarray, "b t"]) -> dict[str, Masked]:
    """Realism of the simulated traffic of each episode; missing where all agents were replayed.

    It is computed over the agents, except the ego, that are present at the first tick and differ
    from their logs at any later one.

    Args:
        world: B episodes that have ended.
        active: mask of the ticks before each episode's end.

    Returns:
        Values (b,) by name, see `asp_env.metrics.driving.realism`.
    """
    episodes = world.episodes
    by_name: dict[str, list[Masked]] = {}
    for b, count in enumerate(active.sum(axis=1).tolist()):
        ticks = slice(world.history, world.history + count)
        states, valid = episodes.states[b, ticks], episodes.valid[b, ticks]
        log_states, log_valid = episodes.log_states[b, ticks], episodes.log_valid[b, ticks]
        differs = ((states != log_states).any(axis=-1) | (valid != log_valid)).any(axis=0)
        simulated = differs & valid[0]
        simulated[EGO] = False
        shared = (
            episodes.sizes[b],
            world.recordings[int(episodes.recording[b])].road_map,
            simulated,
            world.dt_s,
        )
        sample = realism_features(states, valid, *shared)
        for name, each in realism(
            realism_features(log_states, log_valid, *shared), [sample]
        ).items():
            by_name.setdefault(name, []).append(each)
    return {
        name: Masked(
            value=np.concatenate([each.value for each in parts]),
            valid=np.concatenate([each.valid for each in parts]),
        )
        for name, parts in by_name.items()
    }


def _event_flags(drives: EpisodeRecord, rules: Rules) -> Bool[np.ndarray, "b t kinds"]:
    """Mask of the ticks of each of `EVENTS`."""
    over = overspeed_mps(drives)
    return np.stack(
        [
            (drives.contacts > 0).any(axis=2),
            at_fault(drives, rules),
            drives.off_road_m > rules.off_road_m,
            drives.ttc_s <= rules.ttc.min_ttc_s,
            against_traffic_in_window_m(drives) > COMPLIANT_M,
            over.valid & (over.value > OVERSPEED_MPS),
        ],
        axis=-1,
    )


def _with_modes(forecast: Forecast, modes: int) -> Forecast:
    """The same forecast with a number of modes: the first one is divided into equal ones.

    A forecast that is filled in has fewer modes than the predictor's own.
    """
    missing = modes - forecast.states.shape[1]
    if not missing:
        return forecast
    index = np.r_[np.zeros(missing, dtype=np.int64), np.arange(forecast.states.shape[1])]
    log_probs = forecast.log_probs[:, index].copy()
    log_probs[:, : missing + 1] -= np.log(missing + 1)
    return dataclasses.replace(
        forecast,
        states=forecast.states[:, index],
        actions=forecast.actions[:, index],
        log_probs=log_probs.astype(np.float32),
    )


def _stacked(plans: Sequence[Float[np.ndarray, "_ 2"]]) -> Float[np.ndarray, "plans horizon 2"]:
    """Planned positions of all ticks; shorter plans stay where they end."""
    if not plans:
        return np.zeros((0, 1, 2), dtype=np.float32)
    steps = np.arange(max(len(plan) for plan in plans))
    return np.stack([plan[np.minimum(steps, len(plan) - 1)] for plan in plans])


def _rollout(
    world: World,
    scenario: Scenario,
    b: int,
    count: int,
    flags: Bool[np.ndarray, "t kinds"],
    decisions: Sequence[Decision],
) -> Rollout:
    """The rollout of episode b, which has `count` ticks."""
    episodes = world.episodes
    ticks = slice(world.history, world.history + count)
    agents = int((episodes.ids[b] >= 0).sum())
    made = [(k, decision) for k, decision in enumerate(decisions) if decision.running[b]]
    modes = max((decision.forecast.states.shape[1] for decision in decisions), default=1)
    steps = decisions[0].forecast.states.shape[2] if decisions else 1
    forecasts = [
        (k, forecast, np.flatnonzero(forecast.targets[:, 0] == b))
        for k, decision in made
        for forecast in [_with_modes(decision.forecast, modes)]
    ]
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
        plans=_stacked([decision.plan.states[b, :, :2] for _, decision in made]),
        forecast_states=np.concatenate(
            [np.zeros((0, modes, steps, 2), dtype=np.float32)]
            + [forecast.states[rows, ..., :2] for _, forecast, rows in forecasts]
        ),
        forecast_log_probs=np.concatenate(
            [np.zeros((0, modes), dtype=np.float32)]
            + [forecast.log_probs[rows] for _, forecast, rows in forecasts]
        ),
        forecast_slots=np.concatenate(
            [np.zeros(0, dtype=np.int64)]
            + [forecast.targets[rows, 1] for _, forecast, rows in forecasts]
        ),
        forecast_ticks=np.concatenate(
            [np.zeros(0, dtype=np.int64)] + [np.full(len(rows), k) for k, _, rows in forecasts]
        ),
        events=flags[:count],
        event_names=EVENTS,
    )

"""Planning regret at logged states: which forecasts lead a planner to worse plans, and by how much.

No drive is needed: the ego is where the recording has it, the planner rates its candidates with
each forecast and with the truth, and the difference is the regret (`planning_regret`). The
truth is the forecast of the predictor `oracle`. Agents that are not present yet are unknown to all
predictors, the oracle included.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from rich.progress import track

from asp_env.data.predictor import Predictor, load_predictor
from asp_env.data.recording import ticks
from asp_env.data.scenarios.scenario import ScenarioSet
from asp_env.data.scenarios.tags import TAGS
from asp_env.data.snippets import SNIPPET_INTERVAL_S
from asp_env.errors import AspEnvError
from asp_env.evaluation import statistics
from asp_env.evaluation.closed_loop.episodes import forecast_for_planner, targets_near_egos
from asp_env.evaluation.statistics import Estimate
from asp_env.planning.planner import CandidatePlanner, load_planner, planning_regret
from asp_env.sim.world import ReplayWorld, recorded_future

REFERENCE = "constant-velocity"
"""The predictor whose regret the others remove."""

REGRET, LOG_REGRET, REMOVED = "regret", "log1p regret", "regret removed"
"""Names of the metrics: mean regret; mean of ln(1 + regret), in which rare large regrets have less
weight; and 1 - R / R of constant velocity, where R are mean regrets."""

BATCH = 128
"""Number of states whose scenes are in memory at once. Chosen by hand; it changes no result."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoggedStates:
    """States of the logged egos at which regret is measured."""

    scenario: Int[np.ndarray, " n"]
    """Row of each state's scenario in its `ScenarioSet`."""
    tick: Int[np.ndarray, " n"]

    def __len__(self) -> int:
        """Number of states."""
        return len(self.tick)


def logged_states(scenarios: ScenarioSet, max_states: int | None = None) -> LoggedStates:
    """The states of scenarios every `SNIPPET_INTERVAL_S`, from their first tick on.

    Args:
        scenarios: the scenarios.
        max_states: largest number of states, which are then chosen at even spacing; None for all.

    Raises:
        AspEnvError: the largest number is less than 1.
    """
    if max_states is not None and max_states < 1:
        raise AspEnvError(f"{max_states} states: expected at least 1")
    interval = ticks(SNIPPET_INTERVAL_S, scenarios.dt_s)
    counts = -(-scenarios.length // interval)  # the last tick has no next one
    scenario = np.repeat(np.arange(len(scenarios)), counts)
    within = np.arange(len(scenario)) - np.repeat(np.cumsum(counts) - counts, counts)
    tick = scenarios.start_tick[scenario] + within * interval
    if max_states is not None and len(tick) > max_states:
        rows = np.linspace(0, len(tick) - 1, max_states).round().astype(np.int64)
        scenario, tick = scenario[rows], tick[rows]
    return LoggedStates(scenario=scenario, tick=tick)


@dataclass(frozen=True, slots=True, kw_only=True)
class RegretScores:
    """Planning regret of predictors, and of constant velocity as the reference, at N states."""

    regrets: Mapping[str, Float[np.ndarray, " n"]]
    """By the names of the predictors, and of `REFERENCE`."""
    subsets: Mapping[str, Bool[np.ndarray, " n"]]
    """Masks of the states: `all`, and the tags of their scenarios that occur."""
    recording: Int[np.ndarray, " n"]
    """Index of each state's recording, over which intervals are resampled."""

    def estimates(self, *runs: str, stream: int = 0) -> Iterator[tuple[str, str, Estimate]]:
        """Subset, metric and estimate of the metrics of a method.

        Args:
            *runs: names of the method's training runs, or the name of one predictor.
            stream: number of the sequence of random numbers that resamples runs.
        """
        for subset, member in self.subsets.items():
            regret, groups = (
                np.stack([self.regrets[run] for run in runs])[:, member],
                self.recording[member],
            )
            ones = np.ones(len(groups))
            for metric, values in ((REGRET, regret), (LOG_REGRET, np.log1p(regret))):
                yield (
                    subset,
                    metric,
                    statistics.ratio_over_runs(values, ones, groups, stream=stream),
                )
            reference = self.regrets[REFERENCE][member]
            if runs != (REFERENCE,) and reference.any():
                removed = statistics.ratio_over_runs(
                    reference - regret, reference, groups, stream=stream
                )
                yield subset, REMOVED, removed


def score_regrets(
    predictors: Mapping[str, Predictor],
    scenarios: ScenarioSet,
    planner: CandidatePlanner[Any],
    *,
    scenes: Sequence[Any],  # of Recording: checking its items at run time opens them
    recorded: Sequence[Any],
    horizon: int,
    max_states: int | None = None,
) -> RegretScores:
    """Planning regret at logged states of scenarios.

    Args:
        predictors: predictors by name; constant velocity is added if it is missing.
        scenarios: at least one scenario.
        planner: rates its candidates.
        scenes: the recordings as predictors and the planner observe them.
        recorded: the same recordings as the truth.
        horizon: number of ticks of forecasts and plans.
        max_states: largest number of states, see `logged_states`.
    """
    states = logged_states(scenarios, max_states)
    reference = load_predictor(REFERENCE, horizon=horizon, dt_s=scenarios.dt_s)
    regrets = regrets_at(
        states,
        scenarios,
        {REFERENCE: reference, **predictors},
        planner,
        scenes=scenes,
        recorded=recorded,
        horizon=horizon,
    )
    subsets = {"all": np.ones(len(states), dtype=bool)}
    subsets |= {tag: scenarios.has(tag)[states.scenario] for tag in TAGS}
    return RegretScores(
        regrets=regrets,
        subsets={name: member for name, member in subsets.items() if member.any()},
        recording=scenarios.recording[states.scenario],
    )


def load_candidate_planner(name: str) -> CandidatePlanner[Any]:
    """The planner of a name, if it chooses from candidates.

    Raises:
        AspEnvError: the name is unknown, or the planner does not choose from candidates.
    """
    planner = load_planner(name)
    if not isinstance(planner, CandidatePlanner):
        raise AspEnvError(
            f"planner {name!r}: does not choose from candidates, which planning regret needs; use "
            "contingency or sampling"
        )
    return planner


def regrets_at(
    states: LoggedStates,
    scenarios: ScenarioSet,
    predictors: Mapping[str, Predictor],
    planner: CandidatePlanner[Any],
    *,
    scenes: Sequence[Any],  # of Recording: checking its items at run time opens them
    recorded: Sequence[Any],
    horizon: int,
) -> dict[str, Float[np.ndarray, " n"]]:
    """Planning regret of each predictor at logged states.

    The agents near the ego are forecast, as in closed loop; where a predictor has no forecast of
    one, it is constant velocity.

    Args:
        states: N states.
        scenarios: the scenarios that the states are of.
        predictors: predictors by the names of the result.
        planner: rates its candidates.
        scenes: the recordings as predictors and the planner observe them.
        recorded: the same recordings as the truth.
        horizon: number of ticks of forecasts and plans.
    """
    history = max(scenarios.history, *(predictor.history for predictor in predictors.values()))
    oracle = load_predictor("oracle", horizon=horizon, dt_s=scenarios.dt_s)
    regrets = {name: np.zeros(len(states)) for name in predictors}
    for start in track(range(0, len(states), BATCH), description="planning", transient=True):
        rows = slice(start, min(start + BATCH, len(states)))
        world = _world_at(states, rows, scenarios, scenes, history=history)
        scene = world.scene()
        scene = scene.with_targets(targets_near_egos(scene, np.ones(len(world), dtype=bool)))
        world.recordings = recorded
        future = recorded_future(world, scene, horizon)
        candidates = planner.candidates(scene, horizon)
        truth = forecast_for_planner(oracle, scene, future, horizon)
        true_costs = planner.costs(scene, truth, candidates)
        for name, predictor in predictors.items():
            forecast = forecast_for_planner(predictor, scene, future, horizon)
            costs = planner.costs(scene, forecast, candidates)
            regrets[name][rows] = planning_regret(costs, true_costs)
    return regrets


def _world_at(
    states: LoggedStates,
    rows: slice,
    scenarios: ScenarioSet,
    recordings: Sequence[Any],
    *,
    history: int,
) -> ReplayWorld:
    """A world in which an episode begins at each of the states, the logged ego at its place."""
    episodes = [
        dataclasses.replace(scenarios[number], start_tick=tick, length=1)
        for number, tick in zip(
            states.scenario[rows].tolist(), states.tick[rows].tolist(), strict=True
        )
    ]
    world = ReplayWorld(
        recordings,
        num_episodes=len(episodes),
        dt_s=scenarios.dt_s,
        history=history,
    )
    world.reset(episodes, [np.random.default_rng(0)] * len(episodes))  # replay draws nothing
    return world

"""The largest planning regret along the log of scenarios, and the `hard` ones among them.

These are measures of scenarios that need a planner and predictors, so they are computed on demand
and stored in the cache, by content of the recording. The regret of `blind`, which forecasts every
agent far away, states whether any forecast matters in a scenario, and favours no predictor. The
regret of constant velocity states where it fails: a selection by it favours all others against it.
"""

import hashlib
from collections.abc import Sequence
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from asp_env.data.cache import array_of
from asp_env.data.predictor import Predictor, load_predictor
from asp_env.data.recording import ticks
from asp_env.data.scenarios.scenario import ScenarioSet
from asp_env.data.scenarios.selection import choose_scenarios
from asp_env.data.source import Recordings
from asp_env.errors import AspEnvError
from asp_env.evaluation.regret import REFERENCE, load_candidate_planner, logged_states, regrets_at

VERSION = 1
"""Raise it whenever a planner's costs, a predictor without weights or the states change, so that
other regrets result for the same recording."""

HARD = "hard"
"""Name of the selection, as in `--scenarios hard,left`."""

HARD_PLANNER = "sampling"
"""Planner whose regret defines `hard`, whatever planner drives."""

HARD_REGRET = 10.0
"""`hard` are interactive scenarios in which constant velocity has a regret above this at any logged
state. The unit is that of the costs of `HARD_PLANNER`, where a collision costs 50 to 100 and the
loss of one metre costs 1. Chosen by hand."""

HARD_HORIZON_S = 3.0
"""Horizon of the forecasts and plans that define `hard`, s."""

HARD_NOTE = (
    f"hard: interactive scenarios in which planning with {REFERENCE} has a regret above "
    f"{HARD_REGRET:g} at any logged state ({HARD_PLANNER}, {HARD_HORIZON_S:g} s). They were chosen "
    f"by the errors of {REFERENCE}, so that they favour every other predictor against it."
)
"""Stated wherever results on `hard` scenarios are."""


def is_hard(selection: str) -> bool:
    """Whether a selection of scenarios has the condition `hard`."""
    return HARD in _clauses(selection)


def select_scenarios(
    recordings: Recordings,
    selection: str,
    *,
    dt_s: float,
    history: int,
    allowed: Sequence[Bool[np.ndarray, " _"]] | None = None,
) -> ScenarioSet:
    """Selects scenarios as `choose_scenarios`, by a filter that may contain the condition `hard`.

    Args:
        recordings: the recordings.
        selection: a filter as text, such as `hard,left`, or the path of a scenario file.
        dt_s: seconds per tick.
        history: number of ticks of history before each start.
        allowed: of each recording, a mask of the ticks that scenarios and histories may use.

    Raises:
        AspEnvError: the text is not a filter, or no scenario matches.
        DataError: the file cannot be read, or belongs to other recordings.
    """
    clauses, hard = _clauses(selection), is_hard(selection)
    if hard:
        selection = ",".join(["interactive", *(each for each in clauses if each != HARD)])
    chosen = choose_scenarios(recordings, selection, dt_s=dt_s, history=history, allowed=allowed)
    if not hard or not len(chosen):
        return chosen
    regrets = scenario_regrets(recordings, chosen, [REFERENCE], horizon_s=HARD_HORIZON_S)[:, 0]
    if not (regrets > HARD_REGRET).any():
        raise AspEnvError(
            f"scenarios {','.join(clauses)!r}: in none of the {len(chosen)} that fit {selection!r} "
            f"does {REFERENCE} have a regret above {HARD_REGRET:g}; the largest is "
            f"{regrets.max():.1f}; use interactive instead of hard"
        )
    return chosen.select(regrets > HARD_REGRET)


def scenario_regrets(
    recordings: Recordings,
    scenarios: ScenarioSet,
    predictors: Sequence[str],
    *,
    planner: str = HARD_PLANNER,
    horizon_s: float = HARD_HORIZON_S,
) -> Float[np.ndarray, "n predictors"]:
    """The largest planning regret of predictors along the log of scenarios.

    Args:
        recordings: the recordings.
        scenarios: n scenarios.
        predictors: names of predictors, such as `blind`.
        planner: name of a planner that chooses from candidates.
        horizon_s: horizon of forecasts and plans, s.

    Returns:
        Regrets in the unit of the planner's costs.

    Raises:
        AspEnvError: a name is unknown, or the planner does not choose from candidates.
    """
    load_candidate_planner(planner)  # raises errors before anything is computed
    horizon = ticks(horizon_s, scenarios.dt_s)
    loaded = [load_predictor(name, horizon=horizon, dt_s=scenarios.dt_s) for name in predictors]
    largest = np.zeros((len(scenarios), len(predictors)))
    for number in np.unique(scenarios.recording).tolist():
        rows = np.flatnonzero(scenarios.recording == number)
        for column, predictor in enumerate(loaded):
            make = partial(
                _largest_regrets, recordings, scenarios.select(rows), predictor, planner, horizon
            )
            table = [
                getattr(scenarios, field)[rows] for field in ("ego_id", "start_tick", "length")
            ]
            identity = (
                *(recordings.subset([number]).hashes(), scenarios.dt_s),
                *(scenarios.history, horizon, planner),
                *(predictors[column], sorted(predictor.metadata.items())),
                np.stack(table).astype(np.int64).tobytes(),
            )
            content = hashlib.sha256(repr(identity).encode()).hexdigest()
            largest[rows, column] = array_of("regrets", VERSION, content, make)
    return largest


def _largest_regrets(
    recordings: Recordings,
    scenarios: ScenarioSet,
    predictor: Predictor,
    planner: str,
    horizon: int,
) -> Float[np.ndarray, " n"]:
    """The largest regret of a predictor in each scenario."""
    states = logged_states(scenarios)
    regrets = regrets_at(
        states,
        scenarios,
        {predictor.name: predictor},
        load_candidate_planner(planner),
        scenes=recordings,
        recorded=recordings,
        horizon=horizon,
    )[predictor.name]
    largest = np.zeros(len(scenarios))
    np.maximum.at(largest, states.scenario, regrets)
    return largest


def _clauses(selection: str) -> list[str]:
    return [clause.strip() for clause in selection.split(",")]

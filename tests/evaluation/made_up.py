"""Scenarios, scores and methods made up by hand."""

import numpy as np

from asp_env.data.predictor import Predictor
from asp_env.data.scenarios.scenario import ScenarioSet
from asp_env.data.scenarios.tags import COLUMNS, TAGS
from asp_env.evaluation.closed_loop.comparison import EpisodeScores
from asp_env.evaluation.closed_loop.summary import MethodScores
from asp_env.metrics.masked import Masked
from asp_env.sim.world import Ending
from predictors.physical import ConstantVelocity


def made_scenarios(*recordings: int, left: tuple[int, ...] = ()) -> ScenarioSet:
    """Scenarios of recordings `r0`, `r1`, …; those of the given numbers turn left."""
    count = len(recordings)
    tags = np.zeros((count, len(TAGS)), dtype=bool)
    tags[list(left), TAGS.index("left")] = True
    names = tuple(f"r{i}" for i in range(max(recordings) + 1))
    return ScenarioSet(
        source="d",
        recordings=names,
        locations=("here",) * len(names),
        dt_s=0.2,
        history=15,
        recording=np.array(recordings),
        ego_id=np.arange(count),
        start_tick=np.full(count, 15),
        length=np.full(count, 50),
        seed=np.zeros(count, dtype=np.int64),
        tags=tags,
        values=np.zeros((count, len(COLUMNS))),
    )


def made_scores(values, **more) -> EpisodeScores:
    """Scores with other metrics; NaN is a metric that is not defined."""
    metrics = {"score": np.array(values, dtype=float)}
    metrics |= {name: np.array(each, dtype=float) for name, each in more.items()}
    return EpisodeScores(
        metrics={
            name: Masked(value=np.nan_to_num(each), valid=~np.isnan(each))
            for name, each in metrics.items()
        },
        endings=(Ending.GOAL,) * len(values),
        rollouts=(),
        faults=(None,) * len(values),
    )


def made_method(predictor: str, *runs: EpisodeScores, planner="sampling", stream=0) -> MethodScores:
    loaded: Predictor = ConstantVelocity(horizon=15, dt_s=0.2)
    names = [predictor] if len(runs) == 1 else [f"{predictor} {i}" for i in range(len(runs))]
    return MethodScores(
        planner=planner,
        predictor=predictor,
        runs=dict.fromkeys(names, loaded if predictor else None),
        scores=runs,
        stream=stream,
    )

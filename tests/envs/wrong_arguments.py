"""Calls the public functions with wrong arguments, and prints what is wrong with their answers.

This runs in a process of its own, without the checks of types that the test run adds to all
functions. Right is an `AspEnvError` of one short line, or where Python's or Gymnasium's conventions
demand it an error of theirs.
"""

# pyright: reportArgumentType=false

import json
import math
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np

import asp_env
from asp_env.data.predictor import load_predictor
from asp_env.data.recording import ticks
from asp_env.errors import AspEnvError
from asp_env.planning.planner import load_planner

LONGEST = 400
"""Longest message, in characters."""

THING = object()
NAN = math.nan
HUGE = 10**30

COUNTS = ("x", 0, -1, 1.5, True, [1])
"""Values that are no number of things."""
FLAGS = ("x", 5)
DATA = (5, None, "", ["a"], THING, b"x", "sample:motorway", "nothing:at-all", "no/folder")

OPTIONS: dict[str, Sequence[Any]] = {
    "data": DATA,
    "observations": (
        5,
        None,
        "state",
        (),
        (5,),
        ((),),
        {"a": 1},
        [None],
        ("stat",),
        ("state",) * 2,
    ),
    "view": (5, None, THING, ["chauffeurnet"], "chaufeurnet"),
    "raster_px": ("x", (1,), -3, 0, 1.5, (10, "a"), True, (10**9, 10**9), NAN, THING),
    "traffic": (
        *(5, THING, "", "idn", ["log"], {"car": 5}, {5.5: "log"}, {None: "log"}),
        *({"default": None}, {"-1": "log"}, {-1: "log"}, {"²": "log"}, {"pedestrian": "idm"}),
    ),
    "dt_s": ("x", None, -1, 0, NAN, math.inf, True, [0.2], 1e-9, 1e9, 1j, 0.13),
    "action_type": (5, None, ["direct"], THING, "direkt"),
    "action_repeat": (*COUNTS, None, NAN),
    "reward_weights": (
        *(5, "x", [1], {"progress": "x"}, {"progress": None}, {5: 1.0}, {"progres": 1.0}),
        *({"progress": True}, {"progress": math.inf}, {"progress": 1j}),
    ),
    "scenarios": (5, None, ["left"], THING, "bogus<", "lfet", b"left", "none.json"),
    "predictor": (
        *(5, THING, {}, ["constant-velocity"], {5: "constant-velocity"}, {"a": 5}, "", b"x"),
        *("constant-velocty", "ssp-asp:nowhere", "oracle"),
    ),
    "flatten": (5, "x", None, [], {}),
    "render_mode": (5, "x", [], {}),
}

FORECAST: dict[str, Sequence[Any]] = {
    "agents": (*COUNTS, None),
    "modes": (*COUNTS, None),
    "at_s": (5, None, "x", (), (0,), (-1,), ("a",), (0.13,), (NAN,), (None,)),
    "privileged": (*FLAGS, None),
    "features": (*FLAGS, None, []),
    "every_ticks": (*COUNTS, None),
    "latency_ticks": ("x", -1, 1.5, True, None),
    "prefix": (5, None, []),
}

VECTOR = {
    "num_envs": (*COUNTS, None, HUGE),
    "autoreset_mode": (5, "x", None, []),
    "max_episode_steps": COUNTS,
}

PARALLEL = {
    "classes": (5, "car", (), (5,), ("dog",), ("pedestrian",)),
    "ids": (5, (), "x", ("a",), (1.5,), (True,), (HUGE,)),
    "max_agents": COUNTS,
    "pad_absent": (*FLAGS, None),
    "numeric_infos": (*FLAGS, None),
}

SEEDS = ("a", -1, 1.5, [1], THING, True)
RESETS = (
    *(5, "x", [1], THING, True, {5: 1}, {"scenari": 0}, {"scenario": [1]}, {"scenario": True}),
    *({"scenario": THING}, {"scenario": NAN}, {"scenario": HUGE}, {"scenario": -1}),
    *({"scenario": "first"}, {"ego": "x"}, {"ego": 1.5}, {"ego": [1]}, {"ego": HUGE}),
    *({"scenario": 0, "start_tick": "x"}, {"scenario": 0, "start_tick": -5}, {"start_tick": 20}),
)
ACTIONS = (
    *(None, "x", 5, [1], [1, 2, 3], [NAN, 0], [math.inf, 0], [[0, 0]], {}, THING, ["a", "b"]),
    *([None, 0], [1j, 0], [HUGE**20, 0], np.zeros((100, 100)), np.array(["a", "b"])),
)


class Call(NamedTuple):
    """A call that must fail."""

    label: str
    run: Callable[[], Any]
    allowed: tuple[type[Exception], ...] = ()
    """Errors of Python or Gymnasium that are right here, too."""


def calls_of(
    name: str, function: Callable[..., Any], table: Mapping[str, Iterable[Any]], /, **fixed: Any
) -> Iterator[Call]:
    """A call of a function for each value of each parameter."""
    for parameter, values in table.items():
        for value in values:
            yield Call(
                f"{name}({parameter}={value!r})",
                lambda given=({**fixed, parameter: value}): function(**given),
            )


def positional(
    name: str,
    function: Callable[[Any], Any],
    values: Iterable[Any],
    allowed: tuple[type[Exception], ...] = (),
) -> Iterator[Call]:
    """A call of a function for each value of its argument."""
    for value in values:
        yield Call(f"{name}({value!r})", lambda given=value: function(given), allowed)


def environments(data: str) -> Iterator[Call]:
    """The constructors, without and with forecasts."""
    makers: dict[str, tuple[Callable[..., Any], dict[str, Any], Mapping[str, Sequence[Any]]]] = {
        "ReplayEnv": (asp_env.ReplayEnv, {}, {}),
        "ReplayVectorEnv": (asp_env.ReplayVectorEnv, {"num_envs": 2}, VECTOR),
        "parallel_env": (asp_env.parallel_env, {}, PARALLEL),
        "sb3_vec_env": (
            asp_env.sb3_vec_env,
            {"num_envs": 2},
            {name: VECTOR[name] for name in ("num_envs", "max_episode_steps")},
        ),
    }
    for name, (make, fixed, own) in makers.items():
        fixed = {"data": data, "observations": ("state",), **fixed}
        options = {key: each for key, each in OPTIONS.items() if key not in ("view", "raster_px")}
        yield from calls_of(name, make, {**options, **own}, **fixed)
        rasters = {key: OPTIONS[key] for key in ("view", "raster_px")}
        yield from calls_of(name, make, rasters, **{**fixed, "observations": ("raster",)})

        def forecasting(make: Callable[..., Any] = make, fixed: Any = fixed, **options: Any) -> Any:
            return make(**fixed, predictor="constant-velocity", forecast=options)

        yield from calls_of(f"{name} forecast", forecasting, FORECAST)
        yield from calls_of(
            name, make, {"forecast": (5, "x", [1], {"agnts": 1})}, **fixed, predictor="oracle"
        )


def registered(data: str) -> Iterator[Call]:
    """`gymnasium.make` and `make_vec`: errors pass through them unchanged."""
    options: dict[str, Any] = {"data": data, "observations": ("state",)}

    def make(**given: Any) -> Any:
        return gymnasium.make("asp_env/Replay-v0", **{**options, **given})

    def make_vec(num_envs: Any = 2, **given: Any) -> Any:
        return gymnasium.make_vec(
            "asp_env/Replay-v0",
            num_envs=num_envs,
            vectorization_mode="vector_entry_point",
            **{**options, **given},
        )

    few = {"scenarios": (5, None), "dt_s": ("x", -1), "observations": (5,), "predictor": (5,)}
    yield from calls_of("make", make, few)
    yield from calls_of("make_vec", make_vec, {**few, "num_envs": ("3", 0, -1)})
    for name, function in (("make", make), ("make_vec", make_vec)):
        yield Call(f"{name}(scenarois=)", lambda f=function: f(scenarois=""), (TypeError,))
    for steps in ("x", 0, 1.5):
        yield Call(
            f"make(max_episode_steps={steps!r})",
            lambda given=steps: make(max_episode_steps=given),
            (TypeError, ValueError),
        )


def episodes(data: str) -> Iterator[Call]:
    """The methods of the environments."""
    light = {"observations": ("state",)}
    env, vector = asp_env.ReplayEnv(data, **light), asp_env.ReplayVectorEnv(2, data, **light)
    yield Call("restore(snapshot before reset)", env.snapshot, (gymnasium.error.ResetNeeded,))
    env.reset(seed=0)
    vector.reset(seed=0)
    yield from calls_of("reset", env.reset, {"seed": SEEDS, "options": RESETS})
    yield from positional("step", env.step, ACTIONS)
    snapshots = (None, 5, "x", {}, THING)
    yield from positional("restore", env.restore, (*snapshots, vector.snapshot()))
    scene = env.scene()
    futures = {"scene": (None, 5, "x")}, {"horizon": (*COUNTS, None)}
    yield from calls_of("recorded_future", env.recorded_future, futures[0], horizon=5)
    yield from calls_of("recorded_future", env.recorded_future, futures[1], scene=scene)
    shown = {
        "forecast": (5, "x"),
        "plan": (5, "x", np.zeros((3, 1)), [["a", "b"]], [[NAN, 0]], THING),
    }
    yield from calls_of("show", env.show, shown)

    seeds = ("a", -1, 1.5, [1], THING, [1, "a"], [1, -1], [1, 2.5], True, {})
    masks = ({"reset_mask": 5}, {"reset_mask": [True, True]}, {"reset_mask": np.zeros(2, bool)})
    resets = (5, "x", [1], THING, *masks, {"scenario": [0]}, {"scenario": [0, "x"]}, {"bogus": 1})
    yield from calls_of("vector reset", vector.reset, {"seed": seeds, "options": resets})
    actions = (None, "x", 5, [1, 2], np.zeros((3, 2)), np.full((2, 2), NAN), [[0, 0]], THING)
    yield from positional("vector step", vector.step, actions)
    yield from positional("vector restore", vector.restore, (*snapshots, env.snapshot()))
    for value in (5, None, "left", [1]):
        yield Call(
            f"vector.scenarios = {value!r}", lambda given=value: setattr(vector, "scenarios", given)
        )

    parallel = asp_env.parallel_env(data, **light)
    yield Call("parallel state", parallel.state, (gymnasium.error.ResetNeeded,))
    parallel.reset(seed=0)
    yield from calls_of(
        "parallel reset", parallel.reset, {"seed": SEEDS, "options": (5, "x", [1], {"ego": "x"})}
    )
    wrong = ([0, 0, 0], "x", None, [NAN, 0])
    yield from positional(
        "parallel step",
        parallel.step,
        (
            None,
            5,
            "x",
            [1],
            {},
            {"bogus": [0, 0]},
            *(dict.fromkeys(parallel.agents, a) for a in wrong),
        ),
    )
    for method in (parallel.scene, parallel.observation_space, parallel.action_space):
        yield from positional(f"parallel {method.__name__}", method, (None, 5, "bogus"))

    learner = asp_env.sb3_vec_env(2, data, **light)
    learner.reset()
    yield from positional("sb3 step", learner.step, actions[:-1])
    yield from positional("sb3 seed", learner.seed, ("a", -1, 1.5))
    for value in (5, "x", [5, 5], [{}]):
        yield Call(
            f"sb3 set_options({value!r})",
            lambda given=value: (learner.set_options(given), learner.reset()),
        )


def wrappers(data: str) -> Iterator[Call]:
    """The wrappers around environments."""
    env = asp_env.ReplayEnv(data, observations=("state",))
    vector = asp_env.ReplayVectorEnv(2, data, observations=("state",))
    predictors = {"predictor": (5, None, THING, "", {"a": "oracle"})}
    for name, wrapper, inner in (
        ("PredictionFeatures", asp_env.PredictionFeatures, env),
        ("VectorPredictionFeatures", asp_env.VectorPredictionFeatures, vector),
    ):
        yield from calls_of(name, wrapper, FORECAST, env=inner, predictor="constant-velocity")
        yield from calls_of(name, wrapper, predictors, env=inner)
    others = (5, None, "x", gymnasium.make("CartPole-v1"))
    by_gymnasium = (TypeError,)
    for value in (*others, env):
        yield Call(
            f"VectorPredictionFeatures(env={value!r})",
            lambda given=value: asp_env.VectorPredictionFeatures(given, "oracle"),
            by_gymnasium,
        )
    for value in (*others, vector):
        yield Call(
            f"PredictionFeatures(env={value!r})",
            lambda given=value: asp_env.PredictionFeatures(given, "oracle"),
            by_gymnasium,
        )
        yield Call(f"FlatParts({value!r})", lambda v=value: asp_env.FlatParts(v), by_gymnasium)
    yield from calls_of("ForecastOptions", asp_env.ForecastOptions, FORECAST_CHECKED)


FORECAST_CHECKED = {
    name: [value for value in values if value not in ((0.13,),)]
    for name, values in FORECAST.items()
}
"""Without the times that are wrong for one time step only."""


def functions(data: str) -> Iterator[Call]:
    """The functions that open, load and convert."""
    yield from positional("open_data", asp_env.open_data, DATA)
    yield from calls_of(
        "open_data",
        lambda data, dt_s: asp_env.open_data(data, dt_s=dt_s)[0],
        {"dt_s": OPTIONS["dt_s"][:-1]},
        data=data,
    )
    recordings = asp_env.open_data(data)
    yield from positional("recordings", recordings.__getitem__, ("x", None, 1.5), (TypeError,))
    yield from positional("recordings", recordings.__getitem__, (HUGE, -5, 9), (IndexError,))
    good = {"name": "constant-velocity", "horizon": 15, "dt_s": 0.2}
    names = (5, None, "", "bogus", "ssp-asp:", "constant-velocity:x", "blend:2", "delayed:x:oracle")
    yield from calls_of("load_predictor", load_predictor, {"name": names}, **good)
    numbers = {"horizon": (*COUNTS, None, HUGE), "dt_s": ("x", None, 0, -1, NAN, math.inf)}
    for name in ("constant-velocity", "oracle", "blend:0.5", "delayed:2:constant-velocity"):
        yield from calls_of("load_predictor", load_predictor, numbers, **{**good, "name": name})
    yield from positional("load_planner", load_planner, (5, None, "", "bogus", "idm:x", "sb3:"))
    for convert in (asp_env.normalize_actions, asp_env.denormalize_actions):
        wrong = (None, "x", 5, [1], np.zeros(3), {}, THING, [["a", "b"]], [1j, 0])
        yield from positional(convert.__name__, convert, wrong)
    yield from positional(
        "Rollout.load", asp_env.Rollout.load, (5, None, "", "nothing", b"x", data)
    )
    for duration_s, dt_s in ((3, "x"), ("x", 0.2), (None, 0.2), (3, None), (1e300, 0.2), (NAN, 1)):
        yield Call(f"ticks({duration_s!r}, {dt_s!r})", lambda a=duration_s, b=dt_s: ticks(a, b))


GROUPS = {
    "environments": environments,
    "registered": registered,
    "episodes": episodes,
    "wrappers": wrappers,
    "functions": functions,
}


def fault_of(call: Call) -> str | None:
    """What is wrong with the answer to a call; None if nothing is."""
    try:
        call.run()
    except Exception as error:
        message, kind = str(error), type(error).__name__
        if "\n" in message or not 0 < len(message) <= LONGEST:
            return f"{kind} of {len(message)} characters: {message[:200]}"
        return None if isinstance(error, (AspEnvError, *call.allowed)) else f"{kind}: {message}"
    return "accepted"


def main(data: str) -> None:
    """Prints the number of calls and the faults of each group as JSON."""
    warnings.simplefilter("ignore")
    Path(data).resolve(strict=True)
    found = {}
    for name, group in GROUPS.items():
        answers = {call.label: fault_of(call) for call in group(data)}
        faults = [f"{label}: {fault}" for label, fault in answers.items() if fault]
        found[name] = {"calls": len(answers), "faults": faults}
    sys.stdout.write(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1])

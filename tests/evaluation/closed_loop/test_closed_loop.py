"""`asp-env drive`: planners drive scenarios; metrics, rollouts and files."""

import csv
import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from asp_env.data.predictor import Forecast, load_predictor
from asp_env.data.rollout import Rollout
from asp_env.data.scenarios.scenario import Scenario, find_scenarios
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.data.source import Recordings, open_data
from asp_env.data.split import TrainedOn
from asp_env.errors import AspEnvError
from asp_env.evaluation.closed_loop.drive import ClosedLoopResult, Drive, drive
from asp_env.evaluation.closed_loop.episodes import (
    FORECAST_WITHIN_M,
    DrivenEpisodes,
    EpisodeSettings,
    continued_actions,
    drive_episodes,
)
from asp_env.metrics.driving.rules import PDMS
from asp_env.metrics.driving.scores import driving_metrics
from asp_env.planning.planner import Plan, load_planner
from asp_env.sim.world import Ending
from predictors.physical import ConstantVelocity, Oracle
from tests.crossing_files import ON_ROAD, write_crossing
from tests.sim.worlds import DT_S, HISTORY, car

NOWHERE = Path("not-written")


@dataclass
class Spy:
    """Constant velocity that stores its inputs."""

    horizon: int = 15
    privileged: bool = False
    needs_simulation: bool = False
    name: str = "spy"
    dt_s: float = DT_S
    history: int = 0
    trained_on: TrainedOn | None = None
    metadata: dict[str, str] = field(default_factory=dict)
    inputs: list[tuple[Scene, Future | None]] = field(default_factory=list)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        self.inputs.append((scene, future))
        return ConstantVelocity(horizon=self.horizon, dt_s=self.dt_s).predict(scene)


def _scenarios(recordings: Recordings) -> list[Scenario]:
    return list(find_scenarios(recordings, source="", dt_s=DT_S, history=HISTORY))


def _drive(
    recordings: Recordings, scenarios: list[Scenario], predictor, planner="sampling", traffic="log"
) -> DrivenEpisodes:
    return drive_episodes(
        recordings,
        scenarios,
        load_planner(planner),
        predictor,
        EpisodeSettings(rules=PDMS, traffic=traffic, horizon=15, history=HISTORY, dt_s=DT_S),
    )


def _values(result: ClosedLoopResult, planner: str, predictor: str = "") -> dict[str, float]:
    line = (planner, predictor, "all")
    rows = [r for r in result.rows if (r.planner, r.predictor, r.subset) == line]
    return {row.metric: row.value for row in rows}


def test_the_expert_replays_its_log(tmp_path):
    """Without collisions in the log: no divergence, all of the route to the goal; it is first."""
    write_crossing(tmp_path, drives=((ON_ROAD[1], car(-95, 8)),))
    result = drive(Drive(data=str(tmp_path), out=NOWHERE, predictors=("oracle",)))
    assert result.rows[0].planner == "expert"
    expert = _values(result, "expert")
    assert expert["log divergence"] == 0.0
    assert expert["progress"] == pytest.approx(1.0, abs=1e-3)
    assert expert["on road"] == 1.0
    assert list(result.manifest["endings"]) == ["expert", "contingency + oracle"]
    assert expert["no collision"] == 1.0
    assert result.manifest["endings"]["expert"] == {"GOAL": 2}


def test_every_method_drives_the_same_scenarios(crossings):
    """The expert and the planner with two predictors, each with rows, endings and rollouts."""
    names = ("oracle", "constant-velocity")
    result = drive(Drive(data=str(crossings), out=NOWHERE, predictors=names, max_scenarios=5))
    assert len(result.manifest["scenarios"]) == 5
    methods = ["expert", "contingency + oracle", "contingency + constant-velocity"]
    assert list(result.rollouts) == methods
    for method in methods:
        assert sum(result.manifest["endings"][method].values()) == 5
        driven = [rollout.scenario.name for rollout in result.rollouts[method]]
        assert driven == [rollout.scenario.name for rollout in result.rollouts["expert"]]
    for name in names:
        assert _values(result, "contingency", name)["score"] > 0
    row = result.rows[-1]
    assert (row.traffic, row.latency_ticks, row.horizon_s) == ("log", 0, 3.0)


def test_a_delayed_predictor_drives_the_same_scenarios(crossings):
    """It needs 17 ticks of history, scenarios have 15; results of the others do not change."""
    names = ("constant-velocity", "delayed:14:constant-turn-rate")
    config = Drive(data=str(crossings), out=NOWHERE, predictors=names, max_scenarios=4)
    alone = drive(dataclasses.replace(config, predictors=names[:1]))
    result = drive(config)
    assert result.manifest["scenarios"] == alone.manifest["scenarios"]
    assert _values(result, "expert") == _values(alone, "expert")
    score = _values(result, "contingency", names[0])["score"]
    assert score == _values(alone, "contingency", names[0])["score"]
    assert _values(result, "contingency", names[1])["score"] != score
    assert list(result.rollouts)[2] == "contingency + delayed 14 constant-turn-rate"


def test_a_planner_without_forecasts_drives_once(crossings):
    """`idm` drives once, without a predictor's name; `expert` does not drive a second time."""
    for planner, methods in (("idm", ["expert", "idm"]), ("expert", ["expert"])):
        config = Drive(
            data=str(crossings),
            out=NOWHERE,
            planner=planner,
            predictors=("oracle", "constant-velocity"),
            max_scenarios=2,
        )
        assert list(drive(config).rollouts) == methods


def test_controls_are_added_to_a_comparison(crossings, monkeypatch):
    """Those that are not named yet, after the named ones; with them, methods have oracle shares."""

    def load(name: str, *, horizon: int, dt_s: float):
        kind = Oracle if name == "oracle" or name.startswith("blend") else ConstantVelocity
        return kind(horizon=horizon, dt_s=dt_s)

    monkeypatch.setattr("asp_env.evaluation.selection.load_predictor", load)
    config = Drive(
        data=str(crossings),
        out=NOWHERE,
        predictors=("constant-turn-rate", "oracle"),
        max_scenarios=4,
        controls=True,
    )
    result = drive(config)
    assert [method.predictor for method in result.methods] == [
        "", "constant-turn-rate", "oracle",
        "blind", "constant-velocity", "blend:0.25", "blend:0.5", "blend:0.75",
    ]  # fmt: skip
    metrics = _values(result, "contingency", "constant-turn-rate")
    assert metrics["score - constant-velocity"] == 0.0  # here both are constant velocity
    assert 0.0 <= metrics["oracle share"] <= 1.0
    other = drive(dataclasses.replace(config, traffic="idm"))  # does not follow the recording
    assert "oracle share" not in _values(other, "contingency", "constant-turn-rate")


def test_differences_refer_to_any_predictor(crossings):
    """By default to constant velocity, if it takes part."""
    config = Drive(
        data=str(crossings), out=NOWHERE, predictors=("oracle", "constant-turn-rate"),
        max_scenarios=3, reference="constant-turn-rate",
    )  # fmt: skip
    row = next(r for r in drive(config).rows if r.metric == "score - constant-turn-rate")
    assert row.planner == "expert"
    assert row.mde is not None
    none = drive(dataclasses.replace(config, reference=None))
    assert not any(" - " in row.metric for row in none.rows)


@pytest.mark.parametrize("traffic", ["log", "idm"])
def test_running_twice_gives_the_same_bits(crossings, traffic):
    config = Drive(data=str(crossings), out=NOWHERE, traffic=traffic, max_scenarios=4)
    first, second = drive(config), drive(config)
    assert first.rows == second.rows
    for method, rollouts in first.rollouts.items():
        for one, other in zip(rollouts, second.rollouts[method], strict=True):
            assert one.states.tobytes() == other.states.tobytes()
            assert one.forecast_states.tobytes() == other.forecast_states.tobytes()


def test_episodes_side_by_side_equal_episodes_alone(recordings):
    """The same endings, scores and rollouts."""
    predictor = ConstantVelocity(horizon=15, dt_s=DT_S)
    scenarios = _scenarios(recordings)[:6]
    together = _drive(recordings, scenarios, predictor, traffic="idm")
    scores = driving_metrics(together.drives, PDMS)["score"].value
    for b, each in enumerate(scenarios):
        alone = _drive(recordings, [each], predictor, traffic="idm")
        assert alone.endings.tolist() == together.endings[b : b + 1].tolist()
        assert driving_metrics(alone.drives, PDMS)["score"].value[0] == scores[b]
        one, other = alone.rollouts[0], together.rollouts[b]
        for name in ("states", "valid", "plans", "forecast_states", "forecast_ticks", "events"):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes(), name


def test_simulated_traffic_has_a_realism(recordings):
    """From 0 to 1 where agents are simulated; not valid for replayed traffic."""
    scenarios = _scenarios(recordings)[:4]
    predictor = ConstantVelocity(horizon=15, dt_s=DT_S)
    simulated = _drive(recordings, scenarios, predictor, planner="expert", traffic="idm").realism
    assert simulated["realism"].valid.any()
    for each in simulated.values():
        assert ((each.value[each.valid] > 0) & (each.value[each.valid] < 1)).all()
    replayed = _drive(recordings, scenarios, predictor, planner="expert").realism
    assert not any(each.valid.any() for each in replayed.values())


def test_only_agents_near_a_running_ego_are_forecast(recordings):
    """Targets are present, not egos, within 60 m, and in episodes that have not ended."""
    spy = Spy()
    driven = _drive(recordings, _scenarios(recordings), spy)
    active = driven.drives.active
    assert len(spy.inputs) == active.shape[1] - 1
    for k, (scene, future) in enumerate(spy.inputs):
        situation, slot = scene.targets.T
        assert future is None
        assert (slot > 0).all()
        assert scene.valid[situation, slot, -1].all()
        egos = scene.states[situation, 0, -1, :2]
        distance = np.linalg.norm(scene.states[situation, slot, -1, :2] - egos, axis=-1)
        assert (distance <= FORECAST_WITHIN_M).all()
        # an episode that is active at tick k + 1 is running at tick k
        assert active[situation, k + 1].all()


def test_only_privileged_predictors_receive_the_future(recordings):
    """It contains the recorded states of the next 15 ticks and a mask of presence."""
    spy = Spy(privileged=True)
    scenario = _scenarios(recordings)[0]
    _drive(recordings, [scenario], spy)
    recording = recordings[scenario.recording]
    scene, future = spy.inputs[3]
    assert future is not None
    for row, (b, a) in enumerate(scene.targets.tolist()):
        track = int(np.flatnonzero(recording.track_ids == scene.ids[b, a])[0])
        frames = 5 * (int(scene.tick[b]) + 1 + np.arange(15)) - recording.first_frames[track]
        present = frames < len(recording.track(track))
        assert future.valid[row].tolist() == present.tolist()
        assert np.array_equal(future.states[row][present], recording.track(track)[frames[present]])


def test_simulating_the_future_does_not_change_a_drive(recordings):
    """The same states and plans as without, in traffic that reacts."""
    scenarios = _scenarios(recordings)[:3]
    alone = _drive(recordings, scenarios, Spy(), traffic="idm")
    spy = Spy(privileged=True, needs_simulation=True)
    simulated = _drive(recordings, scenarios, spy, traffic="idm")
    for one, other in zip(alone.rollouts, simulated.rollouts, strict=True):
        assert one.states.tobytes() == other.states.tobytes()
        assert one.plans.tobytes() == other.plans.tobytes()
    assert all(future is not None for _, future in spy.inputs)


def test_the_last_plan_is_carried_on():
    """Shifted by one tick, with the last action repeated; zeros before the first plan."""
    actions = np.arange(6, dtype=np.float32).reshape(1, 3, 2)
    plan = Plan(actions=actions, states=np.zeros((1, 3, 4), dtype=np.float32))
    assert continued_actions(plan, 1, 4).tolist() == [[[2, 3], [4, 5], [4, 5], [4, 5]]]
    assert continued_actions(None, 1, 2).tolist() == [[[0, 0], [0, 0]]]


def test_the_interactive_oracle_drives_like_the_oracle_in_replayed_traffic(recordings):
    """Equal bits there; with `idm`, which reacts, it forecasts something else."""
    scenarios = _scenarios(recordings)[:3]
    names = ("oracle", "interactive-oracle")
    predictors = [load_predictor(name, horizon=15, dt_s=DT_S) for name in names]
    for traffic in ("log", "idm"):
        one, other = (
            np.concatenate([each.forecast_states for each in driven.rollouts]).tobytes()
            for driven in (_drive(recordings, scenarios, p, traffic=traffic) for p in predictors)
        )
        assert (one == other) == (traffic == "log")


def test_forecasts_are_cut_to_the_horizon(recordings):
    """A predictor of 6 s gives the same drive as one of 3 s."""
    scenarios = _scenarios(recordings)[:2]
    near, far = (
        _drive(recordings, scenarios, ConstantVelocity(horizon=steps, dt_s=DT_S))
        for steps in (15, 30)
    )
    assert far.rollouts[0].plans.shape[1] == 15
    assert near.rollouts[0].states.tobytes() == far.rollouts[0].states.tobytes()


def test_a_rollout_is_consistent(recordings):
    """Ticks, plans, forecasts and events of one episode fit together."""
    scenario = _scenarios(recordings)[1]
    driven = _drive(recordings, [scenario], Oracle(horizon=15, dt_s=DT_S))
    rollout = driven.rollouts[0]
    count = int(driven.drives.active[0].sum())
    assert rollout.scenario == scenario
    assert rollout.states.shape[0] == rollout.events.shape[0] == count
    assert rollout.plans.shape == (count - 1, 15, 2)
    assert rollout.ids[0] == scenario.ego_id
    assert (rollout.ids >= 0).all()
    assert set(rollout.forecast_ticks.tolist()) <= set(range(count - 1))
    assert (rollout.forecast_slots > 0).all()
    # the first action is executed: the first planned position is the next one
    assert rollout.plans[:, 0] == pytest.approx(rollout.states[1:, 0, :2], abs=1e-3)
    assert rollout.states[0].tobytes() == rollout.log_states[0].tobytes()


def test_planners_stop_behind_a_waiting_car(tmp_path):
    """The car waits all the time: the episode ends without data, and without collision."""
    waiting = car(-20, 0, appears_s=0.2)
    lane = car(-90, 8, (4.0, 0, 0), (4.0, -2.0, 0.0))  # the log stops 2 m behind it
    write_crossing(tmp_path, drives=((lane, waiting),), seconds=20.0)
    recordings = open_data(tmp_path)
    scenarios = [s for s in _scenarios(recordings) if s.ego_id == 1]
    for planner in ("sampling", "idm"):
        driven = _drive(recordings, scenarios, ConstantVelocity(horizon=15, dt_s=DT_S), planner)
        assert set(driven.endings.tolist()) <= {Ending.OUT_OF_DATA, Ending.GOAL}
        metrics = driving_metrics(driven.drives, PDMS)
        assert metrics["no at-fault collision"].value.tolist() == [1.0] * len(scenarios)
        assert metrics["no collision"].value.tolist() == [1.0] * len(scenarios)


def test_a_run_writes_its_folder(crossings, tmp_path):
    """Metrics, manifest, report, and rollouts by method that can be read again."""
    out = tmp_path / "out"
    Drive(data=str(crossings), out=out, max_scenarios=2).run()
    names = {"scenarios.json", "metrics.csv", "manifest.json", "report.html", "rollouts"}
    names.add("scenarios.csv")
    assert {path.name for path in out.iterdir()} == names
    methods = sorted(path.name for path in (out / "rollouts").iterdir())
    assert methods == ["contingency + constant-velocity", "expert"]
    manifest = json.loads((out / "manifest.json").read_text())
    for method in methods:
        for path in (out / "rollouts" / method).iterdir():
            rollout = Rollout.load(path)
            assert path.stem == rollout.scenario.name
            assert path.stem in manifest["scenarios"]
    with (out / "metrics.csv").open(newline="") as file:
        first = next(csv.DictReader(file))
    assert (first["planner"], first["predictor"], first["subset"]) == ("expert", "", "all")


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"traffic": "logs"}, r"unknown driver 'logs' \(did you mean 'log'"),
        ({"planner": "sampler"}, "unknown planner 'sampler'"),
        ({"max_scenarios": 0}, "--max-scenarios 0: expected at least 1"),
        ({"predictors": ()}, "none given"),
        ({"horizon": 0.1}, "no whole number of ticks"),
        ({"rules": "nuplna"}, r"unknown rules 'nuplna' \(did you mean 'nuplan'"),
        ({"dt": 0.07}, "no whole number of ticks of 0.07 s: choose"),
        ({"jobs": 0}, "--jobs 0: expected 1 to 1024 processes"),
        ({"jobs": 1025}, "--jobs 1025: expected 1 to 1024 processes"),
        ({"jobs": -2}, "--jobs -2: expected"),
        ({"reference": "oracle"}, "--reference oracle: expected one of the predictors, constant"),
        ({"predictors": ("mtp:none/*",)}, r"mtp:none/\*: no folder matches none/\*"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_wrong_options_are_errors_of_one_line(crossings, options, what):
    with pytest.raises(AspEnvError, match=what) as caught:
        drive(Drive(data=str(crossings), out=NOWHERE, **options))
    assert "\n" not in str(caught.value)


def test_configurations_are_frozen_and_equal_by_value():
    config = Drive(data="d", out=NOWHERE)
    assert config == dataclasses.replace(config)
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.__setattr__("planner", "idm")

"""An artificial run folder like those that the commands write."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from asp_env.data.predictor import Forecast, constant_velocity, make_forecast
from asp_env.data.recording import Recording
from asp_env.data.rollout import Rollout
from asp_env.data.scenarios.scenario import Scenario
from asp_env.data.scene import Scene
from asp_env.data.snippets import gather_future, gather_scene, index_snippets
from asp_env.evaluation.report import ForecastExamples
from asp_env.evaluation.report.results import COLUMNS
from asp_env.geometry import route_along

ERRORS_M = {
    "oracle": 0.0,
    "constant-velocity": 3.8,
    "constant-turn-rate": 3.1,
    "ffw-asp:runs/demo": 1.9,
}
SCORES = {
    ("expert", ""): 0.93,
    ("idm", ""): 0.74,
    ("sampling", "oracle"): 0.9,
    ("sampling", "constant-velocity"): 0.7,
    ("sampling", "ffw-asp:runs/demo"): 0.81,
}

SUBSETS = {
    "all": 0.7,
    "moving": 1.0,
    "left": 1.3,
    "straight": 0.8,
    "manoeuvre:left": 1.2,
    "manoeuvre:right": 1.1,
}
"""Factor on the errors, by subset."""


def metric_rows() -> list[dict[str, object]]:
    """Rows of four predictors in open loop and five methods in closed loop."""
    rows: list[dict[str, object]] = []
    for predictor, error in ERRORS_M.items():
        for subset, factor in SUBSETS.items():
            for selection, share in (("most-probable", 1.0), ("best-of-3", 0.6)):
                fde = error * factor * (share if predictor.startswith("ffw") else 1.0)
                values = {"MAE": fde * 0.2, "MSE": fde**2 * 0.1, "FDE": fde, "ADE": fde * 0.4}
                values["miss"] = min(fde / 5, 1)
                values["FDE / constant velocity"] = fde / (3.8 * factor)
                values |= {f"L2@{s}s": fde * (s / 3) ** 1.8 for s in (0.6, 1.0, 2.0, 3.0)}
                common = {"predictor": predictor, "horizon_s": "3", "selection": selection}
                rows += [
                    {**common, "subset": subset, "metric": name, **interval(value)}
                    for name, value in values.items()
                ]
    for (planner, predictor), score in SCORES.items():
        common = {"planner": planner, "predictor": predictor, "traffic": "idm", "latency_ticks": 0}
        values = {
            "score": score,
            "no collision": score**0.4,
            "no at-fault collision": score**0.3,
            "on road": score**0.2,
            "progress": score**0.5,
            "TTC": score,
            "log divergence": 9 * (1 - score),
            "comfort": 0.6 + 0.3 * score,
        }
        rows += [
            {**common, "subset": subset, "metric": name, **interval(value * share)}
            for subset, share in (("all", 1.0), ("left", 0.9))
            for name, value in values.items()
        ]
    return [dict.fromkeys(COLUMNS, "") | {"data": "sample:intersection"} | row for row in rows]


def interval(value: float) -> dict[str, object]:
    """A value with an interval of ten percent on each side."""
    return {"value": value, "low": value * 0.9, "high": value * 1.1, "n": 240}


def write_tables(out: Path, rows: Sequence[dict[str, object]]) -> None:
    """Writes `metrics.csv` and `manifest.json`."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / "metrics.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list[str](COLUMNS))
        writer.writeheader()
        writer.writerows(rows)
    manifest = {
        "command": "asp-env demo",
        "data": "sample:intersection",
        "data_hash": "3f2a9c",
        "seeds": [0, 1],
        "privileged": ["expert", "oracle"],
        "configuration": {"view": "chauffeurnet", "dt_s": 0.2, "limits": {"braking_mps2": 5.0}},
        "versions": {"asp-env": "0.1.0", "numpy": "2.4.6"},
    }
    (out / "manifest.json").write_text(json.dumps(manifest))


def forked(scene: Scene, *, steps: int, bend: float) -> Forecast:
    """Three modes: straight on, and accelerated to either side by `bend` times 0.5 m/s²."""
    straight = constant_velocity(scene, steps=steps)[:, None].repeat(3, axis=1)
    time_s = scene.dt_s * np.arange(1, steps + 1)
    heading = scene.target_states[:, 2]
    left = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)[:, None, None]
    offset_m = np.array([0.0, 1.0, -1.0])[:, None, None] * (bend * 0.25 * time_s**2)[:, None]
    straight[..., :2] += left * offset_m
    log_probs = np.log(np.tile([0.6, 0.25, 0.15], (len(straight), 1)))
    return make_forecast(
        scene,
        states=straight,
        actions=None,
        log_probs=log_probs.astype(np.float32),
        valid=scene.predictable,
    )


def make_examples(recordings: Sequence[Recording], *, count: int) -> ForecastExamples:
    """Some situations with all their targets, and forecasts of three artificial predictors."""
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    keys = index.recording * 100_000 + index.tick
    situations, sizes = np.unique(keys, return_counts=True)
    chosen = np.sort(situations[np.argsort(-sizes, kind="stable")[: 3 * count]])[::3]
    index = index.select(np.isin(keys, chosen))
    scene = gather_scene(recordings, index)
    return ForecastExamples(
        scene=scene,
        future=gather_future(recordings, index),
        forecasts={
            "constant-velocity": forked(scene, steps=15, bend=0.0),
            "constant-turn-rate": forked(scene, steps=15, bend=1.0),
            "ffw-asp": forked(scene, steps=15, bend=2.0),
        },
        captions=tuple(f"{scene.tick[i] * 0.2:.1f} s" for i in range(len(scene.tick))),
    )


def make_rollout(
    recording: Recording, *, track: int, start_tick: int, length: int, lag: float
) -> Rollout:
    """A drive in which the ego follows its track a little behind, with all that is logged."""
    stride = round(0.2 * recording.frame_rate_hz)
    frames = (start_tick + np.arange(length + 1)) * stride
    present = recording.tracks_between(int(frames[0]), int(frames[-1]))
    order = np.concatenate([[track], present[present != track]])
    rows = frames - recording.first_frames[order][:, None]
    valid = ((rows >= 0) & (frames <= recording.last_frames[order][:, None])).T
    rows = np.clip(rows, 0, np.diff(recording.starts)[order][:, None] - 1)
    log = recording.states[recording.starts[order][:, None] + rows].transpose(1, 0, 2)
    log = np.where(valid[..., None], log, 0).astype(np.float32)
    states = log.copy()
    delayed = np.maximum(np.arange(length + 1) * (1 - lag), 0)
    for axis in range(4):
        states[:, 0, axis] = np.interp(delayed, np.arange(length + 1), np.unwrap(log[:, 0, axis]))
    steps = np.arange(1, 16) * 0.2
    slots = np.flatnonzero(valid[:, 1:].any(axis=0))[:12] + 1
    ticks, column = np.nonzero(valid[:length, slots])
    now = states[ticks, slots[column]]
    offset_m = np.array([0.0, 0.25, -0.25])[:, None] * steps**2
    cos, sin = np.cos(now[:, 2]), np.sin(now[:, 2])
    ahead_m = now[:, 3, None, None] * steps + 0 * offset_m
    forecast = np.stack(
        [
            now[:, 0, None, None] + cos[:, None, None] * ahead_m - sin[:, None, None] * offset_m,
            now[:, 1, None, None] + sin[:, None, None] * ahead_m + cos[:, None, None] * offset_m,
        ],
        axis=-1,
    )
    events = np.zeros((length + 1, 2), dtype=bool)
    events[length // 2 : length // 2 + 4, 1] = True
    events[length * 3 // 4, 0] = True
    plan = np.stack([np.interp(np.arange(length)[:, None] + np.arange(15), np.arange(length + 1),
                               states[:, 0, axis]) for axis in (0, 1)], axis=-1)  # fmt: skip
    return Rollout(
        scenario=Scenario(
            source="artificial",
            recording=0,
            recording_name=recording.name,
            start_tick=start_tick,
            length=length,
            ego_id=int(recording.track_ids[track]),
            tags=("left",),
        ),
        dt_s=0.2,
        states=states,
        valid=valid,
        log_states=log,
        log_valid=valid,
        sizes=recording.sizes[order],
        classes=recording.classes[order],
        ids=recording.track_ids[order],
        route=route_along(recording.track(track), beyond_m=30.0).astype(np.float32),
        plans=plan.astype(np.float32),
        forecast_states=forecast.astype(np.float32),
        forecast_log_probs=np.log(np.tile([0.6, 0.25, 0.15], (len(ticks), 1))).astype(np.float32),
        forecast_slots=slots[column],
        forecast_ticks=ticks,
        events=events,
        event_names=("collision", "off-road"),
    )


def difference_rows() -> list[dict[str, object]]:
    """Differences of the score to constant velocity, over all scenarios and by tag."""
    gains = {"oracle": 0.2, "ffw-asp:runs/demo": 0.11, "blind": -0.5}
    rows: list[dict[str, object]] = []
    for predictor, gain in gains.items():
        for subset, share in (("all", 1.0), ("left", 0.5)):
            value = gain * share
            row: dict[str, object] = dict.fromkeys(COLUMNS, "")
            row |= {"data": "sample:intersection", "traffic": "idm", "latency_ticks": 0}
            row |= {"planner": "sampling", "predictor": predictor, "subset": subset, "n": 240}
            row |= {"metric": "score - constant-velocity", "value": value, "p_holm": 0.001}
            rows.append(row | {"low": value - 0.05, "high": value + 0.05, "mde": 0.07})
    return rows


def write_scenario_values(out: Path, scores: dict[str, tuple[float, float]]) -> None:
    """Writes `scenarios.csv` with the scores of `ffw-asp` and constant velocity by scenario."""
    lines = ["scenario,recording,location,tags,planner,predictor,run,ending,score"]
    for name, pair in scores.items():
        for predictor, score in zip(("ffw-asp:runs/demo", "constant-velocity"), pair, strict=True):
            place = name.partition("-")[0]
            cells = (name, place, place, "left", "sampling", predictor, "", "GOAL", f"{score:g}")
            lines.append(",".join(cells))
    (out / "scenarios.csv").write_text("\n".join(lines) + "\n")


def write_run(out: Path, recordings: Sequence[Recording]) -> None:
    """Writes a folder with tables and three rollouts of each of two methods."""
    write_tables(out, [*metric_rows(), *difference_rows()])
    manifest = json.loads((out / "manifest.json").read_text())
    manifest |= {"planner": "sampling", "traffic": "idm", "horizon_s": 3.0, "dt_s": 0.2}
    manifest |= {"metrics": {"preset": "pdms"}}
    manifest["predictors"] = {"constant-velocity": {}, "ffw-asp:runs/demo": {}}
    (out / "manifest.json").write_text(json.dumps(manifest))
    for method, lag in (("sampling + constant-velocity", 0.3), ("sampling + ffw-asp", 0.1)):
        folder = out / "rollouts" / method
        folder.mkdir(parents=True)
        recording = recordings[0]
        long = np.flatnonzero(
            recording.predicted & (recording.last_frames - recording.first_frames > 300)
        )
        extents = [np.ptp(recording.track(int(t))[:, :2], axis=0).sum() for t in long]
        for track in long[np.argsort(extents)[-3:]]:
            stride = round(0.2 * recording.frame_rate_hz)
            start = -(-int(recording.first_frames[track]) // stride)
            length = min(75, int(recording.last_frames[track]) // stride - start)
            rollout = make_rollout(
                recording, track=int(track), start_tick=start, length=length, lag=lag
            )
            rollout.save(folder / f"{rollout.scenario.name}.npz")
    names = sorted(path.stem for path in folder.iterdir())
    scores = zip(names, ((0.9, 0.4), (0.2, 0.7), (0.8, 0.8)), strict=True)
    write_scenario_values(out, dict(scores))

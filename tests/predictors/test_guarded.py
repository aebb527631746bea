"""The guard: when a forecast is blended to constant velocity, how, and how it is reported."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from asp_env.data.predictor import Forecast, constant_velocity, load_predictor
from asp_env.data.scene import Scene
from asp_env.data.snippets import gather_scene, index_snippets
from asp_env.dynamics import rollout
from asp_env.errors import AspEnvError, CheckpointError
from asp_env.evaluation.closed_loop.drive import Drive
from asp_env.evaluation.closed_loop.episodes import fallback_share as share_of_episodes
from asp_env.evaluation.open_loop.evaluate import Evaluate
from asp_env.evaluation.selection import short_names, with_fallback
from predictors.guarded import FULL_AT, blended, fallback_share
from tests.builders import make_recording
from tests.predictors.tiny import save_distance, save_random, write_data


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of random weights, which forecasts anything but constant velocity."""
    return save_random(tmp_path_factory.mktemp("runs") / "run", "ffw-asp", "vectors")


@pytest.fixture(scope="module")
def scene() -> Scene:
    recordings = [make_recording()]
    return gather_scene(recordings, index_snippets(recordings, dt_s=0.2, horizon_s=3.0))


def forecasts(run: Path, scene: Scene, *, threshold: float) -> tuple[Forecast, Forecast]:
    """The forecast with a guard, and without one."""
    save_distance(run, threshold=threshold)
    with_guard, without = (
        load_predictor(name, horizon=15, dt_s=0.2).predict(scene)
        for name in (f"guarded:ffw-asp:{run}", f"ffw-asp:{run}")
    )
    return with_guard, without


def test_share_of_constant_velocity_by_hand() -> None:
    """0 up to 1, a half in the middle, 1 from `FULL_AT`; a quarter of the way is 5/32."""
    score = np.array([0, 1, 1 + (FULL_AT - 1) / 4, 1 + (FULL_AT - 1) / 2, FULL_AT, 9.0])
    np.testing.assert_allclose(fallback_share(score), [0, 0, 5 / 32, 0.5, 1, 1])


def test_forecast_near_the_training_keeps_its_bits(run: Path, scene: Scene) -> None:
    one, other = forecasts(run, scene, threshold=1e6)
    for field in ("states", "actions", "log_probs", "valid"):
        np.testing.assert_array_equal(getattr(one, field), getattr(other, field), field)
    assert one.fallback is not None
    assert not one.fallback.any()
    assert other.fallback is None


def test_forecast_far_from_the_training_is_constant_velocity(run: Path, scene: Scene) -> None:
    """Bit for bit, in every mode, with zero actions; probabilities are unchanged."""
    one, other = forecasts(run, scene, threshold=1e-6)
    straight = constant_velocity(scene, steps=15)
    for mode in range(one.states.shape[1]):
        np.testing.assert_array_equal(one.states[:, mode], straight)
    assert not one.actions.any()
    np.testing.assert_array_equal(one.log_probs, other.log_probs)
    assert one.fallback is not None
    np.testing.assert_array_equal(one.fallback, 1)


def test_blended_modes_are_drivable_and_between_both(run: Path, scene: Scene) -> None:
    """At half the share the actions are halved, and the states are their rollout."""
    _, forecast = forecasts(run, scene, threshold=1e6)
    share = np.full(len(forecast.valid), 0.5, dtype=np.float32)
    half = blended(forecast, scene, share, "heun")
    np.testing.assert_allclose(half.actions, forecast.actions / 2)
    at = (scene.targets[:, 0], scene.targets[:, 1])
    start = np.repeat(scene.target_states[:, None], 3, axis=1)
    expected = rollout(start, half.actions, scene.sizes[at][:, :1], 0.2)
    np.testing.assert_allclose(half.states[..., :2], expected[..., :2], atol=1e-4)
    # A tiny share changes almost nothing, so that forecasts do not jump at the threshold.
    little = blended(forecast, scene, share * np.float32(2e-6), "heun")
    np.testing.assert_allclose(little.states[..., :2], forecast.states[..., :2], atol=1e-3)


def test_positions_are_blended_linearly(tmp_path: Path, scene: Scene) -> None:
    """A network that predicts positions has no actions."""
    run = save_random(tmp_path / "run", "mtp", "vectors")
    forecast = load_predictor(f"mtp:{run}", horizon=15, dt_s=0.2).predict(scene)
    share = np.full(len(forecast.valid), 0.25, dtype=np.float32)
    found = blended(forecast, scene, share, "heun").states
    straight = constant_velocity(scene, steps=15)[:, None]
    expected = 0.75 * forecast.states + 0.25 * straight
    np.testing.assert_allclose(found[..., [0, 1, 3]], expected[..., [0, 1, 3]], atol=1e-4)


def test_vehicle_that_reverses_continues_to(scene: Scene, run: Path) -> None:
    """Constant velocity reverses; so does a mode that is almost constant velocity."""
    _, forecast = forecasts(run, scene, threshold=1e6)
    states = scene.states.copy()
    states[..., 3] = -np.abs(states[..., 3]) - 1
    backwards = dataclasses.replace(scene, states=states)
    share = np.full(len(forecast.valid), 0.999, dtype=np.float32)
    found = blended(forecast, backwards, share, "heun").states
    straight = constant_velocity(backwards, steps=15)[:, None]
    np.testing.assert_allclose(found[..., :2], np.repeat(straight, 3, axis=1)[..., :2], atol=0.1)


def test_names() -> None:
    """Trained predictors are wrapped, inside of what changes their forecasts; others are not."""
    given = ["constant-velocity", "ffw-asp:a", "delayed:2:most-probable:mtp:b", "guarded:dkm:c"]
    assert with_fallback(given) == (
        "constant-velocity",
        "guarded:ffw-asp:a",
        "delayed:2:most-probable:guarded:mtp:b",
        "guarded:dkm:c",
    )
    labels = short_names(["ffw-asp:runs/1", "guarded:ffw-asp:runs/1"])
    assert [*labels.values()] == ["ffw-asp", "guarded ffw-asp"]


def test_what_cannot_be_guarded_is_refused(tmp_path: Path) -> None:
    for name in ("guarded", "guarded:oracle", "guarded:delayed:2:ffw-asp:pretrained"):
        with pytest.raises(AspEnvError, match="expected guarded:NAME:RUN"):
            load_predictor(name, horizon=15, dt_s=0.2)
    run = save_random(tmp_path / "run", "dkm", "vectors")
    with pytest.raises(CheckpointError, match=rf"fit_features dkm:{run} VALIDATION_DATA"):
        load_predictor(f"guarded:dkm:{run}", horizon=15, dt_s=0.2)


def test_other_predictors_pass_the_share_on(run: Path) -> None:
    save_distance(run, threshold=1e-6)
    recordings = [make_recording()]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0, history_s=3.2)
    scene = gather_scene(recordings, index)
    for name in ("most-probable", "delayed:1"):
        wrapped = load_predictor(f"{name}:guarded:ffw-asp:{run}", horizon=14, dt_s=0.2)
        forecast = wrapped.predict(scene)
        assert forecast.fallback is not None
        assert (forecast.fallback[forecast.valid] == 1).all()


def test_share_of_an_episode_by_hand(run: Path, scene: Scene) -> None:
    """Of two ticks with the same targets, one is blended: half of the forecasts."""
    every, nothing = (forecasts(run, scene, threshold=t)[0] for t in (1e-6, 1e6))
    count = len(scene.states)
    found = share_of_episodes([every, nothing], count + 1)
    np.testing.assert_allclose(found.value[found.valid], 0.5)
    assert not found.valid[count]
    assert not share_of_episodes([forecasts(run, scene, threshold=1.0)[1]], count).valid.any()


def test_evaluate_and_drive_report_how_often(run: Path, tmp_path: Path) -> None:
    """In the manifest and as rows; a predictor without a guard has none."""
    data = write_data(tmp_path / "data")
    save_distance(run, threshold=1e-6)
    names = ("constant-velocity", f"ffw-asp:{run}")
    guarded = f"guarded:ffw-asp:{run}"
    Evaluate(
        data=data, out=tmp_path / "evaluated", predictors=names, planner="none", fallback=True
    ).run()
    Drive(
        data=data, out=tmp_path / "driven", predictors=names, max_scenarios=2, fallback=True
    ).run()
    for folder in ("evaluated", "driven"):
        manifest = json.loads((tmp_path / folder / "manifest.json").read_text())
        assert [*manifest["predictors"]] == ["constant-velocity", guarded]
        assert [*manifest["fallback"]] == [guarded]
        assert manifest["fallback"][guarded] == 1
        assert f"{guarded},".encode() in (tmp_path / folder / "metrics.csv").read_bytes()

"""Training, run folders, and what loading refuses."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from asp_env.data.predictor import load_predictor
from asp_env.data.scenarios.selection import choose_scenarios
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError
from policies.curriculum import number_drawn, ordered
from policies.evaluation import METRICS, evaluate_trained
from policies.logged_steps import logged_steps
from policies.runs import CHECKPOINT, POLICY, check_predictor, load_policy, read_tensors
from policies.settings import CONFIG, EnvironmentSettings, PolicySettings, read_settings
from policies.training import checkpoint_of, train_policy
from tests.policies.conftest import small_settings


def test_the_same_settings_give_the_same_weights(run: Path, tmp_path: Path) -> None:
    train_policy(small_settings(), tmp_path / "again")
    assert (tmp_path / "again" / POLICY).read_bytes() == (run / POLICY).read_bytes()
    train_policy(small_settings(seed=1), tmp_path / "other")
    assert (tmp_path / "other" / POLICY).read_bytes() != (run / POLICY).read_bytes()


def test_settings_survive_the_run_folder(run: Path) -> None:
    assert read_settings(run) == small_settings()
    assert not list(run.glob("*.pkl")) + list(run.glob("*.zip"))


def test_a_trained_policy_drives(run: Path) -> None:
    driven = evaluate_trained(load_policy(run), "sample:roundabout", max_scenarios=5)
    assert set(driven.values) == set(METRICS)
    ended = [driven.values[name] for name in METRICS[:3]]
    assert (np.sum(ended, axis=0) <= 1.0).all(), "an episode has one ending"
    assert all(np.isfinite(each).all() for each in driven.values.values())


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_an_interrupted_training_is_resumed(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes: dict[str, object] = {"algorithm": algorithm}
    if algorithm == "sac":
        changes["hyperparameters"] = {"buffer_size": 500, "learning_starts": 16, "batch_size": 16}
    settings = dataclasses.replace(small_settings(), **changes)  # pyright: ignore[reportArgumentType]
    monkeypatch.setattr("policies.training.CHECKPOINT_STEPS", 64)

    def stop(steps: int) -> None:
        if steps >= 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_policy(settings, tmp_path / "run", progress=stop)
    assert (tmp_path / "run" / CHECKPOINT).exists()
    saved = read_tensors(tmp_path / "run" / CHECKPOINT)
    restored = {}

    def note(steps: int) -> None:
        restored.setdefault("first", steps)

    train_policy(settings, tmp_path / "run", resume=True, progress=note)
    assert restored["first"] == int(saved["numbers"][0])
    assert not (tmp_path / "run" / CHECKPOINT).exists()
    steps = int(saved["numbers"][0])
    assert {f"progress-{steps}.csv", "progress.csv"} <= {
        path.name for path in (tmp_path / "run").iterdir()
    }
    load_policy(tmp_path / "run")


def test_a_checkpoint_restores_weights_and_moments(tmp_path: Path) -> None:
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

    from policies.environments import make_environments
    from policies.runs import write_tensors
    from policies.training import _restore, make_algorithm

    settings = small_settings()
    envs = VecNormalize(
        VecMonitor(make_environments(settings.environment, settings.data, 4, scenarios="")),
        norm_obs=False,
    )
    trained = make_algorithm(settings, envs)
    trained.learn(128)
    saved = checkpoint_of(trained, envs)
    write_tensors(tmp_path / CHECKPOINT, saved)
    fresh = make_algorithm(dataclasses.replace(settings, seed=9), envs)
    assert _restore(tmp_path, fresh, envs) == 128
    again = checkpoint_of(fresh, envs)
    assert set(again) == set(saved)
    assert any(name.startswith("policy.optimizer/state") for name in saved)
    for name, value in saved.items():
        torch.testing.assert_close(again[name], value, rtol=0, atol=0)


class TestRefusals:
    def test_an_existing_folder(self, run: Path) -> None:
        with pytest.raises(AspEnvError, match="not an empty folder"):
            train_policy(small_settings(), run)

    def test_nothing_to_resume(self, run: Path, tmp_path: Path) -> None:
        with pytest.raises(AspEnvError, match="training has ended"):
            train_policy(small_settings(), run, resume=True)
        with pytest.raises(AspEnvError, match="no run to resume"):
            train_policy(small_settings(), tmp_path, resume=True)

    def test_a_run_that_was_killed_after_its_last_file(self, run: Path, tmp_path: Path) -> None:
        """It is finished; its checkpoint is removed."""
        shutil.copytree(run, tmp_path / "run")
        (tmp_path / "run" / CHECKPOINT).write_text("old")
        with pytest.raises(AspEnvError, match="training has ended"):
            train_policy(small_settings(), tmp_path / "run", resume=True)
        assert not (tmp_path / "run" / CHECKPOINT).exists()
        load_policy(tmp_path / "run")

    def test_other_settings(self, run: Path, tmp_path: Path) -> None:
        shutil.copytree(run, tmp_path / "run")
        (tmp_path / "run" / POLICY).unlink()
        with pytest.raises(AspEnvError, match=r"other settings \(seed, gamma\)"):
            train_policy(small_settings(seed=7, gamma=0.5), tmp_path / "run", resume=True)

    def test_another_predictor(self, run: Path) -> None:
        check_predictor(run, load_predictor("constant-velocity", horizon=15, dt_s=0.2))
        with pytest.raises(AspEnvError, match="trained with predictor constant-velocity, given"):
            check_predictor(run, load_predictor("constant-turn-rate", horizon=15, dt_s=0.2))

    def test_another_observation(self, run: Path) -> None:
        trained = load_policy(run)
        with pytest.raises(AspEnvError, match="observation 'forecast'"):
            trained.act({"forecast": np.zeros((1, 3))})

    @pytest.mark.parametrize("content", ["{", "[]", '{"settings": {"steps": 1}}'])
    def test_damaged_settings(self, content: str, run: Path, tmp_path: Path) -> None:
        shutil.copytree(run, tmp_path / "run")
        (tmp_path / "run" / CONFIG).write_text(content)
        with pytest.raises(AspEnvError, match=CONFIG):
            load_policy(tmp_path / "run")

    def test_damaged_weights(self, run: Path, tmp_path: Path) -> None:
        shutil.copytree(run, tmp_path / "run")
        (tmp_path / "run" / POLICY).write_bytes(b"nothing")
        with pytest.raises(AspEnvError, match="damaged"):
            load_policy(tmp_path / "run")

    def test_weights_of_another_network(self, run: Path, tmp_path: Path) -> None:
        shutil.copytree(run, tmp_path / "run")
        path = tmp_path / "run" / CONFIG
        content = json.loads(path.read_text())
        content["settings"]["width"] = 24
        path.write_text(json.dumps(content))
        with pytest.raises(AspEnvError, match="does not fit"):
            load_policy(tmp_path / "run")

    @pytest.mark.parametrize(
        ("field", "value"),
        [
            ("steps", 0),
            ("gamma", 1.0),
            ("learning_rate", 0.0),
            ("learning_rate", 1e300),
            ("seed", -1),
            ("seed", 2**32),
            ("encoder", "ssp-asp:pretrained"),
            ("algorithm", "dqn"),
        ],
    )
    def test_settings(self, field: str, value: object) -> None:
        with pytest.raises(AspEnvError, match=field if field != "algorithm" else "dqn"):
            PolicySettings(**{field: value})  # pyright: ignore[reportArgumentType]

    def test_cloning(self) -> None:
        with pytest.raises(AspEnvError, match="number of epochs"):
            PolicySettings(algorithm="bc")
        with pytest.raises(AspEnvError, match="only ppo"):
            PolicySettings(algorithm="sac", demonstrations=2)

    @pytest.mark.parametrize(
        "fields",
        [
            {"raster_px": (90, 60)},
            {"view": "chauffeurnet", "raster_px": (35, 60)},
            {"forecast": {"modes": 1}},
        ],
        ids=["no view", "too small", "no predictor"],
    )
    def test_observations(self, fields: dict[str, Any]) -> None:
        """What nothing would use, and rasters of which the convolutions leave nothing."""
        with pytest.raises(AspEnvError, match=[*fields][-1]):
            PolicySettings(environment=EnvironmentSettings(**fields))

    @pytest.mark.parametrize(
        ("algorithm", "name", "value", "message"),
        [
            ("ppo", "n_stepz", 3, "unknown hyperparameter of ppo 'n_stepz' .did you mean 'n_st"),
            ("ppo", "n_steps", 0, "n_steps 0: expected a whole number of at least 1"),
            ("ppo", "batch_size", 1.5, "batch_size 1.5: expected a whole number of at least 1"),
            ("ppo", "ent_coef", float("nan"), "ent_coef nan: expected a finite number"),
            ("ppo", "clip_range", "x", "clip_range 'x': expected a finite number"),
            ("ppo", "seed", 1, "hyperparameter seed: it is an option of its own, seed"),
            ("ppo", "batch_size", 1, "`batch_size` must be greater than 1"),
            ("ppo", "target_kl", "x", "target_kl 'x': expected a finite number"),
            ("ppo", "policy_kwargs", 1, "unknown hyperparameter of ppo 'policy_kwargs'"),
            ("sac", "train_freq", 0, "train_freq 0: expected a whole number of at least 1"),
            ("sac", "buffer_size", 10**15, "not enough memory"),
        ],
    )
    def test_hyperparameters_of_the_algorithm(
        self, algorithm: str, name: str, value: object, message: str, tmp_path: Path
    ) -> None:
        """Before the run folder is made."""
        settings = dataclasses.replace(
            small_settings(algorithm=algorithm), hyperparameters={name: value}
        )
        with pytest.raises(AspEnvError, match=message):
            train_policy(settings, tmp_path / "run")
        assert not (tmp_path / "run").exists()

    def test_a_training_that_diverges(self, tmp_path: Path) -> None:
        """A target network that moves far beyond the network itself."""
        given = {"buffer_size": 500, "learning_starts": 16, "batch_size": 16, "tau": 1e30}
        settings = dataclasses.replace(small_settings(algorithm="sac"), hyperparameters=given)
        with pytest.raises(AspEnvError, match=r"the training diverged after .* smaller learning"):
            train_policy(settings, tmp_path / "run")

    def test_an_unknown_column_and_a_file_in_the_way(self, tmp_path: Path) -> None:
        """Before the run folder is made."""
        (tmp_path / "file").touch()
        with pytest.raises(AspEnvError, match="cannot be written"):
            train_policy(small_settings(), tmp_path / "file" / "run")
        with pytest.raises(AspEnvError, match="desnity"):
            train_policy(small_settings(curriculum="desnity"), tmp_path / "run")
        assert [path.name for path in tmp_path.iterdir()] == ["file"]

    def test_hyperparameters(self, tmp_path: Path) -> None:
        settings = dataclasses.replace(small_settings(), hyperparameters={"n_stepz": 3})
        with pytest.raises(AspEnvError, match="n_stepz"):
            train_policy(settings, tmp_path / "run")


def test_cloned_actions_are_nearer_to_the_logged_ones(run: Path, tmp_path: Path) -> None:
    settings = small_settings(algorithm="bc", demonstrations=8, num_envs=32)
    train_policy(settings, tmp_path / "bc")
    steps = logged_steps(settings)
    assert len(steps.actions) == len(steps.recording)
    errors = [
        np.abs(load_policy(folder).act(steps.observations) - steps.actions).mean()
        for folder in (tmp_path / "bc", run)
    ]
    assert errors[0] < 0.9 * errors[1]


def test_curriculum_by_hand() -> None:
    assert [number_drawn(100, share) for share in (0.0, 0.25, 0.5, 1.0)] == [30, 65, 100, 100]
    scenarios = choose_scenarios(open_data("sample:roundabout"), "", dt_s=0.2, history=15)
    densities = ordered(scenarios, "density").column("density")
    assert (np.diff(densities) >= 0).all()
    falling = ordered(scenarios, "-density").column("density")
    assert (np.diff(falling) <= 0).all()


def test_a_curriculum_starts_with_the_easy_scenarios(tmp_path: Path) -> None:
    train_policy(small_settings(curriculum="density"), tmp_path / "run")
    table = (tmp_path / "run" / "progress.csv").read_text().splitlines()
    assert "curriculum/scenarios" in table[0]

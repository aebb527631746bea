"""Demonstrations: the logged drivers' episodes in Minari's format, as their clients read them."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from asp_env.cli import main
from asp_env.envs import ReplayEnv, ReplayVectorEnv
from asp_env.errors import AspEnvError, DataError
from policies.dataset import load_steps
from policies.demonstrations import Demonstrations, record_episodes
from tests.envs.same import same

h5py = pytest.importorskip("h5py")

DATA = "sample:intersection"
PARTS = ("state", "route")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All scenarios of the sample."""
    out = tmp_path_factory.mktemp("sets") / "sample-v0"
    Demonstrations(data=DATA, out=out, observations=PARTS, seed=7).run()
    return out


@pytest.fixture(scope="module")
def flat(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three scenarios of the sample with flat observations."""
    out = tmp_path_factory.mktemp("sets") / "flat-v0"
    Demonstrations(data=DATA, out=out, observations=PARTS, flat=True, max_scenarios=3).run()
    return out


def test_all_logged_drivers_reach_the_goal(dataset: Path) -> None:
    """46 episodes in the order of the scenarios; each ends once, at its last step."""
    scenarios = ReplayEnv(DATA, observations=("state",)).scenarios
    with h5py.File(dataset / "data/main_data.hdf5") as file:
        assert len(file) == 46
        for number in range(46):
            group = file[f"episode_{number}"]
            assert group.attrs["ending"] == "GOAL"
            assert group.attrs["scenario"] == scenarios[number].name
            assert group.attrs["seed"] == 7 + number
            steps = len(group["actions"])
            assert group["terminations"][()].tolist() == [False] * (steps - 1) + [True]
            assert not group["truncations"][()].any()
            assert len(group["observations/state"]) == len(group["infos/clipped"]) == steps + 1
            assert np.abs(group["actions"]).max() <= 1
            assert group["rewards"][()].sum() > 0.8


def test_episodes_can_be_driven_again(dataset: Path) -> None:
    """The stored seed, options and actions give the same bits in a single environment."""
    env = ReplayEnv(DATA, observations=PARTS)
    with h5py.File(dataset / "data/main_data.hdf5") as file:
        for number in (0, 20, 45):
            group = file[f"episode_{number}"]
            options = {"scenario": int(group.attrs["options/scenario"])}
            observation, _ = env.reset(seed=int(group.attrs["seed"]), options=options)
            for tick, action in enumerate(group["actions"]):
                for name in PARTS:
                    same(observation[name], group["observations"][name][tick])
                observation, reward, *ends, info = env.step(action)
                assert reward == group["rewards"][tick]
                assert ends == [group["terminations"][tick], group["truncations"][tick]]
                assert info["progress"] == group["infos/progress"][tick + 1]


def test_episodes_do_not_depend_on_the_batch() -> None:
    """One, two and five environments side by side, in traffic that draws random numbers."""
    numbers, recorded = [3, 9, 1, 30], []
    for num_envs in (1, 2, 5):
        envs = ReplayVectorEnv(
            num_envs,
            DATA,
            observations=("state",),
            traffic="predictor:mode=sampled:constant-turn-rate",
            autoreset_mode="Disabled",
        )
        recorded.append(list(record_episodes(envs, numbers, 5)))
    assert [each["options"]["scenario"] for each in recorded[0]] == numbers
    same(recorded[0], recorded[1])
    same(recorded[0], recorded[2])


def test_the_same_command_writes_the_same_bytes(flat: Path, tmp_path: Path) -> None:
    out = tmp_path / "flat-v0"
    Demonstrations(data=DATA, out=out, observations=PARTS, flat=True, max_scenarios=3).run()
    for name in ("data/main_data.hdf5", "data/metadata.json"):
        assert (out / name).read_bytes() == (flat / name).read_bytes()


def test_steps_are_loaded_with_their_groups(dataset: Path, flat: Path) -> None:
    """By entry, and flat: 9 numbers of the state and 60 of the route."""
    steps = load_steps(dataset)
    count = json.loads((dataset / "data/metadata.json").read_text())["total_steps"]
    assert isinstance(steps.observations, dict)
    assert {name: each.shape for name, each in steps.observations.items()} == {
        "state": (count, 9),
        "route": (count, 30, 2),
    }
    assert (len(steps.actions), len(steps.recording)) == (count, count)
    assert np.unique(steps.episode).tolist() == list(range(46))
    assert 0 < steps.clipped.sum() < 10
    flat_steps = load_steps(flat)
    assert isinstance(flat_steps.observations, np.ndarray)
    first = np.concatenate([steps.observations["state"][0], steps.observations["route"][0].ravel()])
    np.testing.assert_array_equal(flat_steps.observations[0], first)


def test_minari_recovers_an_environment_with_flat_observations(flat: Path) -> None:
    minari = pytest.importorskip("minari")
    data = minari.load_dataset(str(flat))
    env = data.recover_environment()
    assert env.observation_space == data.observation_space
    assert isinstance(env.observation_space, gymnasium.spaces.Box)
    observation, _ = env.reset(options={"scenario": 0})
    np.testing.assert_array_equal(observation, data[0].observations[0])


def test_minari_loads_the_folder(dataset: Path) -> None:
    """By its path and by its name, and recovers the environment."""
    minari = pytest.importorskip("minari")
    data = minari.load_dataset(str(dataset))
    assert (data.total_episodes, data.spec.dataset_id) == (46, "sample-v0")
    episode = data[0]
    assert episode.observations["route"].shape == (len(episode) + 1, 30, 2)
    assert set(episode.infos) >= {"clipped", "progress"}
    (metadata,) = data.storage.get_episode_metadata([0])
    env = data.recover_environment()
    observation, _ = env.reset(seed=metadata["seed"], options={"scenario": 0})
    assert env.observation_space == data.observation_space
    for name, value in observation.items():
        np.testing.assert_array_equal(value, episode.observations[name][0])


def test_minari_lists_the_folder(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(dataset.parent))
    assert minari.list_local_datasets()["sample-v0"]["total_episodes"] == 46
    assert minari.load_dataset("sample-v0").total_steps > 1000


def test_d3rlpy_trains_on_flat_observations(flat: Path) -> None:
    """Its data set has the same episodes, and its behaviour cloning runs on them."""
    d3rlpy = pytest.importorskip("d3rlpy")
    steps = load_steps(flat)
    data = d3rlpy.dataset.MDPDataset(
        steps.observations, steps.actions, steps.rewards, steps.terminations, steps.truncations
    )
    assert len(data.episodes) == 3
    for number, episode in enumerate(data.episodes):
        rows = steps.episode == number
        np.testing.assert_array_equal(episode.observations, np.asarray(steps.observations)[rows])
        np.testing.assert_array_equal(episode.actions, steps.actions[rows])
    algorithm = d3rlpy.algos.BCConfig(batch_size=32).create()
    no_files = d3rlpy.logging.NoopAdapterFactory()
    algorithm.fit(
        data, n_steps=2, n_steps_per_epoch=2, show_progress=False, logger_adapter=no_files
    )
    assert algorithm.predict(np.asarray(steps.observations)[:1]).shape == (1, 2)


def rejected(capsys: pytest.CaptureFixture[str], *args: str) -> str:
    """Runs the command with bad input and returns its one line."""
    assert main(["rl", "demonstrations", *args]) == 2
    output = capsys.readouterr()
    assert output.err.count("\n") == 1
    return output.err


def test_invalid_options_are_rejected(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Nothing is written."""
    taken = tmp_path / "taken-v0"
    taken.mkdir()
    (taken / "file").touch()
    cases: list[tuple[list[str], str]] = [
        ([DATA, "--out", str(tmp_path / "demos")], "such as demos-v0"),
        ([DATA, "--out", str(taken)], "exists already; choose another or remove it"),
        ([DATA, "--out", str(tmp_path / "a-v0"), "--max-scenarios", "0"], "expected at least 1"),
        ([DATA, "--out", str(tmp_path / "a-v0"), "--observations", "stat"], "state"),
        ([DATA, "--out", str(tmp_path / "a-v0"), "--seed", "-1"], "--seed -1: expected 0 to 429"),
        ([DATA, "--out", str(tmp_path / "a-v0"), "--seed", "99999999999"], "expected 0 to 429"),
        ([str(tmp_path / "none"), "--out", str(tmp_path / "a-v0")], "does not exist"),
        (["", "--out", str(tmp_path / "a-v0")], "data '': expected a folder with recordings"),
    ]
    for args, message in cases:
        assert message in rejected(capsys, *args), args
    assert [path.name for path in tmp_path.iterdir()] == ["taken-v0"]


def test_reacting_traffic_has_no_demonstrations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which is known before the traffic is made."""
    pytest.importorskip("highway_env")
    monkeypatch.setattr("policies.demonstrations.open_data", None)
    command = Demonstrations(data="highway:intersection", out=tmp_path / "a-v0")
    with pytest.raises(AspEnvError, match="its traffic reacts and has no logged drivers"):
        command.run()


def test_an_interrupted_command_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr("policies.demonstrations.record_episodes", interrupted)
    with pytest.raises(KeyboardInterrupt):
        Demonstrations(data=DATA, out=tmp_path / "a-v0", observations=PARTS).run()
    assert list(tmp_path.iterdir()) == []


FULL = """
import resource, sys
from pathlib import Path
import h5py, numpy as np
from asp_env.files import atomic_folder
from policies.dataset import _LateErrors

resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY))
with atomic_folder(Path("out")) as folder, _LateErrors(folder / "data.hdf5") as disk:
    with h5py.File(disk, "w") as file:
        for number in range(20):
            file.create_dataset(str(number), data=np.random.rand(1000))
    disk.check()
"""


@pytest.mark.parametrize("most_bytes", [1, 100_000])
def test_a_full_disk_is_an_error(tmp_path: Path, most_bytes: int) -> None:
    """HDF5 alone would end the process."""
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(most_bytes)],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    error = done.stderr.splitlines()[-1]
    assert "AspEnvError: out/data.hdf5 cannot be written (File too large); free some" in error
    assert list(tmp_path.iterdir()) == []


def test_folders_without_a_data_set(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="asp-env rl demonstrations makes one"):
        load_steps(tmp_path)
    (tmp_path / "data").mkdir()
    (tmp_path / "data/main_data.hdf5").write_text("text")
    with pytest.raises(DataError, match="expected a file of asp-env rl demonstrations"):
        load_steps(tmp_path)

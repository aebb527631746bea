"""Checkpoints: damaged ones are refused in one line, others load as they were saved."""

import dataclasses
import hashlib
import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from asp_env.data.predictor import load_predictor
from asp_env.data.scene import Scene
from asp_env.data.snippets import gather_scene, index_snippets
from asp_env.errors import AspEnvError, CheckpointError
from asp_env.views import make_view
from predictors.inference.checkpoint import load_trained
from predictors.plugs import SSPASP
from predictors.training.trainer import SafetensorsIO
from tests.builders import make_recording
from tests.predictors.tiny import make_network, save_random, tiny_network, tiny_shape


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A checkpoint with random weights."""
    return save_random(tmp_path / "run")


def change(run: Path, **fields: Any) -> None:
    """Changes fields of its configuration."""
    path = run / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **fields}))


def change_network(run: Path, **fields: Any) -> None:
    """Changes fields of its network's configuration."""
    config = json.loads((run / "config.json").read_text())
    change(run, network={**config["network"], **fields})


def change_training(run: Path, **fields: Any) -> None:
    """Changes fields of its training configuration."""
    provenance = json.loads((run / "config.json").read_text())["provenance"]
    change(run, provenance={**provenance, "config": {**provenance["config"], **fields}})


def drop(run: Path, field: str) -> None:
    """Removes a field of its configuration."""
    path = run / "config.json"
    config = json.loads(path.read_text())
    del config[field]
    path.write_text(json.dumps(config))


def truncate(run: Path, name: str, size: int) -> None:
    """Truncates a file to its first bytes."""
    (run / name).write_bytes((run / name).read_bytes()[:size])


def poison(run: Path) -> None:
    """Sets a weight to NaN."""
    weights = load_file(run / "weights.safetensors")
    weights["norm.bias"][0] = float("nan")
    save_file(weights, run / "weights.safetensors")


def weaken(run: Path) -> None:
    """Changes a weight a little."""
    weights = load_file(run / "weights.safetensors")
    weights["norm.bias"][0] += 0.5
    save_file(weights, run / "weights.safetensors")


FAULTS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no configuration": (lambda run: (run / "config.json").unlink(), "holds no trained predictor"),
    "no weights": (lambda run: (run / "weights.safetensors").unlink(), "is missing: the run"),
    "truncated configuration": (lambda run: truncate(run, "config.json", 100), "cannot be read"),
    "truncated weights": (
        lambda run: truncate(run, "weights.safetensors", 3000),
        "cannot be read",
    ),
    "empty weights": (lambda run: truncate(run, "weights.safetensors", 0), "cannot be read"),
    "pickled weights": (
        lambda run: (run / "weights.safetensors").write_bytes(pickle.dumps({"a": 1})),
        "cannot be read",
    ),
    "foreign JSON": (lambda run: (run / "config.json").write_text("[1, 2]"), "no checkpoint of"),
    "other format": (lambda run: change(run, format=99), "no checkpoint of format 1"),
    "other predictor": (lambda run: change(run, predictor="mtp"), "holds the predictor 'mtp'"),
    "predictor without a name": (lambda run: drop(run, "predictor"), "does not name"),
    "no view": (lambda run: drop(run, "view"), "does not describe a ffw-asp: 'view'"),
    "unknown view": (lambda run: change(run, view={"name": "moon"}), "unknown view 'moon'"),
    "view of vectors": (
        lambda run: change(run, view=make_view("vectors").config()),
        "encoder small reads rasters, the view renders vectors",
    ),
    "view of other rasters": (
        lambda run: change(run, view=make_view("mtp", pixels=(36, 36)).config()),
        "does not fit|but it was trained with",
    ),
    "no temperature": (lambda run: drop(run, "temperature"), "does not describe a ffw-asp"),
    "temperature of None": (lambda run: change(run, temperature=None), "does not describe"),
    "no normaliser": (lambda run: change(run, normaliser={}), "does not describe"),
    "no horizon": (lambda run: drop(run, "horizon"), "does not describe"),
    "unknown field": (lambda run: change_network(run, colour=1), "colour"),
    "impossible field": (lambda run: change_network(run, modes=0), "modes is 0"),
    "field of another type": (lambda run: change_network(run, features="x"), "does not describe"),
    "other shapes": (lambda run: change_network(run, gru_width=9), "does not fit"),
    "weights for another horizon": (lambda run: change(run, horizon=30), "does not fit"),
    "horizon of 0": (lambda run: change(run, horizon=0), "horizon is 0, expected a positive"),
    "time step that is no number": (
        lambda run: change(run, dt_s=float("nan")),
        "dt_s is nan, expected a positive",
    ),
    "infinite horizon": (lambda run: change(run, horizon=float("inf")), "horizon is inf"),
    "temperature that is no number": (
        lambda run: change(run, temperature=float("nan")),
        "temperature is nan, expected a positive",
    ),
    "temperature of zero": (lambda run: change(run, temperature=0), "temperature is 0"),
    "negative temperature": (lambda run: change(run, temperature=-1.5), r"temperature is -1\.5"),
    "normaliser that is no number": (
        lambda run: change(run, normaliser={"action_range": [float("nan"), 0.5]}),
        "action_range is nan",
    ),
    "view that is a word": (lambda run: change(run, view="moon"), "does not describe"),
    "provenance that is a list": (lambda run: change(run, provenance=[]), "does not describe"),
    "other view of the same size": (
        lambda run: (
            change_training(run, view="chauffeurnet"),
            change(run, view=make_view("chauffeurnet-no-trail", pixels=(36, 24)).config()),
        ),
        "view is chauffeurnet-no-trail, but it was trained with chauffeurnet",
    ),
    "other horizon than trained": (
        lambda run: change_training(run, horizon_s=6.0),
        r"horizon_s is 3\.0, but it was trained with 6\.0",
    ),
    "weights of another network": (
        lambda run: save_file({"w": torch.zeros(2)}, run / "weights.safetensors"),
        "does not fit",
    ),
    "weights that are not finite": (poison, "not finite"),
    "another finite weight": (weaken, "weights.safetensors is damaged or of another run"),
    "fraction in the place of a number": (
        lambda run: change_network(run, features=8.0),
        "features is 8.0, expected a whole number",
    ),
    "horizon of a fraction": (lambda run: change(run, horizon=15.5), "horizon is 15.5"),
    "network of any size": (
        lambda run: change_network(run, gru_width=10**6),
        "a network of .* weights, expected at most",
    ),
    "network of any depth": (
        lambda run: change_network(run, gru_layers=10**6),
        "1,000,000 layers of a GRU, expected at most 100",
    ),
    "deep JSON": (lambda run: (run / "config.json").write_text("[" * 100_000), "nested too"),
    "very high temperature": (lambda run: change(run, temperature=1e308), "temperature is 1e"),
}


@pytest.mark.parametrize("fault", FAULTS, ids=list(FAULTS))
def test_faults_are_refused_in_one_line(fault: str, run: Path) -> None:
    damage, message = FAULTS[fault]
    damage(run)
    with pytest.raises(CheckpointError, match=message) as caught:
        load_predictor(f"ffw-asp:{run}", horizon=15, dt_s=0.2)
    assert "\n" not in str(caught.value)


def test_weights_of_earlier_versions_have_no_hash(run: Path) -> None:
    """They load; what damage makes of a forecast is refused where it is not finite."""
    drop(run, "weights_sha256")
    weaken(run)
    predictor = load_predictor(f"ffw-asp:{run}", horizon=15, dt_s=0.2)
    weights = load_file(run / "weights.safetensors")
    save_file({name: each * 1e30 for name, each in weights.items()}, run / "weights.safetensors")
    damaged = load_predictor(f"ffw-asp:{run}", horizon=15, dt_s=0.2)
    recordings = [make_recording()]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    scene = gather_scene(recordings, index.select(np.array([0])))
    assert np.isfinite(predictor.predict(scene).states).all()
    with pytest.raises(CheckpointError, match="a forecast is not finite"):
        damaged.predict(scene)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("lines", 6.4e7, r"lines is 64000000\.0, expected a whole number"),
        ("lines", 64_000_000, "give at most 1,000, 10,000 and 1,000"),
        ("agents", True, "agents is True, expected a whole number"),
        ("own_past", 1, "own_past is 1, expected true or false"),
    ],
)
def test_views_of_other_numbers_are_refused(
    field: str, value: Any, message: str, tmp_path: Path
) -> None:
    run = save_random(tmp_path / "run", "ffw-asp", "vectors")
    view = json.loads((run / "config.json").read_text())["view"]
    change(run, view={**view, field: value})
    with pytest.raises(CheckpointError, match=message):
        load_predictor(f"ffw-asp:{run}", horizon=15, dt_s=0.2)


def test_missing_run_is_refused() -> None:
    """The name `ffw-asp` needs a run."""
    with pytest.raises(CheckpointError, match="ffw-asp:RUN_DIR"):
        load_predictor("ffw-asp", horizon=15, dt_s=0.2)


def test_horizon_other_than_in_training_is_refused(tmp_path: Path) -> None:
    """The weights of ssp-asp fit any number of segments, so the training's horizon is checked."""
    run = save_random(tmp_path / "run", "ssp-asp", horizon=30)
    change(run, horizon=31)
    with pytest.raises(CheckpointError, match=r"chains segments of 3 s, the horizon of 6\.2 s"):
        load_predictor(f"ssp-asp:{run}", horizon=15, dt_s=0.2)
    change(run, horizon=45)
    change_training(run, horizon_s=6.0)
    with pytest.raises(CheckpointError, match=r"horizon_s is 9\.0, but it was trained with 6\.0"):
        load_predictor(f"ssp-asp:{run}", horizon=15, dt_s=0.2)


def test_chaining_follows_the_last_at(tmp_path: Path) -> None:
    """The default is beam; folders may have an @ in their names; unknown chainings are refused."""
    run = save_random(tmp_path / "runs@home" / "a", "ssp-asp", horizon=30)
    for name, chaining in ((f"{run}", "beam"), (f"{run}@top1", "top1"), (f"{run}@full", "full")):
        metadata = load_predictor(f"ssp-asp:{name}", horizon=15, dt_s=0.2).metadata
        assert metadata["chaining"] == chaining
    assert load_predictor(f"ssp-asp:{run}@oracle", horizon=15, dt_s=0.2).privileged
    with pytest.raises(AspEnvError, match=r"unknown chaining 'top' \(did you mean 'top1'"):
        load_predictor(f"ssp-asp:{run}@top", horizon=15, dt_s=0.2)
    with pytest.raises(CheckpointError, match="runs@work/a holds no trained predictor"):
        load_predictor(f"ssp-asp:{tmp_path}/runs@work/a", horizon=15, dt_s=0.2)
    with_at = save_random(tmp_path / "b@top1", "ssp-asp", horizon=30)
    assert load_predictor(f"ssp-asp:{with_at}", horizon=15, dt_s=0.2).metadata["chaining"] == "beam"


@pytest.mark.parametrize("predictor", ["ffw-asp", "ssp-asp"])
def test_chaining_of_a_single_segment_is_refused(predictor: str, tmp_path: Path) -> None:
    """ssp-asp, too, forecasts 3 s at once; the error states how to name the run."""
    run = save_random(tmp_path / "run", predictor)
    with pytest.raises(AspEnvError, match=f"nothing to chain: .* as {predictor}:{run}$"):
        load_predictor(f"{predictor}:{run}@top1", horizon=15, dt_s=0.2)


def test_configurations_without_newer_options_have_their_defaults(tmp_path: Path) -> None:
    """Segments of 3 s, read past actions and a view of 15 past ticks: the same forecasts."""
    run = save_random(tmp_path / "run", "ssp-asp", "vectors", horizon=30)
    config = json.loads((run / "config.json").read_text())
    before = load_trained(SSPASP, str(run)).predict(whole_scene())
    for name in ("segment_s", "decoder"):
        del config["network"][name]
    del config["view"]["history"]
    (run / "config.json").write_text(json.dumps(config))
    after = load_trained(SSPASP, str(run)).predict(whole_scene())
    np.testing.assert_array_equal(after.states, before.states)
    np.testing.assert_array_equal(after.log_probs, before.log_probs)


@pytest.mark.parametrize("history", [5, 20])
def test_other_histories_read_the_last_ticks(history: int, tmp_path: Path) -> None:
    """Of a scene with 25 past ticks; targets observed for fewer than `history` are not valid."""
    run = save_random(
        tmp_path / "run", "ssp-asp", "vectors", horizon=15, history=history, segment_s=1.0
    )
    predictor = load_trained(SSPASP, str(run))
    assert predictor.history == predictor.view.history == history
    scene = whole_scene(history_s=5.0)
    index = (scene.targets[:, 0], scene.targets[:, 1])
    scene.valid[index[0], index[1], : 25 - history] = False
    forecast = predictor.predict(scene)
    assert forecast.valid.all()
    scene.states[:, :, : 25 - history] = 7.0
    np.testing.assert_array_equal(predictor.predict(scene).states, forecast.states)
    scene.valid[index[0], index[1], 25 - history] = False
    assert not predictor.predict(scene).valid.any()


def whole_scene(history_s: float = 3.0) -> Scene:
    """Five situations of the synthetic crossing."""
    recordings = [make_recording()]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0, history_s=history_s)
    return gather_scene(recordings, index.select(np.linspace(0, len(index) - 1, 5).astype(int)))


def test_too_many_chains_are_refused(tmp_path: Path) -> None:
    """Six segments of three modes have 729 chains."""
    run = save_random(tmp_path / "run", "ssp-asp", "vectors", horizon=30, segment_s=1.0)
    assert load_trained(SSPASP, f"{run}@top1").metadata["chaining"] == "top1"
    with pytest.raises(AspEnvError, match="6 segments of 3 modes: @full would forecast more"):
        load_trained(SSPASP, f"{run}@full")


def test_other_time_step_is_refused(run: Path) -> None:
    with pytest.raises(AspEnvError, match=r"time step of 0\.2 s, the scenes have 0\.1 s"):
        load_predictor(f"ffw-asp:{run}", horizon=30, dt_s=0.1)


def test_trained_predictor_has_its_own_horizon(run: Path) -> None:
    """Loaded for 30 ticks, a predictor of 15 forecasts 15."""
    assert load_predictor(f"ffw-asp:{run}", horizon=30, dt_s=0.2).horizon == 15


def test_logits_are_divided_by_the_temperature(run: Path) -> None:
    """At a temperature of 2 the log-odds between modes are half as large."""
    recordings = [make_recording()]
    scene = gather_scene(recordings, index_snippets(recordings, dt_s=0.2, horizon_s=3.0))
    odds = []
    for temperature in (1.0, 2.0):
        change(run, temperature=temperature)
        log_probs = load_predictor(f"ffw-asp:{run}", horizon=15, dt_s=0.2).predict(scene).log_probs
        odds.append(log_probs[:, 1:] - log_probs[:, :1])
    assert np.abs(odds[0]).max() > 0.05
    np.testing.assert_allclose(odds[1], odds[0] / 2, atol=1e-5)


def test_network_is_stored_unchanged(run: Path) -> None:
    """The files hold the weights, bit for bit, the shape and the configuration."""
    network = make_network("ffw-asp", tiny_network("ffw-asp"), tiny_shape())
    stored = load_file(run / "weights.safetensors")
    assert stored.keys() == network.state_dict().keys()
    for name, value in network.state_dict().items():
        assert torch.equal(stored[name], value), name
    config = json.loads((run / "config.json").read_text())
    assert config["network"] == dataclasses.asdict(network.config)
    assert (config["history"], config["horizon"], config["dt_s"]) == (15, 15, 0.2)
    assert tuple(config["normaliser"]["action_range"]) == network.shape.action_range


def test_metadata(run: Path) -> None:
    """Source, view, recipe if it is known, and 16 digits of the weights' hash."""
    metadata = load_predictor(f"ffw-asp:{run}", horizon=15, dt_s=0.2).metadata
    content = (run / "weights.safetensors").read_bytes()
    assert dict(metadata) == {
        "trained_on": "nothing",
        "view": "chauffeurnet",
        "preset": "tiny",
        "weights": hashlib.sha256(content).hexdigest()[:16],
    }
    other = save_random(run.with_name("other"), seed=1)
    assert load_predictor(f"ffw-asp:{other}", horizon=15, dt_s=0.2).metadata != metadata
    known = json.loads((run / "config.json").read_text())["provenance"]["trained_on"]
    change(run, provenance={"trained_on": known})
    assert "preset" not in load_predictor(f"ffw-asp:{run}", horizon=15, dt_s=0.2).metadata


def test_state_of_a_run_is_stored_and_loaded(tmp_path: Path) -> None:
    """Nested tensors, tuples, integer keys, None and infinities are restored."""
    state = {
        "epoch": 3,
        "best": float("inf"),
        "optimizer": [{"state": {0: {"m": torch.arange(3.0), "step": torch.tensor(7.0)}}}],
        "betas": (0.9, 0.999),
        "none": None,
        "name": "a",
        "flag": True,
    }
    SafetensorsIO().save_checkpoint(state, tmp_path / "state")
    loaded = SafetensorsIO().load_checkpoint(tmp_path / "state")
    moments = loaded["optimizer"][0]["state"][0]
    assert torch.equal(moments["m"], torch.arange(3.0))
    assert float(moments["step"]) == 7.0
    assert loaded["betas"] == (0.9, 0.999)
    rest = ("epoch", "best", "none", "name", "flag")
    assert [loaded[key] for key in rest] == [state[key] for key in rest]


def test_state_with_an_object_is_refused(tmp_path: Path) -> None:
    """An object that would need a pickle raises when the state is written."""
    with pytest.raises(TypeError, match="Path, which is not stored"):
        SafetensorsIO().save_checkpoint({"where": Path()}, tmp_path / "state")


def test_damaged_state_is_refused(tmp_path: Path) -> None:
    SafetensorsIO().save_checkpoint({"a": torch.zeros(100)}, tmp_path / "state")
    (tmp_path / "state").write_bytes((tmp_path / "state").read_bytes()[:90])
    with pytest.raises(CheckpointError, match="start the run again"):
        SafetensorsIO().load_checkpoint(tmp_path / "state")


def test_loading_does_not_change_the_global_generator(run: Path) -> None:
    """Random numbers of torch do not depend on loading."""
    before = torch.random.get_rng_state()
    load_predictor(f"ffw-asp:{run}", horizon=15, dt_s=0.2)
    assert torch.equal(torch.random.get_rng_state(), before)

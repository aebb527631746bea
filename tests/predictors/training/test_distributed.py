"""Several processes, on one node or two, end with the weights of one process."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file
from torch import distributed

from asp_env.data.predictor import load_predictor
from asp_env.data.snippets import index_snippets
from asp_env.errors import AspEnvError
from asp_env.views import make_view
from predictors.models.network import TrainingProgress
from predictors.training.data import Batches
from predictors.training.fitting import train
from predictors.training.trainer import Hardware, make_trainer
from tests.builders import make_recording
from tests.predictors.tiny import (
    PIXELS,
    draw_samples,
    make_network,
    tiny_config,
    tiny_network,
    tiny_shape,
    write_data,
)

SECONDS = 300
"""Time after which processes that wait for each other are ended."""

TOLERANCE = 1e-6

pytestmark = pytest.mark.skipif(
    not (distributed.is_available() and distributed.is_gloo_available()), reason="no gloo"
)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Three recordings: one for training, one for validation, one for testing."""
    return write_data(tmp_path_factory.mktemp("data"))


def start(
    out: Path,
    *,
    predictor: str,
    view: str,
    data: str,
    hardware: dict[str, Any],
    changes: dict[str, Any],
    die_after: int | None = None,
    backend: str | None = None,
    **variables: str,
) -> subprocess.Popen[str]:
    """Starts a process of `tests.predictors.rank` with further environment variables."""
    arguments = {
        "predictor": predictor,
        "view": view,
        "data": data,
        "out": str(out),
        "changes": changes,
        "hardware": hardware,
        "die_after": die_after,
        "backend": backend,
    }
    return subprocess.Popen(
        [sys.executable, "-m", "tests.predictors.rank", json.dumps(arguments)],
        env={**os.environ, **variables},
        stderr=subprocess.PIPE,
        text=True,
    )


def end(process: subprocess.Popen[str]) -> str:
    """Waits for a process and returns its standard error."""
    try:
        return process.communicate(timeout=SECONDS)[1]
    finally:
        process.kill()


def weights_of(path: Path) -> dict[str, torch.Tensor]:
    """The tensors of a file, which must exist."""
    assert path.exists(), path
    return load_file(path)


def same_weights(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    """Whether all tensors are equal bit for bit."""
    assert first.keys() == second.keys()
    return all(torch.equal(tensor, second[name]) for name, tensor in first.items())


def test_two_interrupted_processes_end_with_the_weights_of_one(data: str, tmp_path: Path) -> None:
    """Without batch statistics and in float32, to 1e-6; in pre-training γ has no gradient.

    Batches of 7 are sharded as 4 and 3, the last one of 1 as 1 and 0.
    """
    changes = {
        "precision": "32-true",
        "batch_size": 7,
        "snippets_per_epoch": 22,
        "learning_rate": 1e-4,
        "pretraining_epochs": 1,
        "epochs": 2,
    }
    options: dict[str, Any] = {
        "predictor": "ssp-asp",
        "view": "vectors",
        "data": data,
        "hardware": {"devices": 2},
        "changes": changes,
    }
    out = tmp_path / "two" / "run"
    out.parent.mkdir()
    died = start(out, **options, die_after=1)
    end(died)
    assert died.returncode != 0
    assert not (out / "config.json").exists()
    resumed = start(out, **options)
    stderr = end(resumed)
    assert resumed.returncode == 0, stderr[-2000:]
    lines = stderr.splitlines()
    assert (
        sum(line.startswith("epoch") for line in lines) == 1
    )  # only the third epoch, by the first process
    ranks = [weights_of(out.with_name(f"rank-{rank}.safetensors")) for rank in range(2)]
    assert same_weights(*ranks)
    assert sorted(each.name for each in (out / "logs").iterdir()) == [
        "from-epoch-00",
        "from-epoch-02",
    ]

    one = train(tiny_config("ssp-asp", "vectors", **changes), data, tmp_path / "one")
    of_one, of_two = (weights_of(run / "weights.safetensors") for run in (one, out))
    for name, tensor in of_one.items():
        torch.testing.assert_close(of_two[name], tensor, atol=TOLERANCE, rtol=0, msg=name)
    provenances = [
        json.loads((run / "config.json").read_text())["provenance"] for run in (one, out)
    ]
    assert [each["processes"] for each in provenances] == [1, 2]
    assert provenances[1]["best_epoch"] == provenances[0]["best_epoch"]
    assert provenances[1]["best_value"] == pytest.approx(provenances[0]["best_value"], abs=1e-4)
    assert load_predictor(f"ssp-asp:{out}", horizon=15, dt_s=0.2).name == "ssp-asp"


def test_two_nodes_end_with_equal_weights(data: str, tmp_path: Path) -> None:
    """Equal bit for bit, with batch statistics and bfloat16."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    out = tmp_path / "run"
    nodes = [
        start(
            out,
            predictor="ffw-asp",
            view="chauffeurnet",
            data=data,
            hardware={"nodes": 2},
            changes={"epochs": 2},
            MASTER_ADDR="127.0.0.1",
            MASTER_PORT=port,
            NODE_RANK=str(rank),
        )
        for rank in range(2)
    ]
    stderrs = [end(node) for node in nodes]
    assert [node.returncode for node in nodes] == [0, 0], "".join(s[-1000:] for s in stderrs)
    ranks = [weights_of(tmp_path / f"rank-{rank}.safetensors") for rank in range(2)]
    assert same_weights(*ranks)
    assert [each.name for each in (out / "logs").iterdir()] == ["from-epoch-00"]
    assert load_predictor(f"ffw-asp:{out}", horizon=15, dt_s=0.2).name == "ffw-asp"


@given(
    count=st.integers(1, 40),
    batch_size=st.integers(1, 12),
    ranks=st.integers(1, 5),
    seed=st.integers(0, 9),
)
@settings(max_examples=50, deadline=None)
def test_shards_together_are_the_order_of_the_epoch(
    count: int, batch_size: int, ranks: int, seed: int
) -> None:
    """Every row occurs once, in the batch of a single process, and no shard is empty."""
    recordings = [make_recording()]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    batches = Batches(
        recordings, index, view=make_view("chauffeurnet", pixels=PIXELS), batch_size=batch_size
    ).reordered(np.random.default_rng(seed).integers(0, len(index), count))
    shards = [batches.shard(rank, ranks) for rank in range(ranks)]
    for number in range(len(batches)):
        rows = [each.shard_rows(number) for each in shards]
        own = [each.num_own(number) for each in shards]
        assert all(len(each) for each in rows)
        assert sum(own) == batches.num_snippets(number)
        joined = np.concatenate([each[:n] for each, n in zip(rows, own, strict=True)])
        first = number * batch_size
        np.testing.assert_array_equal(
            np.sort(joined), np.arange(first, min(first + batch_size, count))
        )


@pytest.mark.parametrize(
    ("hardware", "words"),
    [
        ({"devices": 0}, "devices is 0, expected 1 or more"),
        ({"nodes": 0}, "nodes is 0, expected 1 or more"),
        ({"nodes": 2}, "MASTER_ADDR, MASTER_PORT, NODE_RANK not set"),
        ({"devices": 9}, "batches of 8 cannot be shared by 9 processes"),
    ],
    ids=["no device", "no node", "nodes without a rendezvous", "too small a batch"],
)
def test_impossible_hardware_is_refused(
    hardware: dict[str, Any], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error is raised before any process starts or anything is written."""
    for name in ("MASTER_ADDR", "MASTER_PORT", "NODE_RANK"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(AspEnvError, match=words):
        make_trainer(
            tiny_config(), Hardware(**hardware), out=tmp_path / "run", started="now", callbacks=[]
        )
    assert not (tmp_path / "run").exists()


def test_launcher_of_another_number_of_processes_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of the three processes would otherwise train alone."""
    monkeypatch.setenv("LOCAL_RANK", "0")
    monkeypatch.setenv("WORLD_SIZE", "3")
    with pytest.raises(AspEnvError, match="started 3 processes for 1 devices of 1 nodes"):
        make_trainer(tiny_config(), Hardware(), out=tmp_path / "run", started="now", callbacks=[])


def test_compiled_encoder_has_the_same_names_and_weights(data: str, tmp_path: Path) -> None:
    """An interrupted run is resumed with compilation and ends with the weights of one without.

    The encoder is traced by the compiler and run as traced.
    """
    options: dict[str, Any] = {
        "predictor": "ffw-asp",
        "view": "chauffeurnet",
        "data": data,
        "changes": {"epochs": 2, "precision": "32-true"},
    }
    out = tmp_path / "run"
    died = start(out, **options, hardware={}, die_after=0)
    end(died)
    assert died.returncode != 0
    resumed = start(out, **options, hardware={"compiled": True}, backend="eager")
    stderr = end(resumed)
    assert resumed.returncode == 0, stderr[-2000:]
    plain = train(tiny_config("ffw-asp", **options["changes"]), data, tmp_path / "plain")
    resumed_weights, expected = (weights_of(run / "weights.safetensors") for run in (out, plain))
    assert resumed_weights.keys() == expected.keys()
    for name, tensor in expected.items():
        torch.testing.assert_close(resumed_weights[name], tensor, atol=1e-6, rtol=0, msg=name)
    assert json.loads((out / "config.json").read_text())["provenance"]["compiled"]
    assert load_predictor(f"ffw-asp:{out}", horizon=15, dt_s=0.2).name == "ffw-asp"


@pytest.mark.parametrize(
    ("predictor", "view"),
    [
        ("mtp", "chauffeurnet"),
        ("dkm", "chauffeurnet"),
        ("ffw-asp", "chauffeurnet"),
        ("ffw-asp", "vectors"),
        ("ssp-asp", "chauffeurnet"),
        ("ssp-asp", "vectors"),
    ],
)
def test_everything_after_the_encoder_is_float32(predictor: str, view: str) -> None:
    """Under bf16-mixed only the encoder computes in bfloat16, in training and in forecasts."""
    network = make_network(predictor, tiny_network(predictor, view), tiny_shape(view))
    batch, labels = draw_samples(
        (8, 30, 41, 55), view=view, later_ticks=network.later_ticks, recording=make_recording()
    )
    inside: set[torch.dtype] = set()
    outside: set[torch.dtype] = set()
    for name, module in network.named_modules():
        if not list(module.children()):
            dtypes = inside if name.startswith("encoder.") else outside
            module.register_forward_hook(lambda _, __, out, dtypes=dtypes: _add_dtype(dtypes, out))
    with torch.autocast("cpu", torch.bfloat16):
        terms = network.training_loss(batch, labels, TrainingProgress())
        modes = network(batch)
    assert torch.bfloat16 in inside
    assert outside == {torch.float32}
    assert modes.states.dtype == modes.logits.dtype == terms["loss"].dtype == torch.float32


def _add_dtype(dtypes: set[torch.dtype], out: Any) -> None:
    if isinstance(out, torch.Tensor):
        dtypes.add(out.dtype)


def test_compiling_without_a_compiler_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names the missing compiler."""
    monkeypatch.setenv("CXX", "no-such-compiler")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(AspEnvError, match="there is no no-such-compiler"):
        Hardware(compiled=True)

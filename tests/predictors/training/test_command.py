"""`asp-env train`: the runs of a recipe and of its variants."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from asp_env.errors import AspEnvError
from asp_env.evaluation.open_loop.evaluate import Evaluate, evaluate
from predictors.inference.checkpoint import load_trained
from predictors.plugs import SSPASP
from predictors.training.command import Train
from tests.predictors.tiny import write_data


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_data(tmp_path_factory.mktemp("data"))


def command(predictor: str, data: str, out: Path, variant: str | None = None) -> Train:
    """The command for 6 s, one epoch of one batch."""
    return Train(
        predictor=predictor, data=(data,), out=out, view="vectors", horizon=6.0, epochs=1,
        max_snippets=8, variant=variant,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("predictor", "variant", "first"),
    [("dkm", None, False), ("dkm", "staged", True), ("ssp-asp", None, True)],
)
def test_runs_for_6_s_start_from_3_s_if_the_recipe_says_so(
    predictor: str, variant: str | None, first: bool, data: str, tmp_path: Path
) -> None:
    """SSP-ASP trains a run for 3 s in its folder; DKM does so only in the variant `staged`."""
    out = tmp_path / "run"
    command(predictor, data, out, variant).run()
    assert (out / "config.json").exists()
    assert (out / "3s" / "config.json").exists() == first


@pytest.mark.parametrize("variant", [None, "unrolled"])
def test_segments_and_histories_of_other_lengths(
    variant: str | None, data: str, tmp_path: Path
) -> None:
    """Three segments of 1 s start from a run for 1 s; 2 s of history are 10 ticks."""
    out = tmp_path / "run"
    train = dataclasses.replace(
        command("ssp-asp", data, out, variant), horizon=3.0, segment_s=1.0, history_s=2.0
    )
    train.run()
    assert (out / "1s" / "config.json").exists()
    predictor = load_trained(SSPASP, str(out))
    assert (predictor.history, predictor.view.history, predictor.horizon) == (10, 10, 15)
    assert predictor.network.later_ticks == (5, 10, 15)


def test_a_chain_of_three_segments_is_evaluated(data: str, tmp_path: Path) -> None:
    """6 s from a run for 2 s, forecast and scored over the whole horizon."""
    out = tmp_path / "run"
    dataclasses.replace(command("ssp-asp", data, out), segment_s=2.0).run()
    assert (out / "2s" / "config.json").exists()
    name = f"ssp-asp:{out}"
    result = evaluate(
        Evaluate(
            data=data, predictors=(name,), horizon=6.0, part="all", planner="none", out=tmp_path
        )
    )
    errors = [row.value for row in result.rows if row.metric == "FDE"]
    assert errors
    assert np.isfinite(errors).all()


def test_run_at_once_refuses_a_folder_with_a_first_stage(data: str, tmp_path: Path) -> None:
    """The folder would look as if the run had started from that stage."""
    (tmp_path / "run" / "3s").mkdir(parents=True)
    with pytest.raises(AspEnvError, match="holds something that is no run"):
        command("dkm", data, tmp_path / "run").run()

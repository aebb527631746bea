"""`asp-env train`: the runs of a recipe and of its variants."""

from pathlib import Path

import pytest

from asp_env.errors import AspEnvError
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


def test_run_at_once_refuses_a_folder_with_a_first_stage(data: str, tmp_path: Path) -> None:
    """The folder would look as if the run had started from that stage."""
    (tmp_path / "run" / "3s").mkdir(parents=True)
    with pytest.raises(AspEnvError, match="holds something that is no run"):
        command("dkm", data, tmp_path / "run").run()

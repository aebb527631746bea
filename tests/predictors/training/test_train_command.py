"""`asp-env train`: which runs it makes."""

from pathlib import Path

import pytest

from asp_env.errors import AspEnvError
from predictors.training.command import Train
from tests.predictors.tiny import write_data


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Three recordings."""
    return write_data(tmp_path_factory.mktemp("data"))


def command(predictor: str, data: str, out: Path, variant: str | None = None) -> Train:
    """6 s, one epoch of a batch."""
    return Train(
        predictor=predictor, data=data, out=out, view="vectors", horizon=6.0, epochs=1,
        max_snippets=8, variant=variant,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("predictor", "variant", "first"),
    [("dkm", None, False), ("dkm", "staged", True), ("ssp-asp", None, True)],
)
def test_6_s_go_on_from_3_s_where_the_recipe_says_so(
    predictor: str, variant: str | None, first: bool, data: str, tmp_path: Path
) -> None:
    """SSP-ASP makes a run for 3 s in the folder of its run; DKM does only if it is asked to."""
    out = tmp_path / "run"
    command(predictor, data, out, variant).run()
    assert (out / "config.json").exists()
    assert (out / "3s" / "config.json").exists() == first


def test_a_run_at_once_refuses_a_folder_with_a_first_stage(data: str, tmp_path: Path) -> None:
    """It would look as if it had gone on from there."""
    (tmp_path / "run" / "3s").mkdir(parents=True)
    with pytest.raises(AspEnvError, match="holds something that is no run"):
        command("dkm", data, tmp_path / "run").run()

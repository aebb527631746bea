"""`asp-env datasets`: what it says agrees with the readers that exist."""

import pytest

from asp_env import registry
from asp_env.cli import main
from asp_env.installation.catalogue import DATASETS
from asp_env.installation.datasets import description

NAMES = {
    *("inD", "rounD", "uniD", "exiD", "INTERACTION", "SinD", "openDD", "Songdo", "Automatum"),
    *("DLR-UT", "TAF-BW"),
}


def test_the_catalogue_names_registered_readers() -> None:
    assert {each.name for each in DATASETS} == NAMES
    readers = {name for each in DATASETS if each.reader for name in each.reader.split(", ")}
    assert readers == set(registry.names("readers"))
    assert {each.name for each in DATASETS if each.reader is None} == {
        "openDD", "Automatum", "DLR-UT",
    }  # fmt: skip
    assert all((each.tested == "no reader") == (each.reader is None) for each in DATASETS)


def test_the_table_names_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["datasets"]) == 0
    output = capsys.readouterr().out
    assert all(f" {name} " in output for name in NAMES)


@pytest.mark.parametrize("dataset", DATASETS, ids=lambda each: each.name)
def test_a_description_ends_in_commands_that_exist(dataset) -> None:
    """Those of a data set without a reader say so instead."""
    lines = description(dataset)
    commands = [line.split("asp-env ", 1)[1].split()[0] for line in lines if "  asp-env " in line]
    assert set(commands) <= set(registry.names("commands"))
    assert bool(commands) == (dataset.reader is not None)
    assert any("none yet" in line for line in lines) == (dataset.reader is None)


def test_names_are_found_in_any_case(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["datasets", "ind"]) == 0
    assert "asp-env doctor data/inD" in capsys.readouterr().out
    assert main(["datasets", "inDD"]) == 2
    assert "unknown data set 'inDD' (did you mean 'inD'?)" in capsys.readouterr().err

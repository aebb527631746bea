"""A short campaign: every damaged input is used in full or refused in one line."""

import math
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.source import open_data
from asp_env.errors import DataError
from tests.campaigns import campaign
from tests.campaigns.campaign import Verdict, mutate, run_mutants
from tests.campaigns.formats import FORMATS, Format, NotFinite, make_geo_trax, make_levelx
from tests.campaigns.numbers import NUMBERS

MUTANTS = 300
"""Number of mutants of each format. Chosen so that all of them take less than 90 s of CPU time."""


@pytest.mark.parametrize("name", FORMATS)
def test_every_mutant_is_used_or_refused(name: str, tmp_path: Path) -> None:
    verdicts = list(run_mutants(FORMATS[name], range(MUTANTS), tmp_path))
    assert [verdict for verdict in verdicts if verdict.is_fault] == []
    assert len(verdicts) == MUTANTS


def test_the_same_number_gives_the_same_mutant(tmp_path: Path) -> None:
    """Files of two folders are equal after mutation 7, and differ after 8."""
    contents = []
    for number in (7, 7, 8):
        folder = tmp_path / str(len(contents))
        folder.mkdir()
        make_geo_trax(folder)
        mutate(np.random.default_rng(number), FORMATS["geo-trax"], folder)
        contents.append([path.read_bytes() for path in sorted(folder.iterdir())])
    assert contents[0] == contents[1] != contents[2]


def _fail(_: Path) -> None:
    raise KeyError("x")


def _not_finite(_: Path) -> None:
    raise NotFinite("reward")


def _two_lines(_: Path) -> None:
    raise DataError("a\nb")


def _allocate(_: Path) -> None:
    np.ones(3 << 30, dtype=np.uint8)


def _compute(_: Path) -> None:
    while True:
        math.sqrt(2.0)


def _wait(_: Path) -> None:
    time.sleep(60)


@pytest.mark.parametrize(
    ("use", "outcome"),
    [
        (_fail, "KeyError"),
        (_not_finite, "not finite"),
        (_two_lines, "not one line"),
        (_allocate, "memory"),
        (_compute, "over 0.2 s"),
        (_wait, "blocked"),
    ],
)
def test_faults_are_found(
    use: object, outcome: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The campaign finds a fault of each kind."""
    monkeypatch.setattr(campaign, "BLOCKED_S", 0.5 if use is _wait else 60.0)
    (tmp_path / "a.csv").write_text("a,b\n1,2\n")
    kind = Format(name="x", make=make_levelx, use=use, suffixes=(".csv",))  # pyright: ignore[reportArgumentType]
    verdict: Verdict = campaign.judge(kind, tmp_path, 0, "", limit_s=0.2)
    assert verdict.outcome == outcome
    assert verdict.is_fault


@given(
    cell=st.sampled_from(NUMBERS) | st.text(max_size=8) | st.floats().map(repr),
    row=st.integers(1, 120),
    column=st.integers(0, 16),
)
def test_any_cell_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, cell: str, row: int, column: int
) -> None:
    """One cell of the tracks holds any text; what is read of it is finite."""
    folder = tmp_path_factory.mktemp("cell")
    make_levelx(folder)
    path = folder / "data" / "00_tracks.csv"
    lines = [line.split(",") for line in path.read_text().splitlines()]
    lines[row % len(lines)][column] = cell
    path.write_text("\n".join(",".join(line) for line in lines), encoding="utf-8", errors="replace")
    message, states = "one line", np.zeros(0)
    try:
        states = open_data(folder)[0].states
    except DataError as error:
        message = str(error)
    assert len(message.splitlines()) == 1
    assert np.isfinite(states).all()

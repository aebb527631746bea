"""The short form of the crash campaign: some kills and full disks on tiny data."""

import resource
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from asp_env.cli import main
from tests.campaigns import crashes


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[crashes.Bench]:
    """A folder with data."""
    with crashes.bench_with_data(tmp_path_factory.mktemp("crashes")) as made:
        yield made


@pytest.mark.parametrize("name", ["read", "drive --jobs 2"])
def test_a_rerun_after_a_kill_writes_the_same(
    bench: crashes.Bench, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Byte for byte, with nothing left over, no process that goes on, and no lock.

    On a full disk reading works without the cache, and fills it once there is space.
    """
    outcome = crashes.run_case(bench, name, 1, np.random.default_rng(1))
    assert outcome.moments > 3
    assert outcome.killed + outcome.ended_before == 1
    if name == "read":
        monkeypatch.setattr(crashes, "SHARES", (0.4,))
        crashes.full_disks(bench, name, outcome)  # without root there is none
    assert outcome.faults == []


def test_a_file_that_is_too_large_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As on a full disk or over a quota: the line names the file, and nothing remains."""
    monkeypatch.chdir(tmp_path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        options = ("--site", "highway:intersection", "--recordings", "1", "--minutes", "0.05")
        assert main(["synthesize", "out", *options]) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    lines = capsys.readouterr().err.splitlines()
    errors = [line for line in lines if line.startswith("asp-env: ")]
    assert len(errors) == 1
    assert errors[0].startswith("asp-env: out")
    assert "cannot be written (File too large); free some space" in errors[0]
    assert list(tmp_path.iterdir()) == []

"""The short form of the crash campaign: some kills and full disks on tiny data."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

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


def test_a_file_that_is_too_large_is_one_line(tmp_path: Path) -> None:
    """As on a full disk or over a quota: the line names the file, and nothing remains."""
    code = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096)); "
        "from asp_env.cli import main; sys.exit(main())"
    )
    done = subprocess.run(
        [
            *(sys.executable, "-c", code, "synthesize", "out"),
            *("--site", "highway:intersection", "--recordings", "1", "--minutes", "0.05"),
        ],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    errors = [line for line in done.stderr.splitlines() if line.startswith("asp-env: ")]
    assert done.returncode == 2
    assert len(errors) == 1
    assert errors[0].startswith("asp-env: out")
    assert "cannot be written (File too large); free some space" in errors[0]
    assert list(tmp_path.iterdir()) == []

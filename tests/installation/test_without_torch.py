"""The core works where torch cannot be imported."""

import subprocess
import sys
from pathlib import Path

SMOKE = Path(__file__).parents[1] / "smoke.py"


def test_the_core_steps_and_drives_without_torch(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-P", str(SMOKE)], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "asp_env on Python 3." in done.stdout

"""The core without torch: a step of the environment, and one drive. A script, not a test.

`make smoke` runs it with other versions of Python. The folder `tests` must not be on the path of
modules (`python -P`), since its packages have names of the project's.
"""

import sys
import tempfile
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from pathlib import Path


class WithoutTorch(MetaPathFinder):
    """Makes torch unavailable, where it is installed."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: object = None) -> None:
        """Refuses torch.

        Raises:
            ModuleNotFoundError: the module is torch.
        """
        del path, target
        if fullname == "torch":
            raise ModuleNotFoundError("No module named 'torch'", name="torch")


def main() -> int:
    """Steps and drives; returns the exit status of the drive."""
    sys.meta_path.insert(0, WithoutTorch())
    import gymnasium as gym

    import asp_env
    from asp_env.cli import main as run

    env = gym.make("asp_env/Replay-v0", data="sample:intersection")
    env.reset(seed=0)
    _, reward, *_ = env.step(env.action_space.sample())
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "results"
        options = ["--planner", "idm", "--max-scenarios", "1", "--out", str(out)]
        status = run(["drive", "sample:intersection", *options])
        written = (out / "report.html").exists()
    sys.stdout.write(f"{asp_env.__name__} on Python {sys.version.split()[0]}: {reward:.3f}\n")
    return status if written else 1


if __name__ == "__main__":
    sys.exit(main())

"""A study on a Ray cluster of two nodes on this machine; skipped without Ray."""

import hashlib
import threading
import time
from pathlib import Path

import pytest

from asp_env.errors import AspEnvError, MissingExtraError
from asp_env.evaluation.study.ray_cluster import _written, drive_on_ray
from asp_env.evaluation.study.study import Study
from tests.crossing_files import ON_ROAD, write_crossing
from tests.evaluation.study.ray_nodes import two_nodes
from tests.sim.worlds import car


def bytes_of(folder: Path) -> dict[str, str]:
    """Hash of every file below a folder."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_two_nodes_and_lost_workers_give_the_bytes_of_one_process(
    tmp_path: Path,
) -> None:
    """With data from the file system and from the object store.

    Two workers are killed while they drive, after the first cell, and then a node.
    """
    pytest.importorskip("ray")
    drives = ((*ON_ROAD, car(-60, 8)), (ON_ROAD[1], car(-95, 8), car(-40, 7)))
    data = str(write_crossing(tmp_path / "data", drives=drives))
    config = tmp_path / "study.toml"
    config.write_text(
        f'data = ["{data}"]\nmethods = ["constant-turn-rate", "idm"]\ncontrols = false\n'
        'traffic = ["log", "idm"]\nlatency_ticks = [0, 1]\nmax_scenarios = 3\n'
    )
    Study(config=config, out=tmp_path / "alone").run()
    with two_nodes() as cluster:
        Study(config=config, out=tmp_path / "sent", ray=cluster.address, ray_send_data=True).run()
        ended = threading.Event()
        killed: list[str] = []

        def kill() -> None:
            while not ended.is_set() and not list((tmp_path / "killed").rglob("*.npz")):
                time.sleep(0.01)
            while not ended.is_set() and len(killed) < 2:
                if cluster.kill_worker():
                    killed.append("worker")
                time.sleep(0.01)
            cluster.kill_second_node()

        killer = threading.Thread(target=kill)
        killer.start()
        try:
            Study(config=config, out=tmp_path / "killed", ray=cluster.address).run()
        finally:
            ended.set()
            killer.join()
    assert killed == ["worker"] * 2
    expected = bytes_of(tmp_path / "alone")
    assert bytes_of(tmp_path / "sent") == expected
    assert bytes_of(tmp_path / "killed") == expected


def test_files_that_are_sent_are_written_once(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path))
    files = {"a/x.csv": b"1", "y.csv": b"2"}
    folder = Path(_written("/elsewhere/inD", files))
    assert folder.name == "inD"
    assert {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*.csv")} == files
    assert _written("/elsewhere/inD", files) == str(folder)
    assert _written("/elsewhere/inD", {"y.csv": b"3"}) != str(folder)


def test_without_a_cluster_or_without_ray_one_line_says_so() -> None:
    try:
        import ray  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        with pytest.raises(MissingExtraError, match=r"pip install 'asp-env\[ray\]'"):
            next(drive_on_ray([], 0.2, [], "auto"))
        return
    for address in ("auto", "127.0.0.1:9"):
        with pytest.raises(AspEnvError, match=rf"--ray {address}: no cluster .*`ray start --head`"):
            next(drive_on_ray([], 0.2, [], address))

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
from tests.sim.worlds import car


def bytes_of(folder: Path) -> dict[str, str]:
    """Hash of every file below a folder."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_two_nodes_and_lost_workers_give_the_bytes_of_one_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With data from the file system and from the object store; one node is killed on the way."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

    monkeypatch.setenv("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    drives = ((*ON_ROAD, car(-60, 8)), (ON_ROAD[1], car(-95, 8), car(-40, 7)))
    data = str(write_crossing(tmp_path / "data", drives=drives))
    config = tmp_path / "study.toml"
    config.write_text(
        f'data = ["{data}"]\nmethods = ["constant-turn-rate", "idm"]\ncontrols = false\n'
        'traffic = ["log", "idm"]\nlatency_ticks = [0, 1]\nmax_scenarios = 3\n'
    )
    Study(config=config, out=tmp_path / "alone").run()
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "node_ip_address": "127.0.0.1"}
    )
    try:
        second = cluster.add_node(num_cpus=1, node_ip_address="127.0.0.1")
        address = cluster.address
        Study(config=config, out=tmp_path / "ray", ray=address, ray_send_data=True).run()
        ended = threading.Event()

        def kill() -> None:
            while not list((tmp_path / "killed").rglob("*.npz")) and not ended.is_set():
                time.sleep(0.01)
            cluster.remove_node(second, allow_graceful=False)

        killer = threading.Thread(target=kill)
        killer.start()
        Study(config=config, out=tmp_path / "killed", ray=address).run()
        ended.set()
        killer.join()
    finally:
        cluster.shutdown()
    expected = bytes_of(tmp_path / "alone")
    assert bytes_of(tmp_path / "ray") == expected
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
    with pytest.raises(AspEnvError, match=r"--ray auto: no cluster .*`ray start --head`"):
        next(drive_on_ray([], 0.2, [], "auto"))

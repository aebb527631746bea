"""Several processes fill the cache at the same time: all read the same, and one copy remains."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from asp_env.data import cache
from asp_env.data.causal import causal_histories
from asp_env.data.source import open_data
from asp_env.files import is_temporary, remove_abandoned
from tests.data import interaction_files, levelx_files

READER = """
import hashlib, json, sys
from asp_env.data.causal import causal_histories
from asp_env.data.source import open_data

print("ready", flush=True)
sys.stdin.readline()
recordings = open_data(sys.argv[1])
digests = {}
for recording, causal in zip(recordings, causal_histories(recordings), strict=True):
    digest = hashlib.sha256(recording.states.tobytes())
    digest.update(recording.road_map.lanes.points.tobytes())
    digest.update(causal.states.tobytes())
    digests[recording.name] = digest.hexdigest()
print(json.dumps([digests, recordings.data_hash()]))
"""

WRITER = """
import sys
from pathlib import Path
import numpy as np
from asp_env.data import cache

array = np.ones(1 << 22)
print("ready", flush=True)
while True:
    cache.save(Path(sys.argv[1]), [["format", 1, 0]], {}, {"states": array})
"""


def start(code: str, *arguments: Path) -> subprocess.Popen[str]:
    """Starts a process and waits until it has imported everything."""
    command = [sys.executable, "-W", "error", "-c", code, *map(str, arguments)]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def test_three_processes_read_alike(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They start at the same time; both layouts are read, and each file is cached once."""
    cache_folder = tmp_path / "cache"
    monkeypatch.setenv("ASP_ENV_CACHE", str(cache_folder))
    folder = tmp_path / "data"
    levelx_files.write_folder(folder / "inD", recordings=2)
    interaction_files.write_folder(folder / "INTERACTION", recordings=2)
    readers = [start(READER, folder) for _ in range(3)]
    assert not cache_folder.exists()
    for reader in readers:
        assert reader.stdin is not None
        reader.stdin.write("go\n")
        reader.stdin.flush()
    ends = [reader.communicate(timeout=300) for reader in readers]
    assert [(reader.returncode, err) for reader, (_, err) in zip(readers, ends, strict=True)] == [
        (0, "")
    ] * 3
    results = [json.loads(out) for out, _ in ends]
    assert all(each == results[0] for each in results)

    entries = sorted(cache_folder.iterdir())
    # tracks, hash, causal states, place and its check of each recording; two maps and surveys;
    # hashes of the two recordings whose tables have equal sizes
    assert len(entries) == 4 * 5 + 2 * 2 + 2
    assert not [path for path in entries if path.name.startswith(".") or path.suffix != ".bin"]
    before = [(path.stat().st_ino, path.stat().st_mtime_ns) for path in entries]
    recordings = open_data(folder)
    assert recordings.data_hash() == results[0][1]
    assert len(list(causal_histories(recordings))) == 4
    assert [(path.stat().st_ino, path.stat().st_mtime_ns) for path in entries] == before

    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "another"))
    for recording, alone in zip(recordings, open_data(folder), strict=True):
        assert np.array_equal(recording.states, alone.states)


def test_a_killed_writer_leaves_a_complete_file_or_none(tmp_path: Path) -> None:
    """Its temporary files are removed by a later writer."""
    path = tmp_path / "a.bin"
    stamp = [["format", 1, 0]]
    for _ in range(3):
        writer = start(WRITER, path)
        while not any(map(is_temporary, tmp_path.iterdir())):
            assert writer.poll() is None
        writer.send_signal(signal.SIGKILL)
        writer.communicate()
        found = cache.load(path, stamp)
        assert found is None or (found[1]["states"] == 1).all()
    remove_abandoned(tmp_path)
    cache.save(path, stamp, {}, {"states": np.zeros(3)})
    assert [each.name for each in tmp_path.iterdir()] == ["a.bin"]

"""`asp-env doctor`: exit status 0, 1 or 2, one line for each problem."""

import importlib.util
import json
import os
import re
import sys
import time
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from asp_env import registry
from asp_env.cli import main
from asp_env.data.source import source_folder
from asp_env.installation import caches, packages
from tests.data.levelx_files import write_folder
from tests.real_data import real_data


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))


@pytest.fixture(autouse=True)
def _without_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spares its import, and shows that the doctor does not need it."""
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "torch" else find(name)
    )


def diagnosis(capsys: pytest.CaptureFixture[str], *folders: object) -> tuple[int, dict[str, Any]]:
    """The exit status and the JSON of the doctor."""
    status = main(["doctor", *map(str, folders), "--json"])
    return status, json.loads(capsys.readouterr().out)


def test_every_extra_has_a_purpose() -> None:
    """Those of the metadata, without those that only collect others."""
    extras = set(metadata.metadata("asp-env").get_all("Provides-Extra") or [])
    assert set(packages.EXTRAS) == extras - {"all", "dev"}
    by_name = {extra.name: extra for extra in packages.extra_states()}
    names = {package.name for package in by_name["train"].packages}
    assert names == {"lightning", "tensorboard", "safetensors", "torch"}
    (mkdocs,) = [each for each in by_name["docs"].packages if each.name == "mkdocs"]
    assert mkdocs.least == "1.6"  # of "<2,>=1.6"


def test_an_installation_that_fits(capsys: pytest.CaptureFixture[str]) -> None:
    """The sample is found by the reader of its layout, with both of its counts."""
    status, found = diagnosis(capsys, source_folder("sample:intersection"))
    assert (status, found["problems"]) == (0, [])
    (reader,) = found["data"][0]["readers"]
    assert reader["reader"] == "levelx"
    assert reader["num_found"] == reader["num_readable"] > 0
    assert reader["num_tracks"] > 10
    assert found["gpu"] == "torch is not installed"
    assert found["cache"]["named_by"] == "$ASP_ENV_CACHE"
    assert found["cache"]["num_files"] > 0
    assert abs(found["cache"]["clock_ahead_s"]) < caches.CLOCK_TOLERANCE_S


def test_text_of_an_installation_that_fits(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("asp-env 0.")
    assert lines[-1] == "fit for use"


def test_bad_recordings_are_problems(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One line names the recording; the good one is read. A folder without any says what to do."""
    folder, empty = tmp_path / "data", tmp_path / "empty"
    write_folder(folder)
    first = sorted(folder.rglob("*_tracks.csv"))[0]
    text = first.read_text()
    for path in sorted(folder.rglob("*")):  # a second recording, whose tracks are cut
        if path.name.startswith(first.name[:2]) and path.suffix == ".csv":
            (path.parent / f"77{path.name[2:]}").write_text(path.read_text())
    (first.parent / f"77{first.name[2:]}").write_text(text[: len(text) // 2])
    empty.mkdir()
    (empty / "inD.zip").write_text("")
    status, found = diagnosis(capsys, folder, empty)
    assert status == 1
    good, nothing = found["data"]
    (reader,) = good["readers"]
    assert (reader["num_found"], reader["num_readable"]) == (2, 1)
    assert re.match(r"recording 77: .*77_tracks.csv", found["problems"][0])
    assert "no reader finds recordings in it; unpack inD.zip first" in nothing["problems"][0]
    assert all("\n" not in problem for problem in found["problems"])


def test_a_missing_folder_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", str(tmp_path / "nowhere")]) == 2
    assert f"{tmp_path / 'nowhere'} does not exist" in capsys.readouterr().err
    assert main(["doctor", ""]) == 2
    assert "FOLDER '': expected a folder with recordings" in capsys.readouterr().err


def test_a_cache_that_cannot_be_made_is_a_problem(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file is in its place."""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "file" / "cache"))
    status, found = diagnosis(capsys)
    assert status == 1
    (problem,) = found["problems"]
    assert "set ASP_ENV_CACHE to a folder that can be written to" in problem


@pytest.mark.skipif(os.geteuid() == 0, reason="everything is permitted")
def test_a_cache_that_must_not_be_read_is_a_problem(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as the home folder of another user in a container."""
    home = tmp_path / "home"
    (home / "cache").mkdir(parents=True)
    home.chmod(0)
    monkeypatch.setenv("ASP_ENV_CACHE", str(home / "cache"))
    try:
        status, found = diagnosis(capsys)
    finally:
        home.chmod(0o700)
    assert status == 1
    assert "set ASP_ENV_CACHE to a folder that can be written to" in found["problems"][0]


def test_a_wrong_clock_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The file system is an hour ahead of a clock that is an hour late."""
    assert caches.cache_state().problem is None
    now_s = time.time()
    monkeypatch.setattr(caches.time, "time", lambda: now_s - 3_600.0)
    problem = caches.cache_state().problem
    assert problem is not None
    assert "differs by +3600 s" in problem


def test_old_and_missing_packages(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An old required package is a problem, a missing one of an extra is none."""
    version = metadata.version

    def changed(name: str) -> str:
        if name == "plotly":
            raise metadata.PackageNotFoundError
        return "1.9.5" if name == "numpy" else version(name)

    monkeypatch.setattr(metadata, "version", changed)
    status, found = diagnosis(capsys)
    assert status == 1
    assert found["problems"] == ["numpy 1.9.5 (needs 2.0): pip install --upgrade asp-env"]
    assert main(["doctor"]) == 1
    output = " ".join(capsys.readouterr().out.split())
    assert "plotly missing: pip install 'asp-env[report]'" in output


def test_a_torch_that_cannot_be_imported_is_a_problem(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "torch.py").write_text("raise OSError('libcudart.so.12: cannot open')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: object())
    status, found = diagnosis(capsys)
    assert status == 1
    assert found["problems"] == [
        "torch cannot be imported (OSError: libcudart.so.12: cannot open): reinstall torch"
    ]


def test_readers_that_fail_are_problems(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_folder: Path) -> list[Any]:
        raise RuntimeError("no licence")

    find = registry.find
    monkeypatch.setattr(registry, "find", lambda g, n: broken if n == "sind" else find(g, n))
    status, found = diagnosis(capsys, source_folder("sample:roundabout"))
    assert status == 1
    assert found["problems"] == ["reader 'sind' is left out: RuntimeError: no licence"]


@pytest.mark.data
def test_real_recordings_are_found_by_their_readers(capsys: pytest.CaptureFixture[str]) -> None:
    """144 vehicles of geo-trax's sample, of which one is too short; three recordings of TAF-BW."""
    status, found = diagnosis(capsys, real_data("geo_trax"), real_data("taf_bw"))
    assert status == 0
    counts = [
        (reader["reader"], reader["num_readable"], reader["num_found"])
        for folder in found["data"]
        for reader in folder["readers"]
    ]
    assert counts == [("geo-trax", 1, 1), ("interaction", 3, 3)]
    assert found["data"][0]["readers"][0]["num_tracks"] == 143

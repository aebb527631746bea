"""Output folders: complete or not there at all; columns and manifest."""

import csv
import json
import os
from pathlib import Path

import pytest

from asp_env.errors import AspEnvError
from asp_env.evaluation.results import Row, output_folder, write_manifest, write_metrics

COLUMNS = (
    "data,predictor,trained_on,view,recipe,chaining,planner,traffic,latency_ticks,horizon_s,"
    "selection,subset,metric,value,low,high,n,rules"
)


def _everything(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def _write(out: Path, *, error: type[BaseException] | None = None) -> None:
    with output_folder(out) as folder:
        (folder / "file").write_text("words")
        if error is not None:
            raise error


def test_a_folder_appears_when_all_has_gone_well(tmp_path):
    """Nothing under its name while it is written; afterwards just what was written."""
    out = tmp_path / "deep" / "down" / "out"
    with output_folder(out) as folder:
        (folder / "file").write_text("words")
        assert not out.parent.exists()
    assert _everything(tmp_path) == ["deep", "deep/down", "deep/down/out", "deep/down/out/file"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_exception_leaves_nothing_behind(tmp_path, error):
    """Neither the folder, nor a part of it, nor the folders above it."""
    with pytest.raises(error):
        _write(tmp_path / "deep" / "out", error=error)
    assert _everything(tmp_path) == []


def test_an_empty_folder_is_filled_and_kept_on_failure(tmp_path):
    """An empty folder may be there before; after an exception it is there, still empty."""
    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises(RuntimeError):
        _write(out, error=RuntimeError)
    assert _everything(tmp_path) == ["out"]
    _write(out)
    assert _everything(tmp_path) == ["out", "out/file"]


def test_what_exists_is_not_written_over(tmp_path):
    """A folder with something in it, and a file: refused in one line, untouched."""
    full, file = tmp_path / "full", tmp_path / "file"
    full.mkdir()
    (full / "precious").write_text("words")
    file.write_text("words")
    for out in (full, file):
        with pytest.raises(AspEnvError, match="exists already; choose another --out"):
            _write(out)
    assert (full / "precious").read_text() == "words"
    assert file.read_text() == "words"


def test_what_cannot_be_written_is_refused(tmp_path):
    """Below a file, and where the system lets nobody write."""
    file = tmp_path / "file"
    file.write_text("words")
    for out in (file / "below", Path("/proc/asp-env-out")):
        with pytest.raises(AspEnvError, match="cannot be written") as caught:
            _write(out)
        assert "\n" not in str(caught.value)


def test_a_relative_folder_is_written_where_one_is(tmp_path, monkeypatch):
    """A name without a folder lands in the working directory."""
    monkeypatch.chdir(tmp_path)
    _write(Path("out"))
    assert _everything(tmp_path) == ["out", "out/file"]
    assert os.listdir(tmp_path) == ["out"]


def test_columns_of_the_metrics(tmp_path):
    """The exact header; empty cells where a column does not apply; six digits."""
    rows = [
        Row(data="x,y", predictor="oracle", metric="FDE", value=1 / 3, n=7, horizon_s=3.0),
        Row(
            data="d",
            planner="idm",
            traffic="log",
            latency_ticks=0,
            subset="left",
            metric="score",
            value=0.5,
            low=0.25,
            high=0.75,
            n=2,
            rules="nuplan 1",
        ),
    ]
    write_metrics(tmp_path, rows)
    lines = (tmp_path / "metrics.csv").read_text().splitlines()
    assert lines == [
        COLUMNS,
        '"x,y",oracle,,,,,,,,3,,all,FDE,0.333333,,,7,',
        "d,,,,,,idm,log,0,,,left,score,0.5,0.25,0.75,2,nuplan 1",
    ]
    with (tmp_path / "metrics.csv").open(newline="") as file:
        assert [row["n"] for row in csv.DictReader(file)] == ["7", "2"]


def test_a_manifest_repeats_byte_for_byte(tmp_path):
    """It contains command, configuration and versions, but no time and no machine."""
    texts = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_manifest(tmp_path / name, "drive", data="d", seeds=[0, 1])
        texts.append((tmp_path / name / "manifest.json").read_text())
    assert texts[0] == texts[1]
    manifest = json.loads(texts[0])
    assert (manifest["command"], manifest["data"], manifest["seeds"]) == ("drive", "d", [0, 1])
    assert {"python", "numpy", "gymnasium", "asp-env"} <= set(manifest["versions"])

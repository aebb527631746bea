"""The command, the source and the samples: determinism and faults."""

import hashlib
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from asp_env import registry
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError, MissingExtraError
from scenarios.sumo import dataset, open_source, synthesize
from scenarios.synthesize import Synthesize

SAMPLES = Path(__file__).parents[2] / "asp_env" / "samples"


def contents(folder: Path) -> dict[str, str]:
    """A hash of every file below a folder, by relative path."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_same_seed_same_bytes_in_another_process(short: Path, tmp_path: Path) -> None:
    """Another process writes the same files, byte for byte."""
    script = (
        "from pathlib import Path; from scenarios.sumo import synthesize; "
        f"synthesize(Path({str(tmp_path / 'again')!r}), site='intersection', recordings=1, "
        "minutes=0.1, seed=7)"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=Path(__file__).parents[2])
    assert contents(tmp_path / "again") == contents(short)
    assert len(contents(short)) == 5


def test_another_seed_gives_another_location(short: Path, tmp_path: Path) -> None:
    """Map, image and tracks of seed 8 differ from those of seed 7."""
    synthesize(tmp_path / "b", site="intersection", recordings=1, minutes=0.1, seed=8)
    own, reference = contents(tmp_path / "b"), contents(short)
    assert own.keys() == reference.keys()
    assert not set(own.values()) & set(reference.values())


def test_true_tracks_do_not_depend_on_noise(short: Path, tmp_path: Path) -> None:
    """`truth/` has the tracks without noise; measured tracks differ by centimetres."""
    Synthesize(
        out=tmp_path / "n", site="intersection", recordings=1, minutes=0.1, seed=7, noise=True
    ).run()
    truth = tmp_path / "n" / "truth" / "00_trueTracks.csv"
    assert truth.read_bytes() == (short / "data" / "00_tracks.csv").read_bytes()
    true, measured = pd.read_csv(truth), pd.read_csv(tmp_path / "n" / "data" / "00_tracks.csv")
    error = np.hypot(measured.xCenter - true.xCenter, measured.yCenter - true.yCenter)
    assert 0.005 < error.mean() < 0.1
    assert error.max() < 0.5
    assert len(open_data(tmp_path / "n")) == 1


def test_recordings_share_locations(tmp_path: Path) -> None:
    """Three recordings share one location, which has one map and one image."""
    synthesize(tmp_path / "c", site="roundabout", recordings=3, minutes=0.05, seed=0)
    files = contents(tmp_path / "c")
    assert len([name for name in files if name.endswith(".osm")]) == 1
    assert len({files[name] for name in files if name.endswith(".png")}) == 1
    assert len({files[name] for name in files if name.endswith("_tracks.csv")}) == 3
    assert {recording.location for recording in open_data(tmp_path / "c")} == {"0"}


def test_an_unknown_site_lists_those_known(tmp_path: Path) -> None:
    """One line that lists the known sites; nothing is written."""
    with pytest.raises(AspEnvError, match="'motorway': known are intersection, roundabout"):
        Synthesize(out=tmp_path / "x", site="motorway").run()
    with pytest.raises(AspEnvError, match="known are intersection, roundabout"):
        open_source("motorway")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_not_empty_is_refused(tmp_path: Path) -> None:
    """The existing content is unchanged."""
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(AspEnvError, match="not an empty folder"):
        synthesize(tmp_path, site="intersection", recordings=1, minutes=0.05, seed=0)
    with pytest.raises(AspEnvError, match="not an empty folder"):
        synthesize(tmp_path / "mine.txt", site="intersection", recordings=1, minutes=1.0, seed=0)
    assert contents(tmp_path).keys() == {"mine.txt"}


def test_an_unwritable_folder_is_refused(tmp_path: Path) -> None:
    """A file has the path of the folder: the error has one line."""
    (tmp_path / "file").touch()
    with pytest.raises(AspEnvError, match="cannot be written") as caught:
        synthesize(tmp_path / "file" / "out", site="roundabout", recordings=1, minutes=1.0, seed=0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("recordings", "minutes", "seed", "locations", "message"),
    [
        (0, 1.0, 0, None, "--recordings 0: expected 1 to 10,000"),
        (10**20, 1.0, 0, None, f"--recordings {10**20}: expected 1 to 10,000"),
        (1, 0.0, 0, None, "--minutes 0: expected at least a second, 0.0167, and less than 1440"),
        (1, 1e300, 0, None, "--minutes 1e+300: expected at least a second"),
        (1, float("nan"), 0, None, "--minutes nan: expected at least a second"),
        (1, 1.0, -1, None, "--seed -1: expected at least 0"),
        (2, 1.0, 0, 3, "--locations 3: expected 1 to 2, the number of recordings"),
        (2, 1.0, 0, -1, "--locations -1: expected 1 to 2"),
    ],
)
def test_impossible_numbers_are_refused(
    tmp_path: Path,
    recordings: int,
    minutes: float,
    seed: int,
    locations: int | None,
    message: str,
) -> None:
    """The message names the option that is wrong, and no other."""
    with pytest.raises(AspEnvError, match=re.escape(message)):
        synthesize(
            tmp_path / "x",
            site="intersection",
            recordings=recordings,
            minutes=minutes,
            seed=seed,
            locations=locations,
        )
    assert not list(tmp_path.iterdir())


def test_no_incomplete_folder_remains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without SUMO the error names the extra, and no folder is left."""
    monkeypatch.setitem(sys.modules, "sumo", None)
    with pytest.raises(MissingExtraError, match=r"asp-env\[synthetic\]"):
        synthesize(tmp_path / "x", site="intersection", recordings=1, minutes=1.0, seed=0)
    assert not list(tmp_path.iterdir())


def stand_in(marker: str) -> Callable[..., None]:
    """Writes one file instead of traffic."""

    def write(out: Path, **_: object) -> None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "marker").write_text(marker)

    return write


def test_the_source_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second call finds what the first one made; nothing else remains in the cache."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path))
    monkeypatch.setattr(dataset, "synthesize", stand_in("first"))
    folder = open_source("roundabout")
    monkeypatch.setattr(dataset, "synthesize", stand_in("second"))
    assert open_source("roundabout") == folder
    assert (folder / "marker").read_text() == "first"
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]


def test_the_slower_of_two_processes_uses_the_folder_of_the_faster(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the folder appears meanwhile, it stays and is used."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path))

    def overtaken(out: Path, **_: object) -> None:
        stand_in("slower")(out)
        stand_in("faster")(tmp_path / "synthetic" / f"intersection-{dataset.SOURCE_VERSION}")

    monkeypatch.setattr(dataset, "synthesize", overtaken)
    folder = open_source("intersection")
    assert (folder / "marker").read_text() == "faster"
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]


def test_the_command_and_the_source_are_registered() -> None:
    """`asp-env synthesize` and DATA `synthetic:` call this package."""
    assert registry.find("commands", "synthesize") is Synthesize
    assert registry.find("sources", "synthetic") is open_source


@pytest.mark.parametrize("name", ["intersection", "roundabout"])
def test_samples_ship(name: str) -> None:
    """Two minutes of all classes, read without a repair; both together take under 4 MB."""
    (recording,) = open_data(f"sample:{name}")
    assert recording.num_frames == 3000
    assert len(np.unique(recording.classes)) == 7
    assert recording.parked.any()
    assert recording.repairs == recording.road_map.repairs == ()
    assert sum(path.stat().st_size for path in SAMPLES.rglob("*") if path.is_file()) < 4_000_000

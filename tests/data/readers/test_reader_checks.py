"""What readers of other packages return: it is used, or an error names the reader."""

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from asp_env import registry
from asp_env.data.readers.found import FoundRecording, RecordingTables, SignalChanges
from asp_env.data.readers.measurements import Measurements
from asp_env.data.readers.reader_checks import check_properties, checked_measurements
from asp_env.data.source import open_data
from asp_env.errors import DataError

ROWS = 60


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty cache."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))


def columns(speed_mps: float = 8.0) -> dict[str, Any]:
    """A car on a straight line at 10 Hz."""
    frames = np.arange(ROWS)
    return {
        "track": np.zeros(ROWS, dtype=np.int64),
        "time_ms": 100.0 * frames,
        "classes": np.zeros(ROWS, dtype=np.int8),
        "positions": np.stack([0.1 * speed_mps * frames, np.zeros(ROWS)], axis=-1),
        "heading": np.full(ROWS, np.nan),
        "sizes": np.tile([4.5, 1.8], (ROWS, 1)),
        "speed": None,
    }


def unchecked(**given: Any) -> Measurements:
    """Measurements as a package without checks of types makes them."""
    made = object.__new__(Measurements)
    for name, values in (columns() | given).items():
        object.__setattr__(made, name, values)
    return made


def test_other_types_of_numbers_are_converted() -> None:
    """Lists, single precision and whole numbers; unknown sizes are 0."""
    given = unchecked(
        track=[7] * ROWS,
        time_ms=list(range(0, 100 * ROWS, 100)),
        positions=np.zeros((ROWS, 2), dtype=np.float32),
        sizes=np.full((ROWS, 2), np.nan),
    )
    found = checked_measurements(given)
    assert (found.track.dtype, found.time_ms.dtype) == (np.int64, np.float64)
    assert found.positions.dtype == np.float64
    assert (found.sizes == 0).all()


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"track": np.array(["a"] * ROWS)}, "track: <U1, expected whole numbers"),
        ({"track": np.zeros((ROWS, 1), dtype=int)}, r"track: shape \(60, 1\), expected \(rows,\)"),
        ({"time_ms": np.arange(10.0)}, r"time_ms: shape \(10,\), expected \(60,\)"),
        ({"time_ms": np.full(ROWS, np.inf)}, "time_ms: inf, expected milliseconds"),
        ({"classes": np.full(ROWS, 99)}, "classes: 99 to 99, expected classes"),
        ({"positions": np.full((ROWS, 2), np.nan)}, "positions: 120 values are NaN"),
        ({"positions": np.zeros((ROWS, 3))}, r"positions: shape \(60, 3\), expected \(60, 2\)"),
        ({"heading": np.full(ROWS, 1e4)}, "heading: 10000, expected radians"),
        ({"speed": np.zeros(3)}, r"speed: shape \(3,\), expected \(60,\)"),
    ],
)
def test_columns_that_do_not_fit(given: dict[str, Any], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        checked_measurements(unchecked(**given))


def test_other_objects_are_no_measurements() -> None:
    with pytest.raises(ValueError, match="measurements: NoneType, expected Measurements"):
        checked_measurements(None)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"location": 5}, "location: 5, expected a text"),
        ({"weekday": 5}, "weekday: 5, expected a text"),
        ({"start_hour": "8:30"}, "start_hour: '8:30', expected hours"),
        ({"start_hour": float("nan")}, "start_hour: nan, expected hours"),
        ({"speed_limit_mps": 50.0}, "speed_limit_mps: 50.0, expected at most 45 m/s"),
        ({"speed_limit_mps": 0.0}, "speed_limit_mps: 0.0, expected at most 45 m/s"),
        ({"road_map": "map.osm"}, "road_map: str, expected a map"),
        ({"repairs": "one line"}, "repairs: expected a tuple of texts"),
    ],
)
def test_properties_that_do_not_fit(given: dict[str, Any], expected: str) -> None:
    names = ("weekday", "start_hour", "speed_limit_mps", "road_map")
    tables = SimpleNamespace(**({"location": "x", "repairs": ()} | dict.fromkeys(names) | given))
    with pytest.raises(ValueError, match=expected):
        check_properties(tables)


def test_signals_fit_their_times() -> None:
    with pytest.raises(ValueError, match="time_ms: expected 2 increasing times"):
        SignalChanges(
            stop_lines=np.zeros((1, 2, 2)),
            time_ms=np.array([5.0, 4.0]),
            states=np.zeros((1, 2), dtype=np.int8),
        )


def read_case(paths: tuple[Path, ...], speed_mps: float) -> Any:
    """One of several recordings of a file; without a speed, something else."""
    if not speed_mps:
        return None if paths[0].stem == "a" else exit(3)
    return RecordingTables(measurements=Measurements(**columns(speed_mps)), location="x")


def test_several_recordings_of_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are no copies; those for which the reader returns nothing or exits block themselves."""

    def find(folder: Path) -> list[Any]:
        paths = sorted(folder.glob("*.own"))
        return [
            FoundRecording(
                name=f"{path.stem}/{speed}",
                tables=(path,),
                read=partial(read_case, speed_mps=speed),
            )
            for path in paths
            for speed in (0.0, 5.0, 8.0)
        ]

    found = registry.find
    monkeypatch.setattr(registry, "names", lambda _: ("own",))
    monkeypatch.setattr("asp_env.data.source._FIRST", ())
    monkeypatch.setattr(registry, "find", lambda g, n: find if n == "own" else found(g, n))
    for name in "ab":
        (tmp_path / f"{name}.own").write_text("same")
    recordings = open_data(tmp_path)
    assert recordings.names == tuple(f"{name}/{v}" for name in "ab" for v in (0.0, 5.0, 8.0))
    speeds = [float(recordings[index].states[:, 3].mean()) for index in (1, 2, 4, 5)]
    assert speeds == pytest.approx([5.0, 8.0, 5.0, 8.0], abs=1e-3)
    for index, reason in ((0, "NoneType, expected RecordingTables"), (3, "SystemExit: 3")):
        with pytest.raises(DataError, match=f"the reader .* failed .*{reason}"):
            recordings[index]


@pytest.mark.parametrize("yielded", ["a.csv", None])
def test_a_reader_that_yields_something_else_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, yielded: object
) -> None:
    found = registry.find
    monkeypatch.setattr(
        registry, "find", lambda g, n: (lambda _: [yielded]) if n == "sind" else found(g, n)
    )
    with (
        pytest.warns(UserWarning, match="'sind' is left out: .* it yields .*, expected FoundReco"),
        pytest.raises(DataError, match="no recordings found"),
    ):
        open_data(tmp_path)


def test_recordings_without_files_are_refused() -> None:
    with pytest.raises(ValueError, match="name: '', expected a text"):
        FoundRecording(name="", tables=(Path("a"),), read=partial(read_case, speed_mps=1.0))
    with pytest.raises(ValueError, match=r"tables of a: \(\), expected paths of files"):
        FoundRecording(name="a", tables=(), read=partial(read_case, speed_mps=1.0))

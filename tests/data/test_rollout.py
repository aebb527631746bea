"""Rollout files: round trips and damaged files."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asp_env.data.rollout import Rollout
from asp_env.data.scenarios.scenario import Scenario
from asp_env.errors import DataError


def make_rollout() -> Rollout:
    """Three ticks of two agents, two plans and three forecasts."""
    rng = np.random.default_rng(0)
    return Rollout(
        scenario=Scenario(
            source="sample:intersection",
            recording=1,
            recording_name="01",
            start_tick=15,
            length=2,
            ego_id=7,
            seed=3,
            tags=("left", "standing-start"),
        ),
        dt_s=0.2,
        states=rng.normal(size=(3, 2, 4)).astype(np.float32),
        valid=np.array([(True, True), (True, False), (True, False)]),
        log_states=rng.normal(size=(3, 2, 4)).astype(np.float32),
        log_valid=np.ones((3, 2), dtype=bool),
        sizes=np.array([(4.5, 1.8), (12, 2.5)], dtype=np.float32),
        classes=np.array([0, 3], dtype=np.int32),
        ids=np.array([7, -1], dtype=np.int64),
        route=rng.normal(size=(5, 2)).astype(np.float32),
        plans=rng.normal(size=(2, 4, 2)).astype(np.float32),
        forecast_states=rng.normal(size=(3, 3, 4, 2)).astype(np.float32),
        forecast_log_probs=np.log(rng.dirichlet(np.ones(3), size=3)),
        forecast_slots=np.array([0, 1, 1]),
        forecast_ticks=np.array([0, 0, 1]),
        events=np.zeros((3, 2), dtype=bool),
        event_names=("collision", "off-road"),
    )


def error_of(path: Path) -> str:
    """The error of a file that is no rollout: one line that begins with its path."""
    with pytest.raises(DataError) as caught:
        Rollout.load(path)
    (line,) = str(caught.value).splitlines()
    assert line.startswith(f"{path}: ")
    return line


def test_round_trip(tmp_path: Path) -> None:
    """All fields are equal, with their dtypes; the folder contains no other file."""
    rollout, path = make_rollout(), tmp_path / "0.npz"
    rollout.save(path)
    loaded = Rollout.load(path)
    for field in dataclasses.fields(Rollout):
        before, after = getattr(rollout, field.name), getattr(loaded, field.name)
        if isinstance(before, np.ndarray):
            assert before.dtype == after.dtype
            np.testing.assert_array_equal(before, after)
        else:
            assert before == after
    assert list(tmp_path.iterdir()) == [path]


def test_without_plans_and_forecasts(tmp_path: Path) -> None:
    rollout = dataclasses.replace(
        make_rollout(),
        plans=np.zeros((0, 0, 2), dtype=np.float32),
        forecast_states=np.zeros((0, 0, 0, 2), dtype=np.float32),
        forecast_log_probs=np.zeros((0, 0)),
        forecast_slots=np.zeros(0, dtype=np.int64),
        forecast_ticks=np.zeros(0, dtype=np.int64),
    )
    rollout.save(tmp_path / "0.npz")
    assert Rollout.load(tmp_path / "0.npz").plans.shape == (0, 0, 2)


def test_saving_replaces_the_file_with_the_same_bytes(tmp_path: Path) -> None:
    path = tmp_path / "0.npz"
    path.write_text("an older file")
    make_rollout().save(path)
    first = path.read_bytes()
    make_rollout().save(path)
    assert path.read_bytes() == first


def test_header_is_plain_json(tmp_path: Path) -> None:
    make_rollout().save(tmp_path / "0.npz")
    with np.load(tmp_path / "0.npz", allow_pickle=False) as file:
        header = json.loads(file["header"].tobytes())
    assert header["format"] == 1
    assert header["scenario"]["ego_id"] == 7
    assert header["event_names"] == ["collision", "off-road"]


def _text(path: Path) -> None:
    path.write_text("recordingId,trackId\n0,1\n")


def _one_array(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


def _other_arrays(path: Path) -> None:
    np.savez_compressed(path, weights=np.zeros(3))


def _pickle(path: Path) -> None:
    np.savez_compressed(path, header=np.array([{"format": 1}], dtype=object))


def _header(**changes: object) -> Callable[[Path], None]:
    """Changes fields of the header, or removes those whose new value is None."""

    def write(path: Path) -> None:
        make_rollout().save(path)
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        header = {**json.loads(arrays.pop("header").tobytes()), **changes}
        fields = {name: value for name, value in header.items() if value is not None}
        text = np.frombuffer(json.dumps(fields).encode(), dtype=np.uint8)
        np.savez_compressed(path, header=text, **arrays)

    return write


def _missing_array(path: Path) -> None:
    make_rollout().save(path)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files if name != "states"}
    np.savez_compressed(path, **arrays)


@pytest.mark.parametrize(
    "write",
    [
        Path.touch,
        Path.mkdir,
        _text,
        _one_array,
        _other_arrays,
        _pickle,
        _missing_array,
        _header(scenario=None),
        _header(dt_s=None),
        _header(scenario={"tags": []}),
        _header(scenario={"tags": [], "colour": "red"}),
    ],
)
def test_other_files_are_rejected(tmp_path: Path, write: Callable[[Path], None]) -> None:
    """An empty file, a folder, a table, other arrays, pickles, an incomplete header."""
    path = tmp_path / "0.npz"
    write(path)
    assert "not a readable rollout" in error_of(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"valid": np.ones((4, 2), dtype=bool)}, "valid: 4 along 'ticks', expected 3"),
        ({"sizes": np.ones((3, 2), dtype=np.float32)}, "sizes: 3 along 'a', expected 2"),
        ({"states": np.zeros((3, 2, 4), dtype=np.int32)}, "states: int32"),
        ({"plans": np.zeros((4, 4, 2), dtype=np.float32)}, "3 ticks, 2 agents, 4 plans"),
        ({"forecast_slots": np.array([0, 1, 2])}, "forecast_slots: expected numbers from 0 to 1"),
        ({"forecast_ticks": np.array([0, 1, -1])}, "forecast_ticks: expected numbers from 0 to 2"),
        ({"classes": np.array([0, 99])}, "classes: expected numbers from 0 to 10"),
        ({"events": np.zeros((3, 3), dtype=bool)}, "events: 3 along 'kinds', expected 2"),
        ({"dt_s": float("nan")}, "dt_s is nan"),
        ({"dt_s": 0.0}, "time step 0.0"),
        ({"dt_s": 1e9}, "time step 1000000000.0"),
        ({"states": np.full((3, 2, 4), np.nan, dtype=np.float32)}, "states: expected numbers"),
        ({"sizes": np.full((2, 2), -1.0, dtype=np.float32)}, "sizes: expected no negative"),
        ({"route": np.full((5, 2), 1e30, dtype=np.float32)}, "route: expected numbers up to"),
        ({"forecast_log_probs": np.full((3, 3), np.nan)}, "forecast_log_probs: expected"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_inconsistent_arrays_are_rejected(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    path = tmp_path / "0.npz"
    rollout = make_rollout()
    for name, value in changes.items():
        object.__setattr__(rollout, name, value)
    rollout.save(path)
    assert message in error_of(path)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("start_tick", 8.5, "start_tick is 8.5, expected a whole number"),
        ("start_tick", -1, "start_tick is -1, expected 0 or more"),
        ("length", True, "length is True, expected a whole number"),
        ("tags", "left", "tags is 'left', expected a list"),
        ("recording_name", 3, "recording_name is 3, expected a text"),
    ],
)
def test_scenarios_of_other_types_are_rejected(
    field: str, value: object, message: str, tmp_path: Path
) -> None:
    scenario = {**dataclasses.asdict(make_rollout().scenario), field: value}
    _header(scenario=scenario)(tmp_path / "0.npz")
    assert message in error_of(tmp_path / "0.npz")


def test_a_scenario_that_is_no_object_is_rejected(tmp_path: Path) -> None:
    _header(scenario="left")(tmp_path / "0.npz")
    assert "'left': expected an object with fields of Scenario" in error_of(tmp_path / "0.npz")


def test_missing_file(tmp_path: Path) -> None:
    assert "No such file" in error_of(tmp_path / "0.npz")


def test_other_format_version(tmp_path: Path) -> None:
    path = tmp_path / "0.npz"
    _header(format=2)(path)
    assert error_of(path) == f"{path}: rollout format 2, expected 1"


def test_truncated_files_and_flipped_bits(tmp_path: Path) -> None:
    """A truncated file is rejected; one with a wrong bit is rejected or read as a rollout."""
    path = tmp_path / "0.npz"
    make_rollout().save(path)
    content = path.read_bytes()
    for length in range(0, len(content), 97):
        path.write_bytes(content[:length])
        error_of(path)
    results = set()
    for at in range(0, len(content), 11):
        path.write_bytes(content[:at] + bytes([content[at] ^ 1 << at % 8]) + content[at + 1 :])
        try:
            results.add(type(Rollout.load(path)))
        except DataError:
            results.add(DataError)
    assert results == {Rollout, DataError}

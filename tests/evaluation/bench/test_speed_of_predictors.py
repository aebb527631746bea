"""Latencies: how often is called, of how many agents, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from asp_env.cli import main
from asp_env.data.source import Recordings
from asp_env.errors import AspEnvError
from asp_env.evaluation.bench import timing
from asp_env.evaluation.bench.timing import busiest_scene, durations_s, measure_latencies


@pytest.fixture
def few_calls(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five calls are enough for a test."""
    monkeypatch.setattr(timing, "CALLS", 5)


def test_scene_is_the_tick_with_the_most_targets(recordings: Recordings) -> None:
    """One situation; no other tick of any recording has more vehicles that can be forecast."""
    scene = busiest_scene(recordings, dt_s=0.2)
    assert len(scene.tick) == 1
    assert scene.predictable.all()
    most = max(
        sum(
            int(recording.first_frames[track]) <= frame - 75
            and frame + 5 <= int(recording.last_frames[track])
            for track in np.flatnonzero(recording.predicted)
        )
        for recording in recordings
        for frame in range(0, recording.num_frames, 15)
    )
    assert len(scene.targets) == most > 1


@pytest.mark.usefixtures("few_calls")
def test_rows_are_counted_and_compared(recordings: Recordings) -> None:
    """Constant velocity comes first and is its own measure; each number of agents in turn."""
    rows = measure_latencies(recordings, ["constant-turn-rate"], dt_s=0.2)
    who = ["constant-velocity", "constant-turn-rate"] * 3
    assert [(row.predictor, row.agents) for row in rows] == list(
        zip(who, (1, 1, 16, 16, 64, 64), strict=True)
    )
    scene = busiest_scene(recordings, dt_s=0.2)
    assert [row.distinct for row in rows[::2]] == [min(n, len(scene.targets)) for n in (1, 16, 64)]
    for row in rows:
        assert row.calls == 5
        assert 0 < row.median_s <= row.p99_s
    for reference, other in zip(rows[::2], rows[1::2], strict=True):
        assert reference.ratio == 1
        assert other.ratio == pytest.approx(other.median_s / reference.median_s)


def test_what_takes_long_is_called_less_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """With no patience ten calls are timed, after three that are not counted."""
    monkeypatch.setattr(timing, "PATIENCE_S", 0.0)
    calls: list[int] = []
    assert len(durations_s(lambda: calls.append(1))) == 10
    assert len(calls) == 13


def test_a_predictor_that_is_handed_the_future_is_refused(recordings: Recordings) -> None:
    """The oracle computes nothing, so that its time says nothing."""
    with pytest.raises(AspEnvError, match="oracle is handed the future"):
        measure_latencies(recordings, ["oracle"], dt_s=0.2)


@pytest.mark.usefixtures("few_calls")
def test_bench_prints_them_where_asked(
    crossings: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`--predictors` adds a table; a wrong name is refused before anything is measured."""
    monkeypatch.setattr(timing, "COPY_BYTES", 2**20)
    assert main(["bench", str(crossings), "--sections"]) == 0
    assert "predict" not in capsys.readouterr().out
    args = ["bench", str(crossings), "--sections", "--predictors"]
    assert main([*args, "constant-turn-rate"]) == 0
    told = capsys.readouterr().out
    assert "one call of predict" in told
    assert told.count("constant-turn-rate") == 3
    assert main([*args, "constant-rate"]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert "did you mean 'constant-turn-rate'" in told.err

"""Tests of the latencies of predictors."""

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
    monkeypatch.setattr(timing, "CALLS", 5)


def test_the_scene_is_the_tick_with_the_most_targets(recordings: Recordings) -> None:
    """No other tick of any recording has more vehicles with a history and a future."""
    scene = busiest_scene(recordings, dt_s=0.2)
    assert len(scene.tick) == 1
    assert scene.predictable.all()
    max_targets = max(
        sum(
            int(recording.first_frames[track]) <= frame - 75
            and frame + 5 <= int(recording.last_frames[track])
            for track in np.flatnonzero(recording.predicted)
        )
        for recording in recordings
        for frame in range(0, recording.num_frames, 15)
    )
    assert len(scene.targets) == max_targets > 1


@pytest.mark.usefixtures("few_calls")
def test_latencies_are_relative_to_constant_velocity(recordings: Recordings) -> None:
    """Constant velocity comes first for each number of agents, with a ratio of 1."""
    rows = measure_latencies(recordings, ["constant-turn-rate"], dt_s=0.2)
    names = ["constant-velocity", "constant-turn-rate"] * 3
    assert [(row.predictor, row.agents) for row in rows] == list(
        zip(names, (1, 1, 16, 16, 64, 64), strict=True)
    )
    scene = busiest_scene(recordings, dt_s=0.2)
    assert [row.distinct for row in rows[::2]] == [min(n, len(scene.targets)) for n in (1, 16, 64)]
    for row in rows:
        assert row.calls == 5
        assert 0 < row.median_s <= row.p99_s
    for reference, other in zip(rows[::2], rows[1::2], strict=True):
        assert reference.ratio == 1
        assert other.ratio == pytest.approx(other.median_s / reference.median_s)


def test_slow_predictors_are_called_less_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a maximum duration of 0 s, ten calls are timed after three untimed ones."""
    monkeypatch.setattr(timing, "MAX_DURATION_S", 0.0)
    calls: list[int] = []
    assert len(durations_s(lambda: calls.append(1))) == 10
    assert len(calls) == 13


def test_privileged_predictors_are_refused(recordings: Recordings) -> None:
    """The oracle copies the recorded future, so that its latency has no meaning."""
    with pytest.raises(AspEnvError, match="oracle is privileged"):
        measure_latencies(recordings, ["oracle"], dt_s=0.2)


@pytest.mark.usefixtures("few_calls")
def test_bench_prints_latencies_of_named_predictors(
    crossings: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An unknown name is refused before anything is measured."""
    monkeypatch.setattr(timing, "COPY_BYTES", 2**20)
    assert main(["bench", str(crossings), "--sections"]) == 2
    assert "--sections: none given" in capsys.readouterr().err
    args = ["bench", str(crossings), "--sections", "--predictors"]
    assert main([*args, "constant-turn-rate"]) == 0
    output = capsys.readouterr().out
    assert "one call of predict" in output
    assert output.count("constant-turn-rate") == 3
    assert main([*args, "constant-rate"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "did you mean 'constant-turn-rate'" in captured.err

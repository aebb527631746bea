"""Memory does not grow; the long run is `tests.benchmarks.memory`."""

from tests.benchmarks.memory import drive_many, drive_one


def test_memory_does_not_grow_with_resets_and_steps(crossing):
    """Not by 5 MiB over 90 resets and 1,800 steps, nor over 2,000 steps of 20 together."""
    for seen in (
        drive_one(crossing, resets=100, steps=2000),
        drive_many(crossing, count=20, steps=2000),
    ):
        assert len(seen) == 10
        assert seen[-1] - seen[0] < 5

"""Memory does not grow; `tests.benchmarks.memory` is the long run."""

from tests.benchmarks.memory import drive_many, drive_one


def test_memory_does_not_grow_with_resets_and_steps(crossing):
    """By less than 5 MiB in 45 resets and 900 steps, and in 900 steps of 20 environments."""
    for seen in (
        drive_one(crossing, resets=50, steps=1000),
        drive_many(crossing, count=20, steps=1000),
    ):
        assert len(seen) == 10
        assert seen[-1] - seen[0] < 5

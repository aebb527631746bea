"""What counts as growth in a soak run."""

from tests.benchmarks.soak import PARTS, Sample, growth


def _samples(rss_mib: list[float]) -> list[Sample]:
    last = PARTS[-1].__name__
    return [
        Sample(
            seconds=60.0 * number, round=number, part=part, rss_mib=value if part == last else 9e3,
            open_files=9, threads=4, children=0,
        )
        for number, value in enumerate(rss_mib)
        for part in ("drive", last)
    ]  # fmt: skip


def test_growth_is_that_after_the_warm_up_at_the_ends_of_rounds() -> None:
    """Of 10 rounds, the first 2 are not compared; of 8, the medians of 2 and of the last 2."""
    flat = [100.0, 400.0, *[500.0] * 8]
    assert growth(_samples(flat))["rss_mib"] == 0
    leaking = [100.0, 400.0, *[500.0 + 10 * number for number in range(8)]]
    assert growth(_samples(leaking))["rss_mib"] == 60  # 565 - 505
    assert growth(_samples(leaking))["open_files"] == 0

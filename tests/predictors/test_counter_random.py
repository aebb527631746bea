"""Random numbers without a state: their distribution, and what they depend on."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from predictors.counter_random import mixed, nearly_normal, uniform

COUNT = 200_000


def test_splitmix64_of_seed_zero() -> None:
    """The first three numbers of the published generator with seed 0."""
    state = np.arange(3, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    expected = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    assert mixed(state).tolist() == expected


def test_uniform_numbers_have_the_moments_of_the_uniform_distribution() -> None:
    """Mean 1/2 and variance 1/12, within four standard errors."""
    drawn = uniform(np.zeros(1, dtype=np.uint64), np.arange(COUNT))
    assert drawn.min() >= 0
    assert drawn.max() < 1
    assert drawn.mean() == pytest.approx(0.5, abs=4 * (1 / 12 / COUNT) ** 0.5)
    assert drawn.var() == pytest.approx(1 / 12, abs=4 * (1 / 180 / COUNT) ** 0.5)


def test_nearly_normal_numbers_have_mean_zero_and_variance_one() -> None:
    drawn = nearly_normal(np.zeros(1, dtype=np.uint64), np.arange(COUNT))
    assert drawn.mean() == pytest.approx(0, abs=4 / COUNT**0.5)
    assert drawn.var() == pytest.approx(1, abs=4 * (2 / COUNT) ** 0.5)
    assert np.abs(drawn).max() < 3.5


@given(stream=st.integers(0, 2**64 - 1), counter=st.integers(0, 2**40))
def test_a_number_does_not_depend_on_the_others(stream: int, counter: int) -> None:
    """Drawn alone and within an array, a number is equal bit for bit."""
    streams = np.array([7, stream], dtype=np.uint64)
    many = uniform(streams[:, None], np.array([3, counter, counter + 1]))
    alone = uniform(streams[1:], np.array([counter]))
    assert many[1, 1] == alone[0]
    assert many[1, 1] != many[1, 2]

"""What is told of features: known numbers of known matrices."""

import pytest
import torch

from predictors.diagnosis import Diagnosis, effective_rank, r_squared
from predictors.network import Features


def test_effective_rank_of_one_direction_is_one() -> None:
    """Features along one line, wherever it lies: 1."""
    along = torch.tensor([[1.0, 2.0, -2.0]]) * torch.tensor([[0.0], [1.0], [3.0], [-5.0]])
    assert effective_rank(along + 7) == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("d", [2, 5])
def test_effective_rank_of_all_directions_alike_is_their_number(d: int) -> None:
    """Plus and minus of each of d axes: d; of twice as much along one of two axes less."""
    axes = torch.cat([torch.eye(d), -torch.eye(d)])
    assert effective_rank(axes) == pytest.approx(d, abs=1e-4)
    assert effective_rank(axes * 1e3 + 5) == pytest.approx(d, abs=1e-3)


def test_effective_rank_by_hand() -> None:
    """Singular values 2 to 1: entropy ln 3 - 2/3 ln 2, so 3 / 2^(2/3) = 1.8899."""
    axes = torch.tensor([[2.0, 0.0], [-2.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    assert effective_rank(axes) == pytest.approx(3 / 2 ** (2 / 3), abs=1e-5)


def test_constant_features_have_no_rank_and_no_r_squared() -> None:
    """Nothing varies: both are 0."""
    same = torch.ones(4, 3)
    assert effective_rank(same) == 0
    assert r_squared(same, same) == 0


def test_r_squared_by_hand() -> None:
    """Perfect is 1, the mean is 0, twice as far off is -3."""
    actual = torch.tensor([[0.0, 1.0], [2.0, 1.0]])
    mean = torch.tensor([[1.0, 1.0], [1.0, 1.0]])
    assert r_squared(actual, actual) == 1
    assert r_squared(mean, actual) == 0
    assert r_squared(actual + 2 * (mean - actual), actual) == -3


def test_diagnosis_gathers_batches() -> None:
    """Two batches of one count as one of two; then it starts again; nothing gives nothing."""
    diagnosis = Diagnosis()
    assert diagnosis.finish() == {}
    diagnosis.add(None)
    assert diagnosis.finish() == {}
    for row in ([0.0, 0.0], [2.0, 4.0]):
        features = torch.tensor([row])
        diagnosis.add(Features(encoded=features, predicted=features))
    found = diagnosis.finish()
    assert found["feature standard deviation"] == pytest.approx(1.5)
    assert found["feature effective rank"] == pytest.approx(1, abs=1e-4)
    assert found["feature R2"] == 1
    assert diagnosis.finish() == {}

"""Statistics of features, against numbers of known matrices."""

import pytest
import torch
from torch import Tensor

from predictors.models.network import Features
from predictors.training.lightning_parts import FeatureStatistics, effective_rank

RANK, DEVIATION, R2 = "feature effective rank", "feature standard deviation", "feature R2"


def statistics_of(encoded: Tensor, predicted: Tensor | None = None) -> dict[str, float]:
    """The statistics of features; by default with perfect predictions."""
    statistics = FeatureStatistics()
    statistics.add(Features(encoded, encoded if predicted is None else predicted))
    return statistics.finish()


def test_effective_rank_of_one_direction_is_one() -> None:
    """Features along one line, which need not pass through the origin: 1."""
    along = torch.tensor([[1.0, 2.0, -2.0]]) * torch.tensor([[0.0], [1.0], [3.0], [-5.0]])
    assert statistics_of(along + 7)[RANK] == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("d", [2, 5])
def test_effective_rank_of_equal_directions_is_their_number(d: int) -> None:
    """Plus and minus each of d axes: d, at any scale and offset."""
    axes = torch.cat([torch.eye(d), -torch.eye(d)])
    assert statistics_of(axes)[RANK] == pytest.approx(d, abs=1e-6)
    assert statistics_of(axes * 1e3 + 5)[RANK] == pytest.approx(d, abs=1e-6)
    assert statistics_of(axes * 0.25 + 1000)[RANK] == pytest.approx(d, abs=1e-4)


def test_effective_rank_by_hand() -> None:
    """Singular values 2 : 1 have the entropy ln 3 - 2/3 ln 2, so 3 / 2^(2/3) = 1.8899."""
    axes = torch.tensor([[2.0, 0.0], [-2.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    assert statistics_of(axes)[RANK] == pytest.approx(3 / 2 ** (2 / 3), abs=1e-6)
    assert effective_rank(torch.tensor([4.0, 2.0])) == pytest.approx(3 / 2 ** (2 / 3), abs=1e-6)


def test_effective_rank_is_that_of_singular_values() -> None:
    """300 random features of 20 coordinates, against their singular values."""
    features = torch.randn(300, 20, generator=torch.Generator().manual_seed(0))
    features = features * torch.linspace(0.01, 1, 20) + torch.linspace(-3, 3, 20)
    values = torch.linalg.svdvals(features - features.mean(dim=0))
    assert statistics_of(features)[RANK] == pytest.approx(effective_rank(values), rel=1e-4)


def test_constant_features_have_no_rank_and_no_r_squared() -> None:
    assert statistics_of(torch.full((7, 3), 0.1)) == {RANK: 0, DEVIATION: 0, R2: 0}


def test_r_squared_by_hand() -> None:
    """1 for perfect predictions, 0 for the mean, -3 for twice the error of the mean."""
    actual = torch.tensor([[0.0, 1.0], [2.0, 1.0]])
    mean = torch.tensor([[1.0, 1.0], [1.0, 1.0]])
    assert statistics_of(actual, actual)[R2] == 1
    assert statistics_of(actual, mean)[R2] == 0
    assert statistics_of(actual, actual + 2 * (mean - actual))[R2] == -3


def test_statistics_over_batches() -> None:
    """Two batches of one equal one batch of two; `finish` starts anew; nothing gives nothing."""
    statistics = FeatureStatistics()
    assert statistics.finish() == {}
    statistics.add(None)
    assert statistics.finish() == {}
    for row in ([0.0, 0.0], [2.0, 4.0]):
        features = torch.tensor([row])
        statistics.add(Features(encoded=features, predicted=features))
    values = statistics.finish()
    assert values[DEVIATION] == pytest.approx(1.5)
    assert values[RANK] == pytest.approx(1, abs=1e-4)
    assert values[R2] == 1
    assert statistics.finish() == {}


def test_statistics_join() -> None:
    """The joined statistics of three parts, one of them empty, are those of all features."""
    features = torch.tensor([[0.0, 1.0], [2.0, 5.0], [1.0, -1.0]])
    parts = [FeatureStatistics(), FeatureStatistics(), FeatureStatistics()]
    parts[0].add(Features(features[:2], features[:2] + 1))
    parts[2].add(Features(features[2:], features[2:] + 1))
    for part in parts[1:]:
        parts[0].join(part)
    assert parts[0].finish() == pytest.approx(statistics_of(features, features + 1))

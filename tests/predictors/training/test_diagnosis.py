"""What is told of features: known numbers of known matrices."""

import pytest
import torch
from torch import Tensor

from predictors.models.network import Features
from predictors.training.lightning_parts import FeatureStatistics, effective_rank

RANK, DEVIATION, R2 = "feature effective rank", "feature standard deviation", "feature R2"


def told(encoded: Tensor, predicted: Tensor | None = None) -> dict[str, float]:
    """What a diagnosis says of some features; without predictions, of perfect ones."""
    diagnosis = FeatureStatistics()
    diagnosis.add(Features(encoded, encoded if predicted is None else predicted))
    return diagnosis.finish()


def test_effective_rank_of_one_direction_is_one() -> None:
    """Features along one line, wherever it lies: 1."""
    along = torch.tensor([[1.0, 2.0, -2.0]]) * torch.tensor([[0.0], [1.0], [3.0], [-5.0]])
    assert told(along + 7)[RANK] == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("d", [2, 5])
def test_effective_rank_of_all_directions_alike_is_their_number(d: int) -> None:
    """Plus and minus of each of d axes: d, however far from zero they are."""
    axes = torch.cat([torch.eye(d), -torch.eye(d)])
    assert told(axes)[RANK] == pytest.approx(d, abs=1e-6)
    assert told(axes * 1e3 + 5)[RANK] == pytest.approx(d, abs=1e-6)
    assert told(axes * 0.25 + 1000)[RANK] == pytest.approx(d, abs=1e-4)


def test_effective_rank_by_hand() -> None:
    """Singular values 2 to 1: entropy ln 3 - 2/3 ln 2, so 3 / 2^(2/3) = 1.8899."""
    axes = torch.tensor([[2.0, 0.0], [-2.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    assert told(axes)[RANK] == pytest.approx(3 / 2 ** (2 / 3), abs=1e-6)
    assert effective_rank(torch.tensor([4.0, 2.0])) == pytest.approx(3 / 2 ** (2 / 3), abs=1e-6)


def test_effective_rank_is_that_of_singular_values() -> None:
    """Of 300 random features of 20 coordinates, as from the singular values themselves."""
    features = torch.randn(300, 20, generator=torch.Generator().manual_seed(0))
    features = features * torch.linspace(0.01, 1, 20) + torch.linspace(-3, 3, 20)
    values = torch.linalg.svdvals(features - features.mean(dim=0))
    assert told(features)[RANK] == pytest.approx(effective_rank(values), rel=1e-4)


def test_constant_features_have_no_rank_and_no_r_squared() -> None:
    """Nothing varies: all are 0."""
    assert told(torch.full((7, 3), 0.1)) == {RANK: 0, DEVIATION: 0, R2: 0}


def test_r_squared_by_hand() -> None:
    """Perfect is 1, the mean is 0, twice as far off is -3."""
    actual = torch.tensor([[0.0, 1.0], [2.0, 1.0]])
    mean = torch.tensor([[1.0, 1.0], [1.0, 1.0]])
    assert told(actual, actual)[R2] == 1
    assert told(actual, mean)[R2] == 0
    assert told(actual, actual + 2 * (mean - actual))[R2] == -3


def test_diagnosis_gathers_batches() -> None:
    """Two batches of one count as one of two; then it starts again; nothing gives nothing."""
    diagnosis = FeatureStatistics()
    assert diagnosis.finish() == {}
    diagnosis.add(None)
    assert diagnosis.finish() == {}
    for row in ([0.0, 0.0], [2.0, 4.0]):
        features = torch.tensor([row])
        diagnosis.add(Features(encoded=features, predicted=features))
    found = diagnosis.finish()
    assert found[DEVIATION] == pytest.approx(1.5)
    assert found[RANK] == pytest.approx(1, abs=1e-4)
    assert found[R2] == 1
    assert diagnosis.finish() == {}


def test_diagnoses_join() -> None:
    """What two gathered, one of them nothing of its own, is what one gathers of all."""
    features = torch.tensor([[0.0, 1.0], [2.0, 5.0], [1.0, -1.0]])
    parts = [FeatureStatistics(), FeatureStatistics(), FeatureStatistics()]
    parts[0].add(Features(features[:2], features[:2] + 1))
    parts[2].add(Features(features[2:], features[2:] + 1))
    for part in parts[1:]:
        parts[0].join(part)
    assert parts[0].finish() == pytest.approx(told(features, features + 1))

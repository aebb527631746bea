"""The Mahalanobis distance of features, its threshold and its file."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from asp_env.errors import AspEnvError, CheckpointError
from predictors.inference.feature_distance import (
    MIN_TARGETS,
    SHRINKAGE,
    FeatureDistance,
    fit_feature_distance,
)
from predictors.inference.fit_features import add_feature_distance
from tests.predictors.tiny import save_random, write_data


def gaussian(count: int, *, seed: int = 0) -> np.ndarray:
    """Features with standard deviations 3 and 1."""
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(count, 2)) * (3.0, 1.0)).astype(np.float32)


def fitted(features: np.ndarray, recordings: int = 10) -> FeatureDistance:
    """Statistics of features that are divided among recordings."""
    found = fit_feature_distance(features, np.arange(len(features)) * recordings // len(features))
    assert found is not None
    return found


def test_distance_by_hand() -> None:
    """Four corners: mean (1, 2), variances 4 and 1. (5, 2) is 2 standard deviations away."""
    corners = np.array([[-1, 1], [-1, 3], [3, 1], [3, 3]] * 10, dtype=np.float32)
    distance = fitted(corners)
    np.testing.assert_allclose(distance.mean, [1, 2])
    shrunk = (1 - SHRINKAGE) * 4 + SHRINKAGE * 2.5
    expected = 4 / np.sqrt(shrunk) / distance.threshold
    point = np.array([[5, 2]], dtype=np.float32)
    np.testing.assert_allclose(distance.score(point), [expected], rtol=1e-9)


def test_one_percent_of_new_features_lie_above_the_threshold() -> None:
    """Of features with the same distribution, which nothing was fitted on."""
    score = fitted(gaussian(4000)).score(gaussian(20_000, seed=1))
    assert (score > 1).mean() == pytest.approx(0.01, abs=0.004)


def test_threshold_measures_each_half_by_the_other() -> None:
    """Recordings that differ are far from each other, which their own statistics would hide."""
    near, far = gaussian(500), gaussian(500, seed=1) + np.float32(40)
    same, shifted = (
        fit_feature_distance(np.concatenate([near, other]), np.repeat([0, 1], 500))
        for other in (gaussian(500, seed=1), far)
    )
    assert same is not None
    assert shifted is not None
    assert shifted.threshold > 5 * same.threshold


def test_score_of_a_row_does_not_depend_on_the_others() -> None:
    """Bit for bit, alone and among others."""
    distance, features = fitted(gaussian(500)), gaussian(50, seed=2)
    together = distance.score(features)
    for row in (0, 17, 49):
        np.testing.assert_array_equal(distance.score(features[row : row + 1]), together[row])


def test_too_few_targets_have_no_statistics() -> None:
    few = gaussian(MIN_TARGETS - 1)
    assert fit_feature_distance(few, np.zeros(len(few), dtype=np.int64)) is None
    assert fit_feature_distance(few[:0], np.zeros(0, dtype=np.int64)) is None


def test_features_that_do_not_vary_have_finite_scores() -> None:
    constant = np.ones((30, 3), dtype=np.float32)
    score = fitted(constant).score(np.array([[1, 1, 1], [2, 1, 1]], dtype=np.float32))
    assert np.isfinite(score).all()
    assert score[0] < 1 < score[1]


def test_file_holds_the_statistics(tmp_path: Path) -> None:
    """Loaded scores are the saved ones up to rounding to 11 bits, in any order of the memory.

    The stored matrix is triangular, and the 13 lower bits of its numbers are zero.
    """
    rng = np.random.default_rng(0)
    distance = fitted((rng.normal(size=(400, 5)) @ rng.normal(size=(5, 5))).astype(np.float32))
    distance = replace(distance, whitening=np.asfortranarray(distance.whitening))
    distance.save(tmp_path)
    stored = load_file(tmp_path / "features.safetensors")["whitening"]
    np.testing.assert_array_equal(stored, np.triu(stored))
    np.testing.assert_allclose(stored, distance.whitening, rtol=2**-11)
    assert not (stored.view(np.uint32) % (1 << 13)).any()
    loaded = FeatureDistance.load(tmp_path, name="dkm:RUN", features=5)
    points = rng.normal(size=(20, 5)).astype(np.float32)
    np.testing.assert_allclose(loaded.score(points), distance.score(points), rtol=2e-3)


def test_missing_and_damaged_files_name_the_remedy(tmp_path: Path) -> None:
    remedy = r"python -m predictors\.inference\.fit_features dkm:RUN VALIDATION_DATA"
    with pytest.raises(CheckpointError, match=f"dkm:RUN has no statistics.*{remedy}"):
        FeatureDistance.load(tmp_path, name="dkm:RUN", features=2)
    fitted(gaussian(100)).save(tmp_path)
    path = tmp_path / "features.safetensors"
    whole = load_file(path)
    damages = (
        {"mean": whole["mean"]},
        {**whole, "threshold": np.array([0.0], dtype=np.float32)},
        {**whole, "whitening": np.full((2, 2), np.nan, dtype=np.float32)},
        {**whole, "mean": whole["mean"] + 1},  # has another checksum
        # of two dimensions, in a file of before there were checksums
        {
            **{name: whole[name] for name in ("mean", "whitening")},
            "threshold": np.ones((1, 2), dtype=np.float32),
        },
    )
    for damage in damages:
        save_file(damage, path)
        with pytest.raises(CheckpointError, match=remedy):
            FeatureDistance.load(tmp_path, name="dkm:RUN", features=2)
    fitted(gaussian(100)).save(tmp_path)
    with pytest.raises(CheckpointError, match="another network"):
        FeatureDistance.load(tmp_path, name="dkm:RUN", features=3)


def test_statistics_are_added_to_a_finished_run(tmp_path: Path) -> None:
    """The remedy works: fitted on recordings that the run does not know."""
    data = write_data(tmp_path / "data")
    run = save_random(tmp_path / "run", "ffw-asp", "vectors")
    distance = add_feature_distance(run, [data])
    loaded = FeatureDistance.load(run, name="ffw-asp:RUN", features=8)
    np.testing.assert_allclose(loaded.mean, distance.mean, rtol=1e-6)
    with pytest.raises(AspEnvError, match="no DATA"):
        add_feature_distance(run, [])

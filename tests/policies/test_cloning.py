"""Behaviour cloning finds the most likely policy, on groups that it is not trained on."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from asp_env.errors import AspEnvError
from policies.cloning import clone, hold_out

pytest.importorskip("stable_baselines3")


class Space(gymnasium.Env[Any, Any]):
    """Only the spaces of an environment."""

    def __init__(self, observation_space: spaces.Space[Any]) -> None:
        self.observation_space = observation_space
        self.action_space = spaces.Box(-1, 1, (2,), dtype=np.float32)


def linear_policy(observation_space: spaces.Space[Any], kind: str = "MlpPolicy") -> Any:
    """A Gaussian policy whose mean is an affine function of the observation."""
    from stable_baselines3 import PPO

    kwargs = {"net_arch": [], "log_std_init": -1.0}
    env = Space(observation_space)
    return PPO(kind, env, policy_kwargs=kwargs, seed=0, device="cpu").policy  # pyright: ignore[reportArgumentType]


def linear_data(noise: float = 0.1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Observations (800, 3), actions that are an affine function of them plus noise, groups."""
    rng = np.random.default_rng(1)
    observations = rng.uniform(-1, 1, (800, 3)).astype(np.float32)
    weights, bias = np.array([[0.5, -0.2], [0.1, 0.3], [-0.4, 0.0]]), np.array([0.2, -0.1])
    actions = observations @ weights + bias + noise * rng.standard_normal((800, 2))
    return observations, actions.astype(np.float32), np.repeat(np.arange(20), 40)


BOX = spaces.Box(-1, 1, (3,), dtype=np.float32)


def test_a_linear_policy_becomes_the_least_squares_solution() -> None:
    """The most likely mean is that of ordinary least squares, the deviation that of its residuals.

    0.1 in both actions has the negative log-likelihood 2 · (ln 0.1 + ln √(2πe)) = -1.767.
    """
    observations, actions, groups = linear_data()
    policy = linear_policy(BOX)
    result = clone(policy, observations, actions, groups, learning_rate=0.01, epochs=60)
    inputs = np.concatenate([observations, np.ones((800, 1))], axis=1)
    solution, *_ = np.linalg.lstsq(inputs, actions, rcond=None)
    means, _ = policy.predict(observations, deterministic=True)
    np.testing.assert_allclose(means, np.clip(inputs @ solution, -1, 1), atol=0.02)
    np.testing.assert_allclose(np.exp(policy.log_std.detach().numpy()), 0.1, rtol=0.1)
    assert result.validation_nll[result.best_epoch] == pytest.approx(-1.767, abs=0.15)
    assert result.best_epoch == int(np.argmin(result.validation_nll))
    assert (result.num_train, result.num_validation) == (720, 80)


def test_the_result_depends_on_the_arguments_alone() -> None:
    """The same seed gives the same bits, whatever the global random state; another does not."""
    import torch

    data, parameters = linear_data(), []
    for seed, state in ((0, 1), (0, 2), (1, 1)):
        policy = linear_policy(BOX)
        torch.manual_seed(state)
        clone(policy, *data, epochs=2, seed=seed)
        parameters.append(policy.action_net.weight.detach().numpy().tobytes())
    assert parameters[0] == parameters[1]
    assert parameters[0] != parameters[2]


def test_training_ends_when_the_validation_no_longer_improves() -> None:
    """Actions without a relation to the observations: the best epoch is restored."""
    rng = np.random.default_rng(0)
    observations = rng.uniform(-1, 1, (60, 3)).astype(np.float32)
    actions = rng.uniform(-1, 1, (60, 2)).astype(np.float32)
    groups = np.arange(60) // 3
    policy = linear_policy(BOX)
    result = clone(policy, observations, actions, groups, learning_rate=0.1, patience=3)
    assert len(result.validation_nll) == result.best_epoch + 4 <= 101
    again = clone(policy, observations, actions, groups, epochs=0)
    assert again.validation_nll[0] == pytest.approx(result.validation_nll[result.best_epoch])


def test_observations_by_entry() -> None:
    """The same data as one array and as a dictionary of its columns."""
    observations, actions, groups = linear_data()
    space = spaces.Dict({name: spaces.Box(-1, 1, (1,), dtype=np.float32) for name in "abc"})
    policy = linear_policy(space, "MultiInputPolicy")
    entries = {name: observations[:, [i]] for i, name in enumerate("abc")}
    result = clone(policy, entries, actions, groups, learning_rate=0.02, epochs=40)
    assert result.validation_nll[result.best_epoch] == pytest.approx(-1.767, abs=0.15)


@pytest.mark.parametrize(("share", "expected"), [(0.0, 1), (0.1, 1), (0.26, 3), (1.0, 9)])
def test_whole_groups_are_held_out(share: float, expected: int) -> None:
    groups = np.repeat(np.arange(10), 7)
    mask = hold_out(groups, share, np.random.default_rng(0)).reshape(10, 7)
    assert (mask.all(axis=1) | ~mask.any(axis=1)).all()
    assert mask[:, 0].sum() == expected


def test_invalid_demonstrations_are_rejected() -> None:
    observations, actions, groups = linear_data()
    with pytest.raises(AspEnvError, match="1 groups of demonstrations: expected at least 2"):
        clone(linear_policy(BOX), observations, actions, np.zeros_like(groups))
    with pytest.raises(AspEnvError, match="799 values of the observation: expected one for each"):
        clone(linear_policy(BOX), observations[1:], actions, groups)
    with pytest.raises(AspEnvError, match="loss of epoch 1 is not finite; normalize"):
        clone(linear_policy(BOX), observations, actions * np.inf, groups)

"""Behaviour cloning: a policy of stable-baselines3 learns the actions of demonstrations.

The loss is the negative log-likelihood of the actions (Pomerleau, "ALVINN", NeurIPS 1988, with the
distribution of the policy). For the Gaussian policies of PPO its minimum is the conditional mean,
and the standard deviation of what the mean does not explain. Only the public interface of
`ActorCriticPolicy` is used, so that every policy and every features extractor is cloned alike. The
value function is not trained.
"""

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.errors import AspEnvError

if TYPE_CHECKING:
    from stable_baselines3.common.policies import ActorCriticPolicy


@dataclass(frozen=True, slots=True, kw_only=True)
class CloningResult:
    """The course of `clone`; epoch 0 is the policy before the training."""

    train_nll: tuple[float, ...]
    """Mean negative log-likelihood of an action in each epoch, on the steps trained on. It is
    taken while the policy changes; epoch 0 has none and repeats the first."""
    validation_nll: tuple[float, ...]
    """The same on the steps held out, at the end of each epoch."""
    best_epoch: int
    """Epoch with the lowest validation loss, whose parameters the policy has now."""
    num_train: int
    """Number of steps trained on."""
    num_validation: int
    """Number of steps held out."""


def clone(
    policy: "ActorCriticPolicy",
    observations: Mapping[str, np.ndarray] | np.ndarray,
    actions: Float[np.ndarray, "n size"],
    groups: Int[np.ndarray, " n"],
    *,
    validation_share: float = 0.1,
    epochs: int = 100,
    patience: int = 5,
    batch_size: int = 256,
    learning_rate: float = 1e-3,
    max_gradient_norm: float = 0.5,
    seed: int = 0,
) -> CloningResult:
    """Trains a policy on demonstrations by maximum likelihood, in place.

    Whole groups are held out for the validation. The training ends when the validation loss has
    not fallen for `patience` epochs; the policy then has the parameters of the best epoch. The
    result depends on the arguments alone, not on global random state.

    Args:
        policy: the policy of an `A2C`, `PPO` or similar algorithm, `model.policy`.
        observations: (n, …) arrays by entry, or one array, as the policy gets them: normalized by
            `VecNormalize.normalize_obs` if the environment is.
        actions: the actions of the demonstrations in the action space.
        groups: number of the episode or recording of each step.
        validation_share: share of the groups that is held out, at least one.
        epochs: largest number of passes through the data.
        patience: passes without a lower validation loss after which the training ends.
        batch_size: steps per update.
        learning_rate: step size of Adam.
        max_gradient_norm: gradients are scaled down to this norm.
        seed: seed of the held-out groups and of the order of the steps.

    Returns:
        The course of the training.

    Raises:
        AspEnvError: there are fewer than two groups, the numbers of steps differ, or the loss is
            not finite.
    """
    import torch

    _check_lengths(observations, actions, groups)
    rng = np.random.default_rng(seed)
    held_out = hold_out(groups, validation_share, rng)
    train, validation = np.flatnonzero(~held_out), np.flatnonzero(held_out)
    parameters = [each for each in policy.parameters() if each.requires_grad]
    optimizer = torch.optim.Adam(parameters, lr=learning_rate)

    def loss_of(rows: Int[np.ndarray, " m"]) -> Any:
        batch = _rows_of(observations, rows)
        tensors, _ = policy.obs_to_tensor(batch)  # pyright: ignore[reportArgumentType]
        taken = torch.as_tensor(actions[rows], dtype=torch.float32, device=policy.device)
        _, log_likelihood, _ = policy.evaluate_actions(tensors, taken)  # pyright: ignore[reportArgumentType]
        return -log_likelihood

    def validate() -> float:
        policy.set_training_mode(False)
        with torch.no_grad():
            chunks = range(0, len(validation), batch_size)
            return float(
                torch.cat([loss_of(validation[i : i + batch_size]) for i in chunks]).mean()
            )

    train_nll: list[float] = []
    validation_nll = [validate()]
    best_epoch, best = 0, copy.deepcopy(policy.state_dict())
    for epoch in range(1, epochs + 1):
        policy.set_training_mode(True)
        total = 0.0
        order = rng.permutation(train)
        for start in range(0, len(order), batch_size):
            losses = loss_of(order[start : start + batch_size])
            if not torch.isfinite(losses).all():
                raise AspEnvError(
                    f"behaviour cloning: the loss of epoch {epoch} is not finite; normalize the "
                    "observations, or choose a lower learning rate"
                )
            optimizer.zero_grad()
            losses.mean().backward()
            torch.nn.utils.clip_grad_norm_(parameters, max_gradient_norm)
            optimizer.step()
            total += float(losses.detach().sum())
        train_nll.append(total / len(train))
        validation_nll.append(validate())
        if validation_nll[-1] < validation_nll[best_epoch]:
            best_epoch, best = epoch, copy.deepcopy(policy.state_dict())
        elif epoch - best_epoch >= patience:
            break
    policy.load_state_dict(best)
    policy.set_training_mode(False)
    return CloningResult(
        train_nll=(*train_nll[:1], *train_nll),
        validation_nll=tuple(validation_nll),
        best_epoch=best_epoch,
        num_train=len(train),
        num_validation=len(validation),
    )


def hold_out(
    groups: Int[np.ndarray, " n"], share: float, rng: np.random.Generator
) -> Bool[np.ndarray, " n"]:
    """A mask of the steps whose groups are held out.

    Args:
        groups: number of the group of each step.
        share: share of the groups to hold out, rounded; at least one is, and at least one is not.
        rng: chooses the groups.

    Raises:
        AspEnvError: there are fewer than two groups.
    """
    names = np.unique(groups)
    if len(names) < 2:
        raise AspEnvError(
            f"{len(names)} groups of demonstrations: expected at least 2, one for the validation; "
            "split by episodes instead of recordings"
        )
    count = min(max(round(share * len(names)), 1), len(names) - 1)
    return np.isin(groups, rng.permutation(names)[:count])


def _rows_of(
    observations: Mapping[str, np.ndarray] | np.ndarray, rows: Int[np.ndarray, " m"]
) -> Mapping[str, np.ndarray] | np.ndarray:
    if isinstance(observations, np.ndarray):
        return observations[rows]
    return {name: values[rows] for name, values in observations.items()}


def _check_lengths(
    observations: Mapping[str, np.ndarray] | np.ndarray, actions: np.ndarray, groups: np.ndarray
) -> None:
    parts = {"": observations} if isinstance(observations, np.ndarray) else observations
    for name, values in (*parts.items(), ("groups", groups)):
        if len(values) != len(actions):
            raise AspEnvError(
                f"{len(values)} values of {name or 'the observation'}: expected one for each of "
                f"{len(actions)} actions"
            )

"""Chaining segments of several modes into longer forecasts. N targets, K chains, M modes, T ticks.

A later segment starts from one mode of the one before. `top1` goes on from the most probable mode
alone (as it is, before any are merged), `full` from every one, `beam` from every one and keeps the
most probable chains, or those that speak for most. `oracle` goes on from the mode nearest to the
label (the paper's label matching, at test time): it knows the future, and tables say so.
"""

from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from asp_env.geometry import wrap_angle
from predictors.models.losses import Assignment, best_mode

Chaining = Literal["beam", "top1", "full", "oracle"]
CHAININGS: tuple[Chaining, ...] = ("beam", "top1", "full", "oracle")


MIN_MASS = 1e-4
"""Of a chain that stands for nothing that another does not stand for already."""


class Chains(NamedTuple):
    """What has been forecast so far, and where it goes on from."""

    states: Float[Tensor, "n k t 4"]
    actions: Float[Tensor, "n k t 2"]
    log_probs: Float[Tensor, "n k"]
    z: Float[Tensor, "n k z"]
    """Predicted features at the end."""


def starts(
    chains: Chains,
    chaining: Chaining,
    *,
    label: Float[Tensor, "n t 2"] | None = None,
    assignment: Assignment = "angle",
) -> Chains:
    """The chains that the next segment goes on from; where it is one, its probability is one."""
    if chaining in ("beam", "full"):
        return chains
    if chaining == "oracle":
        assert label is not None
        ticks = chains.states.shape[2]
        row = best_mode(chains.states[..., :2], label[:, :ticks], assignment)
    else:
        row = chains.log_probs.argmax(dim=1)
    chosen = pick(chains, row[:, None])
    return chosen._replace(log_probs=torch.zeros_like(chosen.log_probs))


def grow(chains: Chains, segment: Chains) -> Chains:
    """Every chain followed by each of the modes that were predicted for it.

    Args:
        chains: of K chains.
        segment: of K·M rows for each target, M in turn for each chain.
    """
    k, grown = chains.log_probs.shape[1], segment.log_probs.shape[1]
    again = torch.arange(k, device=segment.z.device).repeat_interleave(grown // k)
    return Chains(
        states=torch.cat([chains.states[:, again], segment.states], dim=2),
        actions=torch.cat([chains.actions[:, again], segment.actions], dim=2),
        log_probs=chains.log_probs[:, again] + segment.log_probs,
        z=segment.z,
    )


def prune(chains: Chains, keep: int) -> Chains:
    """The most probable chains, most probable first, with probabilities that sum to one again."""
    log_probs, rows = chains.log_probs.topk(min(keep, chains.log_probs.shape[1]), dim=1)
    return pick(chains, rows)._replace(log_probs=log_probs.log_softmax(dim=1))


def merge(chains: Chains, keep: int, scale_m: float) -> Chains:
    """A few chains, each where most of the probability lies that those before it leave.

    What a chain stands for is the probability of all chains, each weighted by a Gaussian of twice
    the mean distance between them (for two that part at a constant rate, the distance of their
    ends), with the standard deviation `scale_m`. The first one kept stands for most: it is the peak
    of the distribution over trajectories, which one chain that happens to be the most probable need
    not be near. It takes from the others what it stands for; then the next is found likewise.

    Returns:
        With the mean states and features of what runs near those kept, by the same Gaussian at half
        the scale. Their actions are still those of the chains kept: infer them anew.
    """
    at = chains.states[..., :2]
    apart_m = torch.linalg.vector_norm(at[:, :, None] - at[:, None], dim=-1).mean(dim=-1)
    near = (-0.5 * (2 * apart_m / scale_m).square()).exp()
    left = chains.log_probs.exp()
    taken = torch.zeros_like(left)
    rows, masses, shares = [], [], []
    for _ in range(min(keep, left.shape[1])):
        stands_for = (near * left[:, None]).sum(dim=-1)
        # A sum of probabilities is one at most: what is taken comes last.
        row = (stands_for - 2 * taken).argmax(dim=1, keepdim=True)
        told = near.gather(1, row[:, :, None].expand(-1, 1, near.shape[2]))[:, 0]
        own = torch.zeros_like(left).scatter(1, row, MIN_MASS)
        share = told**4 * left + own  # half the scale: the fourth power of the Gaussian
        rows.append(row)
        masses.append(stands_for.gather(1, row))
        shares.append(share / share.sum(dim=1, keepdim=True))
        left = left * (1 - told)
        taken = taken.scatter(1, row, 1.0)
    log_probs = (torch.cat(masses, dim=1) + MIN_MASS).log().log_softmax(dim=1)
    share = torch.stack(shares, dim=1)
    kept = pick(chains, torch.cat(rows, dim=1))
    turned = wrap_angle(chains.states[:, None, ..., 2] - kept.states[:, :, None, :, 2])
    heading = kept.states[..., 2] + (share[..., None] * turned).sum(dim=2)
    means = (share @ chains.states.flatten(2)).view_as(kept.states)
    states = torch.stack([means[..., 0], means[..., 1], heading, means[..., 3]], dim=-1)
    return kept._replace(states=states, log_probs=log_probs, z=share @ chains.z)


def pick(chains: Chains, rows: Int[Tensor, "n k"]) -> Chains:
    """Some chains of each target."""
    target = torch.arange(rows.shape[0], device=rows.device)[:, None]  # len() is fixed in an export
    return Chains(*(field[target, rows] for field in chains))

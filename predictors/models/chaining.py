"""Chains of segments: a long forecast is made of several segments of M modes each.

A later segment starts where a mode of the segment before ends. The chainings differ in which modes
are continued:

- `beam`: all of them; after each segment the most probable chains remain, or the merged ones.
- `full`: all of them, and every chain remains.
- `top1`: only the most probable mode (before any are merged).
- `oracle`: only the mode nearest to the label. This is the label matching of Janjoš et al. (2021)
  applied at test time; it reads the recorded future, so such a predictor is privileged.

Dimensions: n targets, k chains, m modes, t ticks, z features.
"""

from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from asp_env.errors import AspEnvError
from asp_env.geometry import wrap_angle
from predictors.models.losses import Assignment, best_mode

Chaining = Literal["beam", "top1", "full", "oracle"]
CHAININGS: tuple[Chaining, ...] = ("beam", "top1", "full", "oracle")

MIN_MASS = 1e-4
"""Probability of a merged chain whose neighbourhood has no probability left. Chosen by hand: it
keeps logarithms finite."""

MAX_CHAINS = 243
"""Largest number of chains that are predicted without selection: five segments of three modes.
Chosen by hand: it bounds memory and time, which grow with the number of modes to the power of the
number of segments."""


def segment_ticks(segment_s: float, *, horizon_s: float, dt_s: float) -> int:
    """Number of ticks of a segment.

    Args:
        segment_s: Length of a segment, seconds.
        horizon_s: Horizon, seconds; a whole number of ticks.
        dt_s: Time step, seconds.

    Raises:
        AspEnvError: A segment is no whole, positive number of ticks, or the horizon no whole number
            of segments; the message lists the lengths that fit.
    """
    horizon, segment = round(horizon_s / dt_s), segment_s / dt_s
    if segment > 0.5 and abs(segment - round(segment)) < 1e-6 and not horizon % round(segment):
        return round(segment)
    fault = f"the horizon of {horizon_s:g} s is no whole number of them"
    if segment <= 0.5 or abs(segment - round(segment)) >= 1e-6:
        fault = f"they are no whole number of ticks of {dt_s:g} s"
    fitting = ", ".join(f"{n * dt_s:g}" for n in range(1, horizon + 1) if not horizon % n)
    raise AspEnvError(
        f"ssp-asp chains segments of {segment_s:g} s, {fault}: {horizon_s:g} s can be cut into "
        f"segments of {fitting} s"
    )


class Chains(NamedTuple):
    """The forecast up to the end of a segment, and the features there."""

    states: Float[Tensor, "n k t 4"]
    actions: Float[Tensor, "n k t 2"]
    log_probs: Float[Tensor, "n k"]
    z: Float[Tensor, "n k z"]
    """Predicted features at the end of the last segment."""


def chains_to_extend(
    chains: Chains,
    chaining: Chaining,
    *,
    label: Float[Tensor, "n t 2"] | None = None,
    assignment: Assignment = "angle",
) -> Chains:
    """Selects the chains that the next segment continues.

    Args:
        chains: All chains.
        chaining: The rule.
        label: Recorded positions over the whole horizon; read by `oracle` only.
        assignment: How `oracle` matches the label.

    Returns:
        All chains, or the chosen one with probability one.
    """
    if chaining in ("beam", "full"):
        return chains
    if chaining == "oracle":
        assert label is not None
        ticks = chains.states.shape[2]
        row = best_mode(chains.states[..., :2], label[:, :ticks], assignment)
    else:
        row = chains.log_probs.argmax(dim=1)
    chosen = select(chains, row[:, None])
    return chosen._replace(log_probs=torch.zeros_like(chosen.log_probs))


def extend(chains: Chains, segment: Chains) -> Chains:
    """Appends to every chain each of the modes that were predicted for it.

    Args:
        chains: K chains of each target.
        segment: K·M rows of each target: the M modes that follow the first chain, and so on.

    Returns:
        K·M chains; their probability is the product of both.
    """
    k, extended = chains.log_probs.shape[1], segment.log_probs.shape[1]
    rows = torch.arange(k, device=segment.z.device).repeat_interleave(extended // k)
    return Chains(
        states=torch.cat([chains.states[:, rows], segment.states], dim=2),
        actions=torch.cat([chains.actions[:, rows], segment.actions], dim=2),
        log_probs=chains.log_probs[:, rows] + segment.log_probs,
        z=segment.z,
    )


def prune(chains: Chains, count: int) -> Chains:
    """Selects the most probable chains, in descending order; their probabilities sum to one."""
    log_probs, rows = chains.log_probs.topk(min(count, chains.log_probs.shape[1]), dim=1)
    return select(chains, rows)._replace(log_probs=log_probs.log_softmax(dim=1))


def merge(chains: Chains, count: int, scale_m: float) -> Chains:
    """Merges chains into a few, each with the probability of the chains near it.

    The mass of a chain is the probability of all chains, each weighted by a Gaussian of twice the
    mean distance between both (for two chains that part at a constant rate, the distance of their
    ends), with the standard deviation `scale_m`. The chain with the largest mass comes first: it is
    the peak of the distribution over trajectories, which the most probable single chain need not
    be near. Its weighted share is removed from every chain's probability, and the next chain is
    chosen likewise from what remains.

    Args:
        chains: All chains.
        count: Number of chains to choose.
        scale_m: Standard deviation of the Gaussian.

    Returns:
        The chosen chains with the mean states and features of the chains near them, weighted by the
        same Gaussian at half the scale. Their actions are those of the chosen chains and do not
        lead to the mean states: infer them anew.
    """
    positions = chains.states[..., :2]
    apart_m = torch.linalg.vector_norm(positions[:, :, None] - positions[:, None], dim=-1)
    near = (-0.5 * (2 * apart_m.mean(dim=-1) / scale_m).square()).exp()
    remaining = chains.log_probs.exp()
    taken = torch.zeros_like(remaining)
    rows, masses, weights = [], [], []
    for _ in range(min(count, remaining.shape[1])):
        mass = (near * remaining[:, None]).sum(dim=-1)
        # A mass is at most one, so chains that are taken already come last.
        row = (mass - 2 * taken).argmax(dim=1, keepdim=True)
        near_row = near.gather(1, row[:, :, None].expand(-1, 1, near.shape[2]))[:, 0]
        own = torch.zeros_like(remaining).scatter(1, row, MIN_MASS)
        weight = near_row**4 * remaining + own  # half the scale: the Gaussian to the fourth power
        rows.append(row)
        masses.append(mass.gather(1, row))
        weights.append(weight / weight.sum(dim=1, keepdim=True))
        remaining = remaining * (1 - near_row)
        taken = taken.scatter(1, row, 1.0)
    log_probs = (torch.cat(masses, dim=1) + MIN_MASS).log().log_softmax(dim=1)
    weight = torch.stack(weights, dim=1)
    chosen = select(chains, torch.cat(rows, dim=1))
    turn = wrap_angle(chains.states[:, None, ..., 2] - chosen.states[:, :, None, :, 2])
    heading = chosen.states[..., 2] + (weight[..., None] * turn).sum(dim=2)
    means = (weight @ chains.states.flatten(2)).view_as(chosen.states)
    states = torch.stack([means[..., 0], means[..., 1], heading, means[..., 3]], dim=-1)
    return chosen._replace(states=states, log_probs=log_probs, z=weight @ chains.z)


def select(chains: Chains, rows: Int[Tensor, "n k"]) -> Chains:
    """Selects chains of each target by their index."""
    target = torch.arange(rows.shape[0], device=rows.device)[:, None]  # len() is fixed in an export
    return Chains(*(field[target, rows] for field in chains))

"""Chains of segments, on two chains made by hand that three modes each follow."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from predictors.models.chaining import MIN_MASS, Chains, grow, merge, pick, prune, starts

FIRST = (0.3, 0.7)
"""Probabilities of the modes of the first segment."""

THEN = ((0.2, 0.5, 0.3), (0.6, 0.1, 0.3))
"""Of the modes that follow each of them."""


def line(end: float, angle_deg: float, ticks: int = 2) -> torch.Tensor:
    """States on the way from the agent to a point."""
    angle = math.radians(angle_deg)
    share = torch.arange(1, ticks + 1) / ticks
    x, y = share * end * math.cos(angle), share * end * math.sin(angle)
    return torch.stack([x, y, torch.full_like(x, angle), torch.full_like(x, end)], dim=-1)


def chains_of(states: list[torch.Tensor], probabilities: list[float], number: float) -> Chains:
    """Chains of one target; actions and features hold the number of their row."""
    rows = torch.arange(float(len(states))) + number
    return Chains(
        states=torch.stack(states)[None],
        actions=rows[None, :, None, None].repeat(1, 1, states[0].shape[0], 2),
        log_probs=torch.tensor([probabilities]).log(),
        z=rows[None, :, None],
    )


@pytest.fixture
def first() -> Chains:
    """Straight on for 10 m with 0.3, or to the left for 8 m with 0.7."""
    return chains_of([line(10, 0), line(8, 40)], list(FIRST), 0)


@pytest.fixture
def second() -> Chains:
    """Three modes after each, in rows numbered from 10 on."""
    return chains_of([line(20 + k, 0) for k in range(6)], [p for row in THEN for p in row], 10)


def probabilities(chains: Chains) -> list[float]:
    """Of the only target's chains."""
    return chains.log_probs[0].exp().tolist()


def test_full_is_every_pair_with_its_product(first: Chains, second: Chains) -> None:
    """Six chains of 4 ticks with p·p', which sum to one, in the order of the first segment."""
    grown = grow(starts(first, "full"), second)
    products = [p * then for p, row in zip(FIRST, THEN, strict=True) for then in row]
    assert probabilities(grown) == pytest.approx(products)
    assert sum(probabilities(grown)) == pytest.approx(1)
    assert grown.states.shape == (1, 6, 4, 4)
    for row in range(6):
        assert torch.equal(grown.states[0, row, :2], first.states[0, row // 3])
        assert torch.equal(grown.states[0, row, 2:], second.states[0, row])
        assert grown.actions[0, row, :, 0].tolist() == [row // 3, row // 3, row + 10, row + 10]
    assert torch.equal(grown.z, second.z)


def test_beam_keeps_the_most_probable_of_full(first: Chains, second: Chains) -> None:
    """Of .06 .15 .09 .42 .07 .21 the three: .42, .21 and .15, over their sum of .78."""
    kept = prune(grow(starts(first, "beam"), second), 3)
    assert probabilities(kept) == pytest.approx([0.42 / 0.78, 0.21 / 0.78, 0.15 / 0.78])
    assert kept.z[0, :, 0].tolist() == [13, 15, 11]
    assert kept.actions[0, :, 0, 0].tolist() == [1, 1, 0]
    assert torch.equal(kept.states[0, 0, 2:], second.states[0, 3])


def test_beam_of_fewer_chains_keeps_them_all(first: Chains) -> None:
    """Two chains with room for three: both, the more probable one first."""
    kept = prune(first, 3)
    assert probabilities(kept) == pytest.approx([0.7, 0.3])
    assert kept.z[0, :, 0].tolist() == [1, 0]


def test_top1_goes_on_from_the_most_probable(first: Chains, second: Chains) -> None:
    """From the mode of 0.7, and the probabilities are those of the last segment alone."""
    begun = starts(first, "top1")
    assert begun.z.tolist() == [[[1.0]]]
    assert torch.equal(begun.states[0, 0], first.states[0, 1])
    grown = grow(begun, pick(second, torch.tensor([[3, 4, 5]])))
    assert probabilities(grown) == pytest.approx(THEN[1])
    assert grown.actions[0, :, 0, 0].tolist() == [1, 1, 1]


@pytest.mark.parametrize(("angle", "row"), [(1.0, 0), (38.0, 1)])
def test_oracle_goes_on_from_the_mode_of_the_label(first: Chains, angle: float, row: int) -> None:
    """A label straight on takes the first mode although it is improbable; to the left the second.

    Only the label's ticks of the first segment count: it ends elsewhere.
    """
    label = torch.cat([line(9, angle), line(50, -angle)])[None, :, :2]
    begun = starts(first, "oracle", label=label)
    assert begun.z.tolist() == [[[float(row)]]]
    assert begun.log_probs.tolist() == [[0.0]]


def test_oracle_matches_as_the_losses_do(first: Chains) -> None:
    """A label of 6.2 m at 1°: within 5° it is the straight mode, by distance the other one."""
    bent = first._replace(states=torch.stack([line(10, 0), line(6, 12)])[None])
    label = line(6.2, 1)[None, :, :2]
    by_angle = starts(bent, "oracle", label=label, assignment="angle")
    by_distance = starts(bent, "oracle", label=label, assignment="distance")
    assert by_angle.z.tolist() == [[[0.0]]]
    assert by_distance.z.tolist() == [[[1.0]]]


def test_targets_are_chained_apart(first: Chains) -> None:
    """Two targets with opposite probabilities go on from different modes."""
    both = Chains(*(torch.cat([field, field]) for field in first))
    both = both._replace(log_probs=torch.tensor([FIRST, FIRST[::-1]]).log())
    assert starts(both, "top1").z[:, 0, 0].tolist() == [1, 0]
    assert prune(both, 1).z[:, 0, 0].tolist() == [1, 0]


def ending_at(places: list[float], probabilities: list[float]) -> Chains:
    """Chains of one target that end at (x, 0); actions and features hold the number of a row."""
    states = torch.zeros(1, len(places), 2, 4)
    states[0, :, -1, 0] = torch.tensor(places)
    rows = torch.arange(float(len(places)))[None, :, None]
    return Chains(
        states, rows[..., None].repeat(1, 1, 2, 2), torch.tensor([probabilities]).log(), rows
    )


def rows_of(kept: Chains) -> list[int]:
    """Which chains of one target were kept."""
    return kept.actions[0, :, 0, 0].long().tolist()


HALF_M = math.sqrt(2 / math.log(2))
"""At this scale, two that end 2 m apart are half alike: exp(-2² / (2 scale²)); 4 m, a sixteenth."""


def test_the_first_chain_is_the_peak_of_the_distribution() -> None:
    """Ends at 0, 2, 4 m with 0.4, 0.35, 0.25, halved by 2 m, a sixteenth at 4 m: by hand.

    They stand for 0.590625, 0.675 and 0.45, so the one between comes first. It leaves 0.2 and
    0.125, of which the first stands for 0.2 + 0.125/16; the last keeps 15/16 of its 0.125.
    """
    kept = merge(ending_at([0.0, 2.0, 4.0], [0.4, 0.35, 0.25]), 3, HALF_M)
    assert rows_of(kept) == [1, 0, 2]
    np.testing.assert_allclose(
        kept.log_probs.exp()[0], [0.675, 0.2078125, 0.1171875], atol=2 * MIN_MASS
    )


def test_what_is_kept_is_the_mean_of_what_runs_near() -> None:
    """At half the scale, 2 m away is a sixteenth: (0.35 · 2 + 0.25/16 · 4) / 0.390625 = 1.952 m.

    Its features are 0.976 likewise. The others stand alone with what is left, headings and speeds
    of two alike ones are half-way between, across the turn from π to -π too.
    """
    kept = merge(ending_at([0.0, 2.0, 4.0], [0.4, 0.35, 0.25]), 3, HALF_M)
    np.testing.assert_allclose(kept.states[0, :, -1, 0], [1.952, 0.0, 4.0], atol=1e-3)
    np.testing.assert_allclose(kept.z[0, :, 0], [0.976, 0.0, 2.0], atol=1e-3)
    alike = ending_at([0.0, 0.0], [0.5, 0.5])
    alike.states[0, :, -1, 2] = torch.tensor([math.pi - 0.1, 0.3 - math.pi])
    alike.states[0, :, -1, 3] = torch.tensor([4.0, 6.0])
    first = merge(alike, 1, HALF_M).states[0, 0, -1]
    np.testing.assert_allclose(first[2:], [math.pi + 0.1, 5.0], atol=1e-3)


def test_chains_are_compared_along_their_way() -> None:
    """Two that end together but run 4 m apart before are not one; a third one's end decides not."""
    states = torch.zeros(1, 3, 2, 4)
    states[0, 1, 0, 1] = 4.0
    states[0, 2, :, 0] = 50.0
    chains = ending_at([0.0, 0.0, 50.0], [0.3, 0.3, 0.4])._replace(states=states)
    kept = merge(chains, 3, HALF_M)
    assert rows_of(kept) == [2, 0, 1]
    np.testing.assert_allclose(
        kept.log_probs.exp()[0], [0.4, 0.3 + 0.3 / 16, 0.3 * 15 / 16], atol=2 * MIN_MASS
    )


def test_merging_keeps_as_many_as_asked() -> None:
    """Where all run together the others follow, with next to none left to them."""
    kept = merge(ending_at([0.0, 0.01, 0.02, 0.03], [0.1, 0.2, 0.4, 0.3]), 3, 1.0)
    assert rows_of(kept)[0] == 2
    assert kept.states[0, 0, -1, 0].item() == pytest.approx(0.019, abs=1e-4)
    probabilities = kept.log_probs.exp()[0]
    assert float(probabilities[0]) > 0.999
    assert float(probabilities.sum()) == pytest.approx(1, abs=1e-6)


@given(st.integers(0, 10_000), st.integers(1, 6), st.integers(1, 7))
def test_merged_chains_are_among_the_chains(seed: int, count: int, keep: int) -> None:
    """None is kept twice, the first stands for most, and all sum to one; means lie between."""
    rng = np.random.default_rng(seed)
    probabilities, places = rng.dirichlet(np.ones(count)), rng.uniform(0, 5, count)
    kept = merge(ending_at(places.tolist(), probabilities.tolist()), keep, 1.0)
    rows = rows_of(kept)
    assert len(rows) == len(set(rows)) == min(keep, count)
    assert float(kept.log_probs.exp().sum()) == pytest.approx(1, abs=1e-5)
    assert int(kept.log_probs[0].argmax()) == 0
    assert float(kept.log_probs[0, 0]) >= np.log(probabilities.max()) - 1e-2
    ends = kept.states[0, :, -1, 0]
    assert places.min() - 1e-4 <= float(ends.min()) <= float(ends.max()) <= places.max() + 1e-4


@given(st.integers(0, 10_000), st.integers(1, 6))
def test_merging_does_not_read_the_order(seed: int, count: int) -> None:
    """The same chains in another order are merged into the same ones, in the same order."""
    rng = np.random.default_rng(seed)
    chains = ending_at(rng.uniform(0, 5, count).tolist(), rng.dirichlet(np.ones(count)).tolist())
    order = torch.from_numpy(rng.permutation(count))[None]
    kept, again = merge(chains, 3, 1.0), merge(pick(chains, order), 3, 1.0)
    assert rows_of(kept) == rows_of(again)
    torch.testing.assert_close(kept.states, again.states)
    torch.testing.assert_close(kept.log_probs, again.log_probs)

"""Chains of segments: two chains made by hand, each followed by three modes."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from asp_env.errors import AspEnvError
from predictors.models.chaining import (
    MIN_MASS,
    Chains,
    chains_to_extend,
    extend,
    merge,
    prune,
    segment_ticks,
    select,
)

FIRST = (0.3, 0.7)
"""Probabilities of the modes of the first segment."""

THEN = ((0.2, 0.5, 0.3), (0.6, 0.1, 0.3))
"""Probabilities of the modes of the second segment, after each of the first."""


def line(end: float, angle_deg: float, ticks: int = 2) -> torch.Tensor:
    """States on the line from the target to a point."""
    angle = math.radians(angle_deg)
    share = torch.arange(1, ticks + 1) / ticks
    x, y = share * end * math.cos(angle), share * end * math.sin(angle)
    return torch.stack([x, y, torch.full_like(x, angle), torch.full_like(x, end)], dim=-1)


def chains_of(states: list[torch.Tensor], probabilities: list[float], number: float) -> Chains:
    """Chains of one target; actions and features hold the index of their row plus a number."""
    rows = torch.arange(float(len(states))) + number
    return Chains(
        states=torch.stack(states)[None],
        actions=rows[None, :, None, None].repeat(1, 1, states[0].shape[0], 2),
        log_probs=torch.tensor([probabilities]).log(),
        z=rows[None, :, None],
    )


@pytest.fixture
def first() -> Chains:
    """Straight for 10 m with probability 0.3, or to the left for 8 m with 0.7."""
    return chains_of([line(10, 0), line(8, 40)], list(FIRST), 0)


@pytest.fixture
def second() -> Chains:
    """Three modes after each chain of `first`; rows are numbered from 10 on."""
    return chains_of([line(20 + k, 0) for k in range(6)], [p for row in THEN for p in row], 10)


def probabilities(chains: Chains) -> list[float]:
    """Probabilities of the target's chains."""
    return chains.log_probs[0].exp().tolist()


@pytest.mark.parametrize(
    ("segment_s", "horizon_s", "dt_s", "ticks"),
    [(1.0, 3.0, 0.2, 5), (3.0, 3.0, 0.2, 15), (0.2, 3.0, 0.2, 1), (0.6, 6.0, 0.1, 6)],
)
def test_segment_ticks(segment_s: float, horizon_s: float, dt_s: float, ticks: int) -> None:
    assert segment_ticks(segment_s, horizon_s=horizon_s, dt_s=dt_s) == ticks


@pytest.mark.parametrize(
    ("segment_s", "fault"),
    [
        (2.0, "the horizon of 3 s is no whole number of them"),
        (0.5, "they are no whole number of ticks of 0.2 s"),
        (0.7, "they are no whole number of ticks of 0.2 s"),
        (0.1, "they are no whole number of ticks of 0.2 s"),
        (0.0, "they are no whole number of ticks of 0.2 s"),
        (-1.0, "they are no whole number of ticks of 0.2 s"),
    ],
)
def test_segments_that_do_not_fit_name_those_that_do(segment_s: float, fault: str) -> None:
    """Of 15 ticks of 0.2 s, segments may have 1, 3, 5 or 15."""
    with pytest.raises(AspEnvError) as caught:
        segment_ticks(segment_s, horizon_s=3.0, dt_s=0.2)
    assert str(caught.value) == (
        f"ssp-asp chains segments of {segment_s:g} s, {fault}: 3 s can be cut into segments of "
        "0.2, 0.6, 1, 3 s"
    )


def test_full_has_every_pair_with_the_product(first: Chains, second: Chains) -> None:
    """Six chains of 4 ticks with probabilities p·p', which sum to one, in the order of `first`."""
    extended = extend(chains_to_extend(first, "full"), second)
    products = [p * then for p, row in zip(FIRST, THEN, strict=True) for then in row]
    assert probabilities(extended) == pytest.approx(products)
    assert sum(probabilities(extended)) == pytest.approx(1)
    assert extended.states.shape == (1, 6, 4, 4)
    for row in range(6):
        assert torch.equal(extended.states[0, row, :2], first.states[0, row // 3])
        assert torch.equal(extended.states[0, row, 2:], second.states[0, row])
        assert extended.actions[0, row, :, 0].tolist() == [row // 3, row // 3, row + 10, row + 10]
    assert torch.equal(extended.z, second.z)


def test_beam_has_the_most_probable_chains_of_full(first: Chains, second: Chains) -> None:
    """Of .06 .15 .09 .42 .07 .21 the three highest, .42, .21 and .15, over their sum of .78."""
    reduced = prune(extend(chains_to_extend(first, "beam"), second), 3)
    assert probabilities(reduced) == pytest.approx([0.42 / 0.78, 0.21 / 0.78, 0.15 / 0.78])
    assert reduced.z[0, :, 0].tolist() == [13, 15, 11]
    assert reduced.actions[0, :, 0, 0].tolist() == [1, 1, 0]
    assert torch.equal(reduced.states[0, 0, 2:], second.states[0, 3])


def test_beam_of_few_chains_has_all_of_them(first: Chains) -> None:
    """Two chains where three are allowed: both, in descending order."""
    reduced = prune(first, 3)
    assert probabilities(reduced) == pytest.approx([0.7, 0.3])
    assert reduced.z[0, :, 0].tolist() == [1, 0]


def test_top1_continues_the_most_probable_mode(first: Chains, second: Chains) -> None:
    """It continues the mode of 0.7; the probabilities are those of the last segment."""
    chosen = chains_to_extend(first, "top1")
    assert chosen.z.tolist() == [[[1.0]]]
    assert torch.equal(chosen.states[0, 0], first.states[0, 1])
    extended = extend(chosen, select(second, torch.tensor([[3, 4, 5]])))
    assert probabilities(extended) == pytest.approx(THEN[1])
    assert extended.actions[0, :, 0, 0].tolist() == [1, 1, 1]


@pytest.mark.parametrize(("angle", "row"), [(1.0, 0), (38.0, 1)])
def test_oracle_continues_the_mode_of_the_label(first: Chains, angle: float, row: int) -> None:
    """A straight label takes the first mode, although it is improbable; one to the left the second.

    Only the ticks of the first segment count: the label ends elsewhere.
    """
    label = torch.cat([line(9, angle), line(50, -angle)])[None, :, :2]
    chosen = chains_to_extend(first, "oracle", label=label)
    assert chosen.z.tolist() == [[[float(row)]]]
    assert chosen.log_probs.tolist() == [[0.0]]


def test_oracle_matches_labels_as_the_losses_do(first: Chains) -> None:
    """A label of 6.2 m at 1° is matched to the straight mode by angle, to the other by distance."""
    bent = first._replace(states=torch.stack([line(10, 0), line(6, 12)])[None])
    label = line(6.2, 1)[None, :, :2]
    by_angle = chains_to_extend(bent, "oracle", label=label, assignment="angle")
    by_distance = chains_to_extend(bent, "oracle", label=label, assignment="distance")
    assert by_angle.z.tolist() == [[[0.0]]]
    assert by_distance.z.tolist() == [[[1.0]]]


def test_targets_are_chained_independently(first: Chains) -> None:
    """Two targets with opposite probabilities continue different modes."""
    both = Chains(*(torch.cat([field, field]) for field in first))
    both = both._replace(log_probs=torch.tensor([FIRST, FIRST[::-1]]).log())
    assert chains_to_extend(both, "top1").z[:, 0, 0].tolist() == [1, 0]
    assert prune(both, 1).z[:, 0, 0].tolist() == [1, 0]


def ending_at(ends_m: list[float], probabilities: list[float]) -> Chains:
    """Chains of one target that end at (x, 0); actions and features hold the index of the row."""
    states = torch.zeros(1, len(ends_m), 2, 4)
    states[0, :, -1, 0] = torch.tensor(ends_m)
    rows = torch.arange(float(len(ends_m)))[None, :, None]
    return Chains(
        states, rows[..., None].repeat(1, 1, 2, 2), torch.tensor([probabilities]).log(), rows
    )


def rows_of(reduced: Chains) -> list[int]:
    """Rows of the chosen chains of the target."""
    return reduced.actions[0, :, 0, 0].long().tolist()


HALF_M = math.sqrt(2 / math.log(2))
"""Scale at which the weight of a chain that ends 2 m away is exp(-2² / (2 scale²)) = 1/2, and 1/16
at 4 m."""


def test_the_first_chain_is_the_peak_of_the_distribution() -> None:
    """Ends at 0, 2, 4 m with probabilities 0.4, 0.35, 0.25; weights 1/2 at 2 m, 1/16 at 4 m.

    Their masses are 0.590625, 0.675 and 0.45, so the middle one comes first. It leaves 0.2 and
    0.125, of which the first has the mass 0.2 + 0.125/16; the last retains 15/16 of its 0.125.
    """
    reduced = merge(ending_at([0.0, 2.0, 4.0], [0.4, 0.35, 0.25]), 3, HALF_M)
    assert rows_of(reduced) == [1, 0, 2]
    np.testing.assert_allclose(
        reduced.log_probs.exp()[0], [0.675, 0.2078125, 0.1171875], atol=2 * MIN_MASS
    )


def test_merged_states_are_means_of_the_chains_nearby() -> None:
    """At half the scale, the weight at 2 m is 1/16: (0.35·2 + 0.25/16·4) / 0.390625 = 1.952 m.

    The features are 0.976 likewise; no probability is left near the other two. Headings and speeds
    of two equal chains are half-way between, also across π.
    """
    reduced = merge(ending_at([0.0, 2.0, 4.0], [0.4, 0.35, 0.25]), 3, HALF_M)
    np.testing.assert_allclose(reduced.states[0, :, -1, 0], [1.952, 0.0, 4.0], atol=1e-3)
    np.testing.assert_allclose(reduced.z[0, :, 0], [0.976, 0.0, 2.0], atol=1e-3)
    equal = ending_at([0.0, 0.0], [0.5, 0.5])
    equal.states[0, :, -1, 2] = torch.tensor([math.pi - 0.1, 0.3 - math.pi])
    equal.states[0, :, -1, 3] = torch.tensor([4.0, 6.0])
    first = merge(equal, 1, HALF_M).states[0, 0, -1]
    np.testing.assert_allclose(first[2:], [math.pi + 0.1, 5.0], atol=1e-3)


def test_chains_are_compared_at_all_ticks() -> None:
    """Two chains with the same end, 4 m apart before, are not merged into one."""
    states = torch.zeros(1, 3, 2, 4)
    states[0, 1, 0, 1] = 4.0
    states[0, 2, :, 0] = 50.0
    chains = ending_at([0.0, 0.0, 50.0], [0.3, 0.3, 0.4])._replace(states=states)
    reduced = merge(chains, 3, HALF_M)
    assert rows_of(reduced) == [2, 0, 1]
    np.testing.assert_allclose(
        reduced.log_probs.exp()[0], [0.4, 0.3 + 0.3 / 16, 0.3 * 15 / 16], atol=2 * MIN_MASS
    )


def test_merging_returns_the_requested_number() -> None:
    """If all chains are near each other, the further ones have almost no probability."""
    reduced = merge(ending_at([0.0, 0.01, 0.02, 0.03], [0.1, 0.2, 0.4, 0.3]), 3, 1.0)
    assert rows_of(reduced)[0] == 2
    assert reduced.states[0, 0, -1, 0].item() == pytest.approx(0.019, abs=1e-4)
    probabilities = reduced.log_probs.exp()[0]
    assert float(probabilities[0]) > 0.999
    assert float(probabilities.sum()) == pytest.approx(1, abs=1e-6)


def test_targets_are_merged_independently() -> None:
    """The results for two targets together are those for each alone."""
    one = ending_at([0.0, 2.0, 4.0], [0.4, 0.35, 0.25])
    other = ending_at([7.0, 1.0, 1.5], [0.5, 0.3, 0.2])
    both = merge(Chains(*(torch.cat(pair) for pair in zip(one, other, strict=True))), 2, HALF_M)
    for number, chains in enumerate((one, other)):
        alone = merge(chains, 2, HALF_M)
        for found, expected in zip(both, alone, strict=True):
            torch.testing.assert_close(found[number], expected[0])


@given(st.integers(0, 10_000), st.integers(1, 6), st.integers(1, 7))
def test_merged_chains_are_among_the_chains(seed: int, count: int, limit: int) -> None:
    """Rows differ, the first has the largest mass, probabilities sum to one, means are between."""
    rng = np.random.default_rng(seed)
    probabilities, ends_m = rng.dirichlet(np.ones(count)), rng.uniform(0, 5, count)
    reduced = merge(ending_at(ends_m.tolist(), probabilities.tolist()), limit, 1.0)
    rows = rows_of(reduced)
    assert len(rows) == len(set(rows)) == min(limit, count)
    assert float(reduced.log_probs.exp().sum()) == pytest.approx(1, abs=1e-5)
    assert int(reduced.log_probs[0].argmax()) == 0
    assert float(reduced.log_probs[0, 0]) >= np.log(probabilities.max()) - 1e-2
    ends = reduced.states[0, :, -1, 0]
    assert ends_m.min() - 1e-4 <= float(ends.min()) <= float(ends.max()) <= ends_m.max() + 1e-4


@given(st.integers(0, 10_000), st.integers(1, 6))
def test_the_order_of_chains_has_no_influence(seed: int, count: int) -> None:
    """The same chains in another order have the same result."""
    rng = np.random.default_rng(seed)
    chains = ending_at(rng.uniform(0, 5, count).tolist(), rng.dirichlet(np.ones(count)).tolist())
    order = torch.from_numpy(rng.permutation(count))[None]
    reduced, again = merge(chains, 3, 1.0), merge(select(chains, order), 3, 1.0)
    assert rows_of(reduced) == rows_of(again)
    torch.testing.assert_close(reduced.states, again.states)
    torch.testing.assert_close(reduced.log_probs, again.log_probs)

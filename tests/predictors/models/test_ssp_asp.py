"""SSP-ASP: chains of segments at 6 s, merging, and that training chains as inference does."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from asp_env.dynamics import clip_actions, rollout
from asp_env.errors import AspEnvError
from asp_env.geometry import states_to_frame
from predictors.inference.checkpoint import load_trained
from predictors.models.batch import Batch, Labels, VectorTensors
from predictors.models.chaining import Chains, merge
from predictors.models.losses import best_mode, into_frame, mode_terms
from predictors.models.network import Modes, TrainingProgress, start_states
from predictors.models.ssp_asp import SegmentInput, SSPASPConfig, SSPASPNetwork
from predictors.plugs import SSPASP
from tests.predictors.tiny import (
    RANGE,
    draw_samples,
    make_network,
    save_random,
    tiny_network,
    tiny_shape,
)

ROWS = (3, 8, 20, 30, 41, 55)
END = TrainingProgress(share=1.0)


def ssp(*, horizon: int = 30, seed: int = 0, **changes: Any) -> SSPASPNetwork:
    """A tiny network for vectors with distinct modes, assigned by angle."""
    changes = {"assignment": "angle", **changes}
    config = tiny_network("ssp-asp", "vectors", gru_width=16, **changes)
    network = make_network("ssp-asp", config, tiny_shape("vectors", horizon), seed=seed)
    assert isinstance(network, SSPASPNetwork)
    with torch.no_grad():  # modes and probabilities differ more
        if network.head is not None:
            network.head.layers[-1].get_parameter("weight").mul_(8)
    return network


@pytest.fixture(scope="module")
def sample() -> tuple[Batch, Labels]:
    """Six snippets of 6 s with the inputs at 3 s and 6 s."""
    return draw_samples(ROWS, view="vectors", horizon_s=6.0, later_ticks=(15, 30))


def chained(sample: tuple[Batch, Labels], chaining: Any, **changes: Any) -> Modes:
    """The modes of `ssp(**changes)` with a chaining."""
    with torch.no_grad():
        return ssp(**changes).chain(sample[0], chaining, sample[1].states[..., :2])


def first_segment_probabilities(full: Modes) -> torch.Tensor:
    """Probabilities (n, 3) of the first segment's modes, from all nine chains."""
    return full.logits.exp().unflatten(1, (3, 3)).sum(dim=2)


def test_full_has_all_chains(sample: tuple[Batch, Labels]) -> None:
    """Nine chains of 30 ticks, three for each mode of the first segment, with probability one."""
    full = chained(sample, "full")
    assert full.states.shape == (6, 9, 30, 4)
    torch.testing.assert_close(full.logits.exp().sum(dim=1), torch.ones(6))
    firsts = full.states[:, :, :15].unflatten(1, (3, 3))
    assert torch.equal(firsts, firsts[:, :, :1].expand_as(firsts))
    assert float((firsts[:, 0, 0] - firsts[:, 1, 0]).abs().max()) > 0.1
    three_segments = chained(sample, "full", horizon=45)
    assert three_segments.states.shape == (6, 27, 45, 4)
    torch.testing.assert_close(three_segments.logits.exp().sum(dim=1), torch.ones(6))


def test_first_segment_is_the_forecast_of_3_s(sample: tuple[Batch, Labels]) -> None:
    """The same weights with a horizon of 3 s forecast the first half of `full`."""
    full, short = chained(sample, "full"), chained(sample, "beam", horizon=15)
    torch.testing.assert_close(full.states[:, ::3, :15], short.states)
    torch.testing.assert_close(first_segment_probabilities(full), short.logits.exp())


def test_beam_has_the_most_probable_chains_of_full(sample: tuple[Batch, Labels]) -> None:
    """Its three chains are the most probable of nine; their probabilities sum to one."""
    full, beam = chained(sample, "full"), chained(sample, "beam")
    top, rows = full.logits.exp().topk(3, dim=1)
    torch.testing.assert_close(beam.logits.exp(), top / top.sum(dim=1, keepdim=True))
    torch.testing.assert_close(beam.states, full.states[torch.arange(6)[:, None], rows])
    with torch.no_grad():
        forecast: Modes = ssp()(sample[0])
    assert torch.equal(forecast.states, beam.states)


def merging(horizon: int, temperature: float) -> SSPASPNetwork:
    """A network that merges into three modes at a temperature."""
    network = ssp(horizon=horizon, kept=3, spread_mps=0.8)
    assert network.merging_temperature is not None
    network.merging_temperature.fill_(temperature)
    return network


@pytest.mark.parametrize("horizon", [15, 30])
@pytest.mark.parametrize("temperature", [1.0, 2.5])
def test_merged_modes_are_those_of_all_scaled_chains(
    horizon: int, temperature: float, sample: tuple[Batch, Labels]
) -> None:
    """All chains at p^(1/T), normalised, are merged by 0.8 m/s times the horizon.

    The speeds are the mean speeds, which accelerations within the limits reach.
    """
    network = merging(horizon, temperature)
    with torch.no_grad():
        full, merged = network.chain(sample[0], "full"), network(sample[0])
    scaled = (full.logits.exp() ** (1 / temperature)).log().log_softmax(dim=1)
    assert full.actions is not None
    every = Chains(full.states, full.actions, scaled, torch.zeros(*scaled.shape, 1))
    expected = merge(every, 3, 0.8 * 0.2 * horizon)
    torch.testing.assert_close(merged.logits, expected.log_probs)
    np.testing.assert_allclose(merged.states[..., 3], expected.states[..., 3], atol=1e-3)


@pytest.mark.parametrize("horizon", [15, 30, 45])
def test_merged_modes_are_rollouts_of_their_actions(
    horizon: int, sample: tuple[Batch, Labels]
) -> None:
    """Three modes of one, two and three segments, to 1e-4."""
    with torch.no_grad():
        merged: Modes = merging(horizon, 2.5)(sample[0])
    assert merged.actions is not None
    assert merged.actions.shape == (6, 3, horizon, 2)
    assert torch.equal(merged.actions, clip_actions(merged.actions))
    start = torch.zeros(6, 3, 4, dtype=torch.float64)
    start[..., 3] = sample[0].motion[:, :1]
    lengths = sample[0].length_m[:, None].double()
    whole = rollout(start, merged.actions.double(), lengths, 0.2, integrator="heun")
    np.testing.assert_allclose(merged.states, whole, atol=1e-4)
    torch.testing.assert_close(merged.logits.exp().sum(dim=1), torch.ones(6))


def test_full_is_calibrated_by_the_merging_temperature(
    sample: tuple[Batch, Labels], tmp_path: Path
) -> None:
    """`RUN@full` divides by the merging temperature, `RUN@beam` by the temperature of the run."""
    run = save_random(
        tmp_path / "run", "ssp-asp", "vectors", horizon=30, preset="ours", temperature=1.7
    )
    full, beam = (load_trained(SSPASP, f"{run}@{chaining}") for chaining in ("full", "beam"))
    network = full.network
    assert isinstance(network, SSPASPNetwork)
    with torch.no_grad():
        chains, merged = (network.chain(sample[0], each) for each in ("full", "beam"))
        torch.testing.assert_close(full.modes(sample[0]).logits, chains.logits)
        scaled = (merged.logits / 1.7).log_softmax(dim=1)
        torch.testing.assert_close(beam.modes(sample[0]).logits, scaled)


def test_only_networks_that_merge_have_a_merging_temperature() -> None:
    """The paper's network has no such weight; otherwise it is 1 at first."""
    assert ssp().merging_temperature is None
    assert "merging_temperature" not in ssp().state_dict()
    assert float(ssp(kept=3).state_dict()["merging_temperature"]) == 1


@pytest.mark.parametrize("chaining", ["top1", "oracle"])
def test_top1_and_oracle_continue_one_mode(chaining: str, sample: tuple[Batch, Labels]) -> None:
    """`top1` continues the most probable first mode, `oracle` the one matched to the label.

    Probabilities are those of the last segment: p·p' of `full` over p.
    """
    full, one = chained(sample, "full"), chained(sample, chaining)
    first = first_segment_probabilities(full)
    row = first.argmax(dim=1)
    matched = best_mode(full.states[:, ::3, :15, :2], sample[1].states[:, :15, :2], "angle")
    assert row.tolist() != matched.tolist()
    if chaining == "oracle":
        row = matched
    each = torch.arange(6)
    torch.testing.assert_close(one.states, full.states.unflatten(1, (3, 3))[each, row])
    then = full.logits.exp().unflatten(1, (3, 3))[each, row] / first[each, row, None]
    torch.testing.assert_close(one.logits.exp(), then)


@pytest.mark.parametrize("integrator", ["euler", "heun"])
def test_segments_are_continuous(integrator: Any, sample: tuple[Batch, Labels]) -> None:
    """All 6 s are one rollout of the actions, to 1e-4."""
    full = chained(sample, "full", integrator=integrator)
    assert full.actions is not None
    start = torch.zeros(6, 9, 4, dtype=torch.float64)
    start[..., 3] = sample[0].motion[:, :1]
    lengths = sample[0].length_m[:, None].double()
    whole = rollout(start, full.actions.double(), lengths, 0.2, integrator=integrator)
    np.testing.assert_allclose(full.states, whole, atol=1e-4)


def test_later_inputs_are_in_the_frame_of_the_target_then(sample: tuple[Batch, Labels]) -> None:
    """After 3 s the target is at its own origin, with its speed then and the actions since now.

    The actions lead to the label's states, which are those of the later trail.
    """
    batch, labels = sample
    for number, later in enumerate(labels.later):
        end = labels.states[:, 15 * number + 14]
        torch.testing.assert_close(later.motion[:, 0], end[:, 3])
        assert isinstance(later.observation, VectorTensors)
        agents = later.observation.agents
        np.testing.assert_allclose(agents[:, 0, -1, :2], 0, atol=1e-5)
        past = labels.states[:, 15 * number : 15 * number + 15].numpy().astype(np.float64)
        local = states_to_frame(past, end[:, None].numpy().astype(np.float64))
        np.testing.assert_allclose(agents[:, 0, 1:, :2], local[..., :2], atol=1e-3)
    start = torch.zeros(6, 4)
    start[:, 3] = batch.motion[:, 0]
    driven = rollout(start, labels.later[0].actions, batch.length_m, 0.2)
    np.testing.assert_allclose(driven[..., 3], labels.states[:, :15, 3], atol=1e-3)


@pytest.mark.parametrize("chaining", ["oracle", "top1"])
def test_training_chains_as_inference_does(chaining: str, sample: tuple[Batch, Labels]) -> None:
    """The loss is that of the chains of `oracle`, each segment in the frame of the label's start.

    With scheduled sampling that holds at first; at the end the loss is that of `top1`.
    """
    batch, labels = sample
    label = labels.states[..., :2]
    scheduled = {"oracle": TrainingProgress(share=0.0), "top1": END}
    one = chained(sample, chaining, encoded_branch=False)
    short = chained(sample, "full", encoded_branch=False)
    origin = labels.states[:, 14]
    segments = (
        (short.states[:, ::3, :15, :2], first_segment_probabilities(short).log(), label[:, :15]),
        (
            into_frame(one.states[:, :, 15:, :2], origin[:, None]),
            one.logits,
            into_frame(label[:, 15:], origin),
        ),
    )
    options: Any = {"assignment": "angle", "classification": "cross-entropy", "share": None}
    expected = [mode_terms(*segment, **options) for segment in segments]
    network = ssp(encoded_branch=False, scheduled=True)
    terms = network.training_loss(batch, labels, scheduled[chaining])
    for name in ("regression", "classification"):
        mean = torch.stack([each[name] for each in expected]).mean()
        torch.testing.assert_close(terms[name], mean)
    unscheduled = ssp(encoded_branch=False).training_loss(batch, labels, END)
    assert torch.allclose(unscheduled["loss"], terms["loss"]) == (chaining == "oracle")


def test_reconstruction_of_the_past_of_each_segment(sample: tuple[Batch, Labels]) -> None:
    """If ξ returns 0, its loss is the Huber loss of the scaled actions before each segment."""
    batch, labels = sample
    network = ssp()
    with torch.no_grad():
        network.reconstructor[-1].get_parameter("weight").zero_()
        network.reconstructor[-1].get_parameter("bias").zero_()
    terms = network.training_loss(batch, labels, END)
    scaled = torch.stack([batch.actions, labels.later[0].actions]) / torch.tensor(RANGE)
    assert float(scaled.abs().max()) < 1
    torch.testing.assert_close(terms["actions"], (0.5 * scaled**2).mean())


def test_loss_is_the_weighted_sum(sample: tuple[Batch, Labels]) -> None:
    """Four terms with w1 to w4; in pre-training only the first two."""
    weights: Any = {
        "action_weight": 2.0,
        "feature_weight": 3.0,
        "regression_weight": 5.0,
        "classification_weight": 7.0,
    }
    network = ssp(**weights)
    for pretraining, names in ((False, 4), (True, 2)):
        terms = network.training_loss(*sample, TrainingProgress(share=0.0, pretraining=pretraining))
        expected = ["actions", "features", "regression", "classification"][:names]
        assert set(terms) == {"loss", *expected}
        values = {name: float(value.detach()) for name, value in terms.items()}
        by_hand = sum(w * values[n] for n, w in zip(expected, weights.values(), strict=False))
        assert values["loss"] == pytest.approx(by_hand, rel=1e-5)


@pytest.mark.parametrize("decoder", ["read", "unrolled"])
@pytest.mark.parametrize("segment_s", [1.0, 6.0])
def test_past_actions_of_a_segment_that_is_no_history(
    segment_s: float, decoder: str, sample: tuple[Batch, Labels]
) -> None:
    """γ reads the last 15 actions: of recorded ones and those of the segments before, in order.

    The modes of each segment are computed one after the other from the chain so far.
    """
    network = ssp(segment_s=segment_s, decoder=decoder, modes=1)
    batch = sample[0]
    with torch.no_grad():
        modes = network(batch)
        assert modes.actions is not None
        z, start = network.encode(batch), start_states(batch)
        done = batch.actions
        for end in network.later_ticks:
            inputs = SegmentInput(z, network.scaled_actions(done[:, -15:]), start, batch.length_m)
            z = network.predict_features(inputs)
            actions, states, _ = network.predict_actions(inputs, z)
            first = end - round(segment_s / 0.2)
            torch.testing.assert_close(modes.actions[:, :, first:end], actions)
            torch.testing.assert_close(modes.states[:, :, first:end], states)
            done, start = torch.cat([done, actions[:, 0]], dim=1), states[:, 0, -1]


def regression(positions: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """The regression term of a single mode."""
    terms = mode_terms(
        positions, torch.zeros(len(truth), 1), truth,
        assignment="angle", classification="cross-entropy", share=None,
    )  # fmt: skip
    return terms["regression"]


@pytest.mark.parametrize("decoder", ["read", "unrolled"])
def test_training_chains_segments_of_1_s_as_inference_does(decoder: str) -> None:
    """With one mode the regression in training is that of the forecast, segment by segment."""
    network = ssp(
        horizon=15, segment_s=1.0, decoder=decoder, modes=1, encoded_branch=False, skip=True
    )
    batch, labels = draw_samples(ROWS, view="vectors", later_ticks=network.later_ticks)
    assert network.later_ticks == (5, 10, 15)
    with torch.no_grad():
        terms = network.training_loss(batch, labels, END)
        positions = network(batch).states[..., :2]
    truth, expected = labels.states, []
    for first in (0, 5, 10):
        part, label = positions[:, :, first : first + 5], truth[:, first : first + 5, :2]
        if first:
            origin = truth[:, first - 1]
            part, label = into_frame(part, origin[:, None]), into_frame(label, origin)
        expected.append(regression(part, label))
    torch.testing.assert_close(terms["regression"], torch.stack(expected).mean())


def test_chains_beyond_the_limit_are_cut(sample: tuple[Batch, Labels]) -> None:
    """Six segments of three modes have 729 chains; the first five have 243."""
    with torch.no_grad():
        chains = ssp(segment_s=1.0).all_chains(sample[0])
        few = ssp(segment_s=2.0).all_chains(sample[0])
    assert chains.states.shape == (6, 243, 25, 4)
    assert few.states.shape == (6, 27, 30, 4)


def test_other_horizons_are_refused() -> None:
    with pytest.raises(AspEnvError, match=r"segments of 3 s, the horizon of 4 s is no whole"):
        ssp(horizon=20)
    assert ssp(horizon=15).later_ticks == (15,)
    assert ssp(horizon=45).later_ticks == (15, 30, 45)


@pytest.mark.parametrize("field", ["features", "modes", "gru_width", "gru_layers"])
def test_sizes_of_zero_are_refused(field: str) -> None:
    changes: Any = {field: 0}
    with pytest.raises(AspEnvError, match=f"{field} is 0, expected 1 or more"):
        dataclasses.replace(SSPASPConfig(), **changes)


def test_options_out_of_range_are_refused() -> None:
    """An `ema` of 1, or a negative hidden layer."""
    with pytest.raises(AspEnvError, match=r"ema 1\.0, expected"):
        SSPASPConfig(ema=1.0)
    with pytest.raises(AspEnvError, match="hidden is -1"):
        SSPASPConfig(hidden=-1)

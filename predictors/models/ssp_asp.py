"""SSP-ASP: self-supervised prediction in action space (Janjoš, Dolgov, Zöllner 2021).

The encoder φ maps the observation to features z. The feature predictor ψ maps z and the past
actions to the features ẑ at the end of the next segment (equation 15). The action predictor γ maps
z, ẑ and the past actions to the actions of that segment (equation 18), as a GRU in one of the two
readings of `predictors.models.heads` (`decoder`). In training the observation
at the end of the segment is encoded too (equation 16); the action reconstructor ξ maps both encoded
features to the past actions (equation 13), and γ runs on the encoded and on the predicted features.
A forecast has only the predicted ones, so validation uses those. The loss is L_SSP (equation 20);
its terms have the weights w1 (reconstruction of the past actions), w2 (mismatch of the features),
w3 (regression) and w4 (classification), in validation as in training. Longer horizons chain
segments, see `predictors.models.chaining`.

Choices that the paper leaves open: the actions of w1 are normalised, in units of the action range
(99.9th percentiles of the training data), so that acceleration and steering count alike; the future
observation is rendered in the target's pose at the end of the segment; features pass a LayerNorm
before ψ and γ; a linear layer follows ψ, since features are unbounded; the loss is the mean over
both branches and over the segments; a later segment is predicted from what is available at
inference, the predicted features and the actions of the matched mode.

In the paper the past and the segments have the same length ("the same T-step time interval for all
the past and future values", section IV-D), 3 s. Here `segment_s` may differ from the history: γ and
ψ always read the last h actions before a segment, which are recorded ones as far as the segments
before it do not reach back that far, and ξ reconstructs the last h actions before the segment. A
horizon has as many segments as fit: the whole horizon in one segment is possible, too.

Options that differ from the paper; the recipe `paper` leaves them off: `normalise`,
`stop_gradient`, `ema`, `skip`, `hidden`, `scheduled`, `annealed`, `kept`, and, for an ablation,
`encoded_branch`.

Dimensions: n targets, m modes, k chains, h past ticks, t ticks of a segment, z features.
"""

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from asp_env.dynamics import clip_actions, inverse
from asp_env.dynamics.bicycle import Integrator
from asp_env.errors import AspEnvError
from predictors.models.batch import Batch, Labels
from predictors.models.chaining import (
    MAX_CHAINS,
    Chaining,
    Chains,
    chains_to_extend,
    extend,
    merge,
    prune,
    segment_ticks,
)
from predictors.models.encoders import make_encoder
from predictors.models.heads import ConnectedHead, Decoder, RecurrentReader, UnrolledDecoder
from predictors.models.losses import (
    HUBER_M,
    best_mode,
    into_frame,
    mode_terms,
    standing_loss,
    stands,
)
from predictors.models.network import (
    AbstractNetwork,
    Features,
    Modes,
    NetworkConfig,
    NetworkShape,
    TrainingProgress,
    Validation,
    rollout_from,
    rollout_from_now,
    start_states,
)

RECONSTRUCTOR = (256, 128, 64)
"""Widths of the hidden layers of ξ, those of the paper."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SSPASPConfig(NetworkConfig):
    """Options of SSP-ASP; the defaults are the paper's."""

    segment_s: float = 3.0
    """Length of the segments that are chained, seconds; 3 s in the paper."""
    decoder: Decoder = "read"
    """How γ makes actions, see `heads.Decoder`."""
    gru_width: int = 512
    gru_layers: int = 2
    skip: bool = False
    """Whether the features, the present speed and the past actions also reach γ's output."""
    hidden: int = 0
    """Width of a hidden layer before γ's output; 0 for none, as in the paper."""
    integrator: Integrator = "euler"
    normalise: bool = False
    """Whether features are normalised at the output of φ and ψ."""
    stop_gradient: bool = False
    """Whether no gradient of the feature mismatch reaches the encoded features of the next
    segment."""
    ema: float = 0.0
    """Decay, such as 0.99, of a second encoder that encodes the targets of ψ; its weights are the
    exponential moving average of φ's. 0 for none."""
    encoded_branch: bool = True
    """Whether γ is also trained on the encoded features of the next segment."""
    scheduled: bool = False
    """Whether, in training, a growing share of the later segments continues the most probable mode
    instead of the one matched to the label."""
    kept: int = 0
    """Number of modes that a forecast is merged into, see `chaining.merge`. 0 merges none: all
    modes of one segment, or the most probable chains of a beam."""
    spread_mps: float = 0.4
    """Standard deviation of the merging per second ahead, m/s."""
    action_weight: float = 1.0
    """w1, weight of the reconstruction of the past actions, in units of the action range."""
    feature_weight: float = 1.0
    """w2, weight of the mismatch of features."""
    regression_weight: float = 1.0
    """w3, weight of the regression of the best mode."""
    classification_weight: float = 1.0
    """w4, weight of the classification."""

    def __post_init__(self) -> None:
        """Checks the sizes.

        Raises:
            AspEnvError: A size is not positive, `kept` is negative, or `ema` is not in [0, 1).
        """
        self.check_positive("features", "modes", "gru_width", "gru_layers")
        if self.kept < 0 or not self.spread_mps > 0:
            raise AspEnvError(
                f"network: kept is {self.kept} and spread_mps {self.spread_mps}, expected 0 or "
                "more and a positive number"
            )
        if self.hidden < 0 or not 0 <= self.ema < 1:
            raise AspEnvError(
                f"network: hidden is {self.hidden} and ema {self.ema}, expected 0 or more and "
                "within [0, 1)"
            )


class SegmentInput(NamedTuple):
    """Inputs of the prediction of one segment."""

    z: Float[Tensor, "n z"]
    """Features at the start of the segment."""
    past: Float[Tensor, "n h 2"]
    """The last actions before the segment, in units of the action range."""
    start: Float[Tensor, "n 4"]
    """State at the start of the segment, in the target's frame now."""
    length_m: Float[Tensor, " n"]


@final
class SSPASPNetwork(AbstractNetwork):
    """φ (`encoder`), ψ (`forward_*`), ξ (`reconstructor`), γ and the bicycle model.

    γ is `reader` and `head`, or `decoder` if it is unrolled.

    φ maps the observation to z (n, z); ψ maps z and the past actions (n, h, 2) to ẑ (n, z); γ maps
    [z, ẑ] (n, 2z) and the past actions to actions (n, m, t, 2) and logits (n, m); ξ maps two
    encoded features (n, 2z) to the past actions (n, h, 2).
    """

    def __init__(self, config: SSPASPConfig, shape: NetworkShape) -> None:
        """Initialises the weights at random.

        Raises:
            AspEnvError: The horizon is not a whole number of segments, or a segment not one of
                ticks.
        """
        super().__init__(config, shape)
        self._options = config
        self._segment_ticks = segment_ticks(
            config.segment_s, horizon_s=shape.horizon * shape.dt_s, dt_s=shape.dt_s
        )
        z, width = config.features, config.gru_width
        self.encoder = make_encoder(config.encoder, shape, z)
        self.target_encoder = copy.deepcopy(self.encoder) if config.ema else None
        if self.target_encoder is not None:
            self.target_encoder.requires_grad_(False)
        self.norm = nn.LayerNorm(z)
        self.forward_reader = RecurrentReader(z, width, config.gru_layers)
        self.forward_head = nn.Linear(width, z)
        layers: list[nn.Module] = []
        for before, after in zip((2 * z, *RECONSTRUCTOR), RECONSTRUCTOR, strict=False):
            layers += [nn.Linear(before, after), nn.ReLU(inplace=True)]
        self.reconstructor = nn.Sequential(*layers, nn.Linear(RECONSTRUCTOR[-1], 2 * shape.history))
        skipped = 2 * z + 1 + 2 * shape.history if config.skip else 0
        self.reader: RecurrentReader | None = None
        self.head: ConnectedHead | None = None
        self.decoder: UnrolledDecoder | None = None
        if config.decoder == "unrolled":
            self.decoder = UnrolledDecoder(
                2 * z,
                width,
                config.gru_layers,
                modes=config.modes,
                static=skipped,
                hidden=config.hidden,
            )
        else:
            self.reader = RecurrentReader(2 * z, width, config.gru_layers)
            self.head = ConnectedHead(
                width + skipped, config.hidden, modes=config.modes, ticks=self._segment_ticks
            )
        # A weight: a run that starts from another run is validated with that run's temperature.
        self.register_buffer("merging_temperature", torch.ones(()) if config.kept else None)

    @property
    def later_ticks(self) -> tuple[int, ...]:
        """The ends of all segments."""
        step = self._segment_ticks
        return tuple(range(step, self.shape.horizon + 1, step))

    @property
    def feature_size(self) -> int:
        """Number of features of z and ẑ, the latter at the end of the first segment."""
        return 2 * self.config.features

    def forward(self, batch: Batch) -> Modes:
        """Returns the modes of every target; segments are chained by beam."""
        return self.chain(batch, "beam")

    def chain(
        self, batch: Batch, chaining: Chaining, label: Float[Tensor, "n t 2"] | None = None
    ) -> Modes:
        """Returns the modes of every target; see the base class."""
        return self._chain(batch, chaining, label, segments=len(self.later_ticks))

    def all_chains(self, batch: Batch) -> Modes:
        """Returns all chains of the first segments; see the base class."""
        segments = len(self.later_ticks)
        while segments > 1 and self.config.modes**segments > MAX_CHAINS:
            segments -= 1
        return self._chain(batch, "full", None, segments=segments)

    def _chain(
        self,
        batch: Batch,
        chaining: Chaining,
        label: Float[Tensor, "n t 2"] | None,
        *,
        segments: int,
    ) -> Modes:
        """The modes over the first segments."""
        z = self.encode(batch)
        with torch.autocast(z.device.type, enabled=False):
            past = self.scaled_actions(batch.actions)
            chains = self._segment(SegmentInput(z, past, start_states(batch), batch.length_m))
            features = torch.cat([z, chains.z[:, 0]], dim=1)  # ẑ, equal for all modes
            chains = self._reduce(chains, chaining, batch)
            for _ in range(segments - 1):
                chains = chains_to_extend(
                    chains, chaining, label=label, assignment=self.config.assignment
                )
                chains = extend(chains, self._next_segment(chains, batch))
                chains = self._reduce(chains, chaining, batch)
            standing = self.standing_logit(self.norm(z), batch)
        return Modes(
            chains.states, chains.log_probs, chains.actions, features=features, standing=standing
        )

    def encode(self, batch: Batch) -> Float[Tensor, "n z"]:
        """φ: the features of the observation."""
        return self._normalised(self.encoder(batch.observation).float())

    def predict_features(self, inputs: SegmentInput) -> Float[Tensor, "n z"]:
        """ψ: the features at the end of the segment."""
        context = self.norm(inputs.z)
        return self._normalised(self.forward_head(self.forward_reader(context, inputs.past)))

    def predict_actions(
        self, inputs: SegmentInput, z_next: Float[Tensor, "n z"]
    ) -> tuple[Float[Tensor, "n m t 2"], Float[Tensor, "n m t 4"], Float[Tensor, "n m"]]:
        """γ and the bicycle model: the modes of one segment.

        Args:
            inputs: Inputs of the segment.
            z_next: Features at its end, encoded or predicted.

        Returns:
            Actions, states and logits.
        """
        context = torch.cat([self.norm(inputs.z), self.norm(z_next)], dim=-1)
        static: list[Tensor] = []
        if self._options.skip:
            speed = inputs.start[:, 3:] / self.get_buffer("motion_scale")[0]
            static = [context, inputs.past.flatten(1), speed]
        if self.decoder is not None:
            skipped = torch.cat(static, dim=-1) if static else None
            outputs, logits = self.decoder(context, inputs.past, self._segment_ticks, skipped)
        else:
            assert self.reader is not None
            assert self.head is not None
            reading = self.reader(context, inputs.past)
            outputs, logits = self.head(torch.cat([reading, *static], dim=-1))
        actions = self.bounded_actions(outputs)
        start = inputs.start[:, None].expand(-1, actions.shape[1], -1)
        states = rollout_from(
            start, actions, inputs.length_m, self.shape.dt_s, self._options.integrator
        )
        return actions, states, logits

    def training_loss(
        self, batch: Batch, labels: Labels, progress: TrainingProgress
    ) -> dict[str, Tensor]:
        """L_SSP (equation 20), mean over branches and segments; w1 and w2 only in pre-training."""
        encoded, targets = self._encode_all(batch, labels)
        with torch.autocast(batch.actions.device.type, enabled=False):
            segments = list(self._terms(batch, labels, progress, encoded, targets))
            standing = self.standing_logit(self.norm(encoded[0]), batch)
        terms = _means(segments)
        if standing is not None and not progress.pretraining:
            terms["standing"] = standing_loss(standing, labels.states)
        return self._weighted(terms)

    def validate(
        self, modes: Modes, batch: Batch, labels: Labels, progress: TrainingProgress
    ) -> Validation:
        """L_SSP (equation 20) of a forecast, and the features at the end of the first segment.

        The terms of w1 and w2 are those of the training, along the recorded actions; those of w3
        and w4, and that of the standing mode, are of the forecast and missing in pre-training.
        """
        encoded, targets = self._encode_all(batch, labels)
        of_features = progress._replace(pretraining=True)
        with torch.autocast(batch.actions.device.type, enabled=False):
            terms = _means(list(self._terms(batch, labels, of_features, encoded, targets)))
            past = self.scaled_actions(batch.actions)
            inputs = SegmentInput(encoded[0], past, start_states(batch), batch.length_m)
            features = Features(encoded[1], self.predict_features(inputs))
        if not progress.pretraining:
            of_modes = self.loss(modes, labels, progress)
            terms |= {name: value for name, value in of_modes.items() if name != "loss"}
        return Validation(self._weighted(terms), features)

    def after_step(self) -> None:
        """Updates the second encoder, if there is one: averages weights, copies buffers."""
        if self.target_encoder is None:
            return
        followers, leaders = self.target_encoder, self.encoder
        with torch.no_grad():
            for follower, leader in zip(followers.parameters(), leaders.parameters(), strict=True):
                follower.lerp_(leader, 1 - self._options.ema)
            for follower, leader in zip(followers.buffers(), leaders.buffers(), strict=True):
                follower.copy_(leader)

    def _weighted(self, terms: dict[str, Tensor]) -> dict[str, Tensor]:
        """The terms, and `loss`, their sum with the weights w1 to w4 (standing mode: 1)."""
        weights = {
            "actions": self._options.action_weight,
            "features": self._options.feature_weight,
            "regression": self._options.regression_weight,
            "classification": self._options.classification_weight,
            "standing": 1.0,
        }
        total = torch.stack([weights[name] * value for name, value in terms.items()]).sum()
        return {"loss": total, **terms}

    def _segment(self, inputs: SegmentInput) -> Chains:
        """One segment as in a forecast, on predicted features."""
        z_next = self.predict_features(inputs)
        actions, states, logits = self.predict_actions(inputs, z_next)
        z_of_modes = z_next[:, None].expand(-1, actions.shape[1], -1)
        return Chains(states, actions, logits.log_softmax(dim=1), z_of_modes)

    def _next_segment(self, chains: Chains, batch: Batch) -> Chains:
        """The segment that follows each chain, (n, k·m) rows."""
        n, k = chains.log_probs.shape
        done, history = chains.actions, self.shape.history
        if done.shape[2] < history:
            recorded = batch.actions[:, None].expand(-1, k, -1, -1)
            done = torch.cat([recorded, done], dim=2)
        inputs = SegmentInput(
            chains.z.flatten(0, 1),
            self.scaled_actions(done[:, :, -history:].flatten(0, 1)),
            chains.states[:, :, -1].flatten(0, 1),
            batch.length_m.repeat_interleave(k),
        )
        segment = self._segment(inputs)
        return Chains(*(field.unflatten(0, (n, k)).flatten(1, 2) for field in segment))

    def _reduce(self, chains: Chains, chaining: Chaining, batch: Batch) -> Chains:
        """Prunes or merges the chains after a segment, as the options and the chaining say."""
        count, ticks = chains.states.shape[1:3]
        temperature = self.merging_temperature
        if temperature is None or chaining == "full":
            too_many = count > self.config.modes
            return prune(chains, self.config.modes) if too_many and chaining == "beam" else chains
        kept, at_end = self._options.kept, ticks == self.shape.horizon
        if count <= kept and not at_end:
            return chains
        scaled = chains._replace(log_probs=(chains.log_probs / temperature).log_softmax(dim=1))
        merged = merge(scaled, kept, self._options.spread_mps * ticks * self.shape.dt_s)
        if not at_end:
            merged = merged._replace(log_probs=merged.log_probs * temperature)
        return self._drivable(merged, batch)

    def _drivable(self, chains: Chains, batch: Batch) -> Chains:
        """Replaces mean states by a rollout of the actions inferred from their headings and speeds.

        The mean features are normalised again.
        """
        dt_s, integrator = self.shape.dt_s, self._options.integrator
        start = start_states(batch)[:, None, None].expand(-1, chains.states.shape[1], 1, -1)
        before = torch.cat([start, chains.states[:, :, :-1]], dim=2)
        lengths = batch.length_m[:, None, None]
        actions = clip_actions(inverse(before, chains.states, lengths, dt_s, integrator=integrator))
        states = rollout_from_now(actions, batch, dt_s, integrator)
        z = self._normalised(chains.z.flatten(0, 1)).view_as(chains.z)
        return chains._replace(states=states, actions=actions, z=z)

    def _encode_all(self, batch: Batch, labels: Labels) -> tuple[list[Tensor], list[Tensor]]:
        """Features (n, z) now and at the end of each segment, and the targets of ψ there."""
        batches = [batch, *labels.later]
        encoded = [self.encode(each) for each in batches]
        if self.target_encoder is not None:
            with torch.no_grad():
                targets = [self.target_encoder(each.observation).float() for each in batches[1:]]
            return encoded, [self._normalised(z) for z in targets]
        return encoded, [z.detach() if self._options.stop_gradient else z for z in encoded[1:]]

    def _terms(
        self,
        batch: Batch,
        labels: Labels,
        progress: TrainingProgress,
        encoded: Sequence[Tensor],
        targets: Sequence[Tensor],
    ) -> Iterator[dict[str, Tensor]]:
        """The terms of the loss of each segment.

        Args:
            batch: Inputs.
            labels: Labels.
            progress: How far the training has come.
            encoded: Features (n, z) now and at the end of each segment.
            targets: Targets (n, z) of ψ at the end of each segment.
        """
        batches = [batch, *labels.later]
        past = [self.scaled_actions(each.actions) for each in batches]
        on_predicted = SegmentInput(encoded[0], past[0], start_states(batch), batch.length_m)
        on_encoded = on_predicted
        for number, target in enumerate(targets):
            z_next = self.predict_features(on_predicted)
            both = torch.cat([encoded[number], encoded[number + 1]], dim=-1)
            reconstructed = self.reconstructor(both).tanh().unflatten(1, (-1, 2))
            terms = {
                "actions": functional.huber_loss(reconstructed, past[number], delta=HUBER_M),
                "features": functional.huber_loss(z_next, target, delta=HUBER_M),
            }
            if progress.pretraining:
                on_predicted = on_predicted._replace(z=z_next, past=past[number + 1])
            else:
                branches = [(on_predicted, z_next)]
                if self._options.encoded_branch:
                    branches.append((on_encoded, encoded[number + 1]))
                losses, ends = self._segment_losses(branches, labels, number, progress)
                terms |= losses
                on_predicted, on_encoded = ends[0], ends[-1]
            yield terms

    def _segment_losses(
        self,
        branches: Sequence[tuple[SegmentInput, Tensor]],
        labels: Labels,
        number: int,
        progress: TrainingProgress,
    ) -> tuple[dict[str, Tensor], list[SegmentInput]]:
        """The losses of γ in one segment, and the inputs of the next segment.

        Args:
            branches: Inputs of the segment and features (n, z) at its end, of each branch.
            labels: Labels.
            number: Index of the segment.
            progress: How far the training has come.

        Returns:
            The losses, mean over the branches, and the inputs of the next segment of each branch.
        """
        inputs = SegmentInput(
            *(torch.cat(field) for field in zip(*(b[0] for b in branches), strict=True))
        )
        z_next = torch.cat([b[1] for b in branches])
        actions, states, logits = self.predict_actions(inputs, z_next)
        ticks = self._segment_ticks
        label = labels.states[:, number * ticks : (number + 1) * ticks].repeat(len(branches), 1, 1)
        positions, truth = states[..., :2], label[..., :2]
        if number:
            origin = labels.states[:, number * ticks - 1].repeat(len(branches), 1)
            positions = into_frame(positions, origin[:, None])
            truth = into_frame(truth, origin)
        terms = mode_terms(
            positions,
            logits,
            truth,
            assignment=self.config.assignment,
            classification=self.config.classification,
            share=progress.share if self.config.annealed else None,
            learned=~stands(labels.states).repeat(len(branches)) if self.config.standing else None,
        )
        continued = best_mode(positions.detach(), truth, self.config.assignment)
        rows = torch.arange(len(continued), device=continued.device)
        if self._options.scheduled:
            # The order of a batch is random, so its first rows are a random share of it.
            free = rows % len(labels.states) < progress.share * len(labels.states)
            continued = torch.where(free, logits.argmax(dim=1), continued)
        done = torch.cat([inputs.past, self.scaled_actions(actions[rows, continued])], dim=1)
        end = SegmentInput(
            z_next,
            done[:, -self.shape.history :],
            states[rows, continued, -1],
            inputs.length_m,
        )
        parts = zip(*(field.chunk(len(branches)) for field in end), strict=True)
        return terms, [SegmentInput(*part) for part in parts]

    def _normalised(self, z: Float[Tensor, "n z"]) -> Float[Tensor, "n z"]:
        return functional.layer_norm(z, z.shape[1:]) if self._options.normalise else z


def _means(segments: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
    """The mean of each term over the segments."""
    return {name: torch.stack([each[name] for each in segments]).mean() for name in segments[0]}

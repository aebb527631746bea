"""What decides an SSP-ASP: `predictors.models.ssp_asp` tells what its parts are.

MERGED: SSP-ASP: self-supervised prediction in action space (Janjoš, Dolgov, Zöllner 2021).

φ encodes what is seen into features z. ψ predicts the features ẑ of the segment to come from z and
the past actions; ξ reconstructs the past actions from the features before and after; γ predicts the
actions to come from both features and the past actions. In training the segment to come is encoded
too, and γ runs on the encoded features and on the predicted ones; a forecast knows the predicted
ones alone, on which validation selects. Longer horizons chain segments: `predictors.models.chaining`.

Read into the paper: the scene to come is drawn in the target's pose at its end; features pass a
LayerNorm before ψ and γ; a linear layer stands behind ψ, since features are unbounded; the losses
of both branches are averaged, and so are those of the segments; a later segment is predicted from
what inference has there, the predicted features and the matched mode's actions. Options that the
`paper` recipe leaves off: `normalise`, `stop_gradient`, `ema`, `skip`, `hidden`, `scheduled`,
`annealed`, `kept`; or takes away, for an ablation: `encoded_branch`.

Dimensions: n targets, m modes, t ticks of a segment, z features.
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
from predictors.models.chaining import Chaining, Chains, grow, merge, prune, starts
from predictors.models.encoders import make_encoder
from predictors.models.heads import ConnectedHead, RecurrentReader
from predictors.models.losses import HUBER_M, best_mode, into_frame, mode_terms
from predictors.models.network import (
    AbstractNetwork,
    Features,
    LearnedPlug,
    Modes,
    NetworkConfig,
    NetworkShape,
    TrainingProgress,
    drive,
    drive_from,
    start_states,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SSPASPConfig(NetworkConfig):
    """What decides the network and its loss; the defaults are the paper's."""

    gru_width: int = 512
    gru_layers: int = 2
    skip: bool = False
    """Whether the features, the present speed and the past actions also reach γ's output."""
    hidden: int = 0
    """Width of a hidden layer before γ's output; 0 for none, as in the paper."""
    integrator: Integrator = "euler"
    normalise: bool = False
    """Whether features are normalised where they are made, before all that reads them."""
    stop_gradient: bool = False
    """Whether the encoded features of the segment to come are a fixed target for ψ."""
    ema: float = 0.0
    """How slowly a second encoder follows φ to make that target instead, such as 0.99; 0: none."""
    encoded_branch: bool = True
    """Whether γ also learns on encoded features of the segment to come."""
    scheduled: bool = False
    """Whether, in training, ever more later segments follow the most probable mode of the one
    before in place of the one matched to the label."""
    kept: int = 0
    """Of all modes, how many a forecast keeps: those that most of the others run near, apart from
    each other, as the mean and with the probability of what is near. 0 keeps every mode, or in a
    beam the most probable chains."""
    spread_mps: float = 0.4
    """How near that is, for each second ahead: the standard deviation in `chaining.merge`."""
    action_weight: float = 1.0
    """w1, of the reconstruction of actions."""
    feature_weight: float = 1.0
    """w2, of the mismatch of features."""
    regression_weight: float = 1.0
    """w3."""
    classification_weight: float = 1.0
    """w4."""

    def __post_init__(self) -> None:
        """Checks the sizes.

        Raises:
            AspEnvError: one is not positive, `kept` is negative, or `ema` is not in [0, 1).
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


RECONSTRUCTOR = (256, 128, 64)
"""Widths of ξ."""


class SegmentInput(NamedTuple):
    """Where targets stand before a segment, as far as it is known."""

    z: Float[Tensor, "n z"]
    past: Float[Tensor, "n t 2"]
    """Actions of the segment before, in units of the range."""
    start: Float[Tensor, "n 4"]
    length_m: Float[Tensor, " n"]


@final
class SSPASPNetwork(AbstractNetwork):
    """φ, ψ, ξ, γ and the bicycle model."""

    merging_temperature: Float[Tensor, ""] | None
    """What log-probabilities of chains are divided by before they are merged, fitted when training
    is over; None where none are."""

    def __init__(self, config: SSPASPConfig, shape: NetworkShape) -> None:
        """With random weights.

        Raises:
            AspEnvError: the horizon is not a whole number of segments as long as the history.
        """
        super().__init__(config, shape)
        self._options = config
        if shape.horizon % shape.history:
            raise AspEnvError(
                f"ssp-asp chains segments of {shape.history * shape.dt_s:g} s, the horizon of "
                f"{shape.horizon * shape.dt_s:g} s is no whole number of them"
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
        self.reader = RecurrentReader(2 * z, width, config.gru_layers)
        if config.skip:
            width += 2 * z + 1 + 2 * shape.history
        self.head = ConnectedHead(width, config.hidden, modes=config.modes, ticks=shape.history)
        # A run that goes on from another is selected with what that one's calibration found.
        calm = torch.ones(()) if config.kept else None
        self.register_buffer("merging_temperature", calm)

    @property
    def later_ticks(self) -> tuple[int, ...]:
        """The ends of all segments."""
        return tuple(range(self.shape.history, self.shape.horizon + 1, self.shape.history))

    def forward(self, batch: Batch) -> Modes:
        """The modes of every target; segments are chained by beam."""
        return self.chain(batch, "beam")

    def chain(
        self, batch: Batch, chaining: Chaining, label: Float[Tensor, "n t 2"] | None = None
    ) -> Modes:
        """The modes of every target with a chaining of choice; `oracle` reads the label."""
        z = self.encode(batch)
        with torch.autocast(z.device.type, enabled=False):
            past = self.scaled_actions(batch.actions)
            chains = self._segment(SegmentInput(z, past, start_states(batch), batch.length_m))
            chains = self._kept(chains, chaining, batch)
            for _ in self.later_ticks[1:]:
                chains = starts(chains, chaining, label=label, assignment=self.config.assignment)
                chains = self._kept(grow(chains, self._go_on(chains, batch)), chaining, batch)
        return Modes(chains.states, chains.log_probs, chains.actions)

    def _kept(self, chains: Chains, chaining: Chaining, batch: Batch) -> Chains:
        count, ticks = chains.states.shape[1:3]
        temperature = self.merging_temperature
        if temperature is None or chaining == "full":
            more = count > self.config.modes
            return prune(chains, self.config.modes) if more and chaining == "beam" else chains
        kept, ended = self._options.kept, ticks == self.shape.horizon
        if count <= kept and not ended:
            return chains
        calm = chains._replace(log_probs=(chains.log_probs / temperature).log_softmax(dim=1))
        few = merge(calm, kept, self._options.spread_mps * ticks * self.shape.dt_s)
        if not ended:
            few = few._replace(log_probs=few.log_probs * temperature)
        return self._driven(few, batch)

    def _driven(self, chains: Chains, batch: Batch) -> Chains:
        """What a bicycle can drive of chains of mean states: the actions to heading and speed.

        Their features, means as well, are normalised again.
        """
        dt_s, integrator = self.shape.dt_s, self._options.integrator
        start = start_states(batch)[:, None, None].expand(-1, chains.states.shape[1], 1, -1)
        before = torch.cat([start, chains.states[:, :, :-1]], dim=2)
        lengths = batch.length_m[:, None, None]
        actions = clip_actions(inverse(before, chains.states, lengths, dt_s, integrator=integrator))
        z = self._normalised(chains.z.flatten(0, 1)).view_as(chains.z)
        return chains._replace(states=drive(actions, batch, dt_s, integrator), actions=actions, z=z)

    def encode(self, batch: Batch) -> Float[Tensor, "n z"]:
        """φ."""
        return self._normalised(self.encoder(batch.seen).float())

    def predict_features(self, at: SegmentInput) -> Float[Tensor, "n z"]:
        """ψ."""
        return self._normalised(self.forward_head(self.forward_reader(self.norm(at.z), at.past)))

    def predict_actions(
        self, at: SegmentInput, z_next: Float[Tensor, "n z"]
    ) -> tuple[Float[Tensor, "n m t 2"], Float[Tensor, "n m t 4"], Float[Tensor, "n m"]]:
        """γ and the bicycle: actions, states and logits of the modes of one segment."""
        context = torch.cat([self.norm(at.z), self.norm(z_next)], dim=-1)
        inputs = [self.reader(context, at.past)]
        if self._options.skip:
            speed = at.start[:, 3:] / self.get_buffer("motion_scale")[0]
            inputs += [context, at.past.flatten(1), speed]
        raw, logits = self.head(torch.cat(inputs, dim=-1))
        actions = self.actions_from(raw)
        start = at.start[:, None].expand(-1, actions.shape[1], -1)
        states = drive_from(start, actions, at.length_m, self.shape.dt_s, self._options.integrator)
        return actions, states, logits

    def training_loss(
        self, batch: Batch, labels: Labels, moment: TrainingProgress
    ) -> dict[str, Tensor]:
        """The four terms, averaged over branches and segments; two of them in pre-training."""
        encoded, targets = self._encoded(batch, labels)
        with torch.autocast(batch.actions.device.type, enabled=False):
            segments = list(self._terms(batch, labels, moment, encoded, targets))
        terms = {name: torch.stack([s[name] for s in segments]).mean() for name in segments[0]}
        weights = {
            "actions": self._options.action_weight,
            "features": self._options.feature_weight,
            "regression": self._options.regression_weight,
            "classification": self._options.classification_weight,
        }
        total = torch.stack([weights[name] * value for name, value in terms.items()]).sum()
        return {"loss": total, **terms}

    def features(self, batch: Batch, labels: Labels) -> Features | None:
        """Of the end of the first segment."""
        z = self.encode(batch)
        at = SegmentInput(
            z, self.scaled_actions(batch.actions), start_states(batch), batch.length_m
        )
        with torch.autocast(z.device.type, enabled=False):
            predicted = self.predict_features(at)
        return Features(self.encode(labels.later[0]), predicted)

    def after_step(self) -> None:
        """Lets the second encoder follow, where there is one."""
        if self.target_encoder is None:
            return
        followers, leaders = self.target_encoder, self.encoder
        with torch.no_grad():
            for own, leader in zip(followers.parameters(), leaders.parameters(), strict=True):
                own.lerp_(leader, 1 - self._options.ema)
            for own, leader in zip(followers.buffers(), leaders.buffers(), strict=True):
                own.copy_(leader)

    def _segment(self, at: SegmentInput) -> Chains:
        """A segment as a forecast knows it: with predicted features."""
        z_next = self.predict_features(at)
        actions, states, logits = self.predict_actions(at, z_next)
        z_of_modes = z_next[:, None].expand(-1, actions.shape[1], -1)
        return Chains(states, actions, logits.log_softmax(dim=1), z_of_modes)

    def _go_on(self, chains: Chains, batch: Batch) -> Chains:
        """The next segment of every chain."""
        n, k = chains.log_probs.shape
        recent = chains.actions[:, :, -self.shape.history :].flatten(0, 1)
        at = SegmentInput(
            chains.z.flatten(0, 1),
            self.scaled_actions(recent),
            chains.states[:, :, -1].flatten(0, 1),
            batch.length_m.repeat_interleave(k),
        )
        return Chains(*(field.unflatten(0, (n, k)).flatten(1, 2) for field in self._segment(at)))

    def _encoded(self, batch: Batch, labels: Labels) -> tuple[list[Tensor], list[Tensor]]:
        """Features now and at the end of each segment, and what ψ is to predict in their place."""
        scenes = [batch, *labels.later]
        encoded = [self.encode(each) for each in scenes]
        if self.target_encoder is not None:
            with torch.no_grad():
                targets = [self.target_encoder(each.seen).float() for each in scenes[1:]]
            return encoded, [self._normalised(z) for z in targets]
        return encoded, [z.detach() if self._options.stop_gradient else z for z in encoded[1:]]

    def _terms(
        self,
        batch: Batch,
        labels: Labels,
        moment: TrainingProgress,
        encoded: Sequence[Tensor],
        targets: Sequence[Tensor],
    ) -> Iterator[dict[str, Tensor]]:
        """The terms of each segment."""
        scenes = [batch, *labels.later]
        past = [self.scaled_actions(scene.actions) for scene in scenes]
        known = SegmentInput(encoded[0], past[0], start_states(batch), batch.length_m)
        ideal = known
        for number, target in enumerate(targets):
            z_next = self.predict_features(known)
            both = torch.cat([encoded[number], encoded[number + 1]], dim=-1)
            again = self.reconstructor(both).tanh().unflatten(1, (-1, 2))
            terms = {
                "actions": functional.huber_loss(again, past[number], delta=HUBER_M),
                "features": functional.huber_loss(z_next, target, delta=HUBER_M),
            }
            if moment.pretraining:
                known = known._replace(z=z_next, past=past[number + 1])
            else:
                branches = [(known, z_next)]
                if self._options.encoded_branch:
                    branches.append((ideal, encoded[number + 1]))
                found, ends = self._learn_segment(branches, labels, number, moment)
                terms |= found
                known, ideal = ends[0], ends[-1]
            yield terms

    def _learn_segment(
        self,
        branches: Sequence[tuple[SegmentInput, Tensor]],
        labels: Labels,
        number: int,
        moment: TrainingProgress,
    ) -> tuple[dict[str, Tensor], list[SegmentInput]]:
        """The losses of a segment, mean over its branches, and where each of them goes on from."""
        at = SegmentInput(
            *(torch.cat(field) for field in zip(*(b[0] for b in branches), strict=True))
        )
        z_next = torch.cat([b[1] for b in branches])
        actions, states, logits = self.predict_actions(at, z_next)
        ticks = self.shape.history
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
            share=moment.share if self.config.annealed else None,
        )
        follow = best_mode(positions.detach(), truth, self.config.assignment)
        rows = torch.arange(len(follow), device=follow.device)
        if self._options.scheduled:
            # The order of a batch is random, so its first rows are a random share of it.
            free = rows % len(labels.states) < moment.share * len(labels.states)
            follow = torch.where(free, logits.argmax(dim=1), follow)
        end = SegmentInput(
            z_next,
            self.scaled_actions(actions[rows, follow]),
            states[rows, follow, -1],
            at.length_m,
        )
        parts = zip(*(field.chunk(len(branches)) for field in end), strict=True)
        return terms, [SegmentInput(*part) for part in parts]

    def _normalised(self, z: Float[Tensor, "n z"]) -> Float[Tensor, "n z"]:
        return functional.layer_norm(z, z.shape[1:]) if self._options.normalise else z


SSPASP = LearnedPlug(name="ssp-asp", config=SSPASPConfig, network=SSPASPNetwork)
"""What the registry holds under `ssp-asp`."""

"""Decoder parts: a fully connected head, and the two readings of the action predictor γ as a GRU.

Janjoš et al. (2021) name a GRU of two layers that maps features and past actions to future actions
(section V-A), and leave its use open. `Decoder` names both readings: `read` (`RecurrentReader`,
then `ConnectedHead`) and `unrolled` (`UnrolledDecoder`).

Dimensions: n targets, m modes, h past ticks, t ticks ahead.
"""

from collections.abc import Sequence
from typing import Literal, final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from asp_env.errors import AspEnvError

Decoder = Literal["read", "unrolled"]
"""How γ as a GRU makes actions: `read` reads the past actions, and one linear layer maps its last
state to the actions of all ticks; `unrolled` goes on over the ticks ahead, and its state after each
of them is mapped to the actions of that tick."""

MAX_LAYERS = 100
"""Largest number of layers of a GRU. Chosen by hand; damaged files of runs name thousands."""

HeadOutputs = tuple[Float[Tensor, "n m t 2"], Float[Tensor, "n m"]]
"""Two numbers per mode and tick, and one logit per mode."""


def _make_gru(inputs: int, width: int, layers: int) -> nn.GRU:
    """A GRU with random weights.

    Raises:
        AspEnvError: It has more than `MAX_LAYERS` layers.
    """
    if layers > MAX_LAYERS:
        raise AspEnvError(f"network: {layers:,} layers of a GRU, expected at most {MAX_LAYERS}")
    return nn.GRU(inputs, width, layers, batch_first=True)


@final
class ConnectedHead(nn.Module):
    """An optional hidden layer and a linear output layer: a pair per mode and tick, and logits."""

    def __init__(self, width: int, hidden: int, *, modes: int, ticks: int) -> None:
        """Initialises the weights at random.

        Args:
            width: Number of inputs.
            hidden: Width of the hidden layer; 0 for none.
            modes: Number of modes M.
            ticks: Number of ticks T.
        """
        super().__init__()
        self._modes, self._ticks = modes, ticks
        layers = _hidden_layer(width, hidden)
        self.layers = nn.Sequential(*layers, nn.Linear(hidden or width, modes * (2 * ticks + 1)))

    def forward(self, inputs: Float[Tensor, "n width"]) -> HeadOutputs:
        """Returns pairs (n, m, t, 2) and logits (n, m)."""
        outputs = self.layers(inputs)
        pairs = outputs[:, self._modes :].unflatten(1, (self._modes, self._ticks, 2))
        return pairs, outputs[:, : self._modes]


@final
class RecurrentReader(nn.Module):
    """A GRU that reads [context, action] at every past tick and returns its last state."""

    def __init__(self, context: int, width: int, layers: int) -> None:
        """Initialises the weights at random.

        Args:
            context: Number of inputs besides the action; they are the same at every tick.
            width: Width of the GRU's state.
            layers: Number of layers.
        """
        super().__init__()
        self.gru = _make_gru(context + 2, width, layers)

    def forward(
        self, context: Float[Tensor, "n context"], actions: Float[Tensor, "n t 2"]
    ) -> Float[Tensor, "n width"]:
        """Returns the last state of the last layer.

        Args:
            context: Inputs that do not change over time.
            actions: Past actions in units of the action range.
        """
        return _gru_states(self.gru, context, actions)[-1]


@final
class UnrolledDecoder(nn.Module):
    """A GRU that reads the past ticks and goes on over the ticks ahead; one state for each tick.

    The input of a past tick is [context, action, 0], that of a tick ahead [context, 0, 0, 1]: no
    action is known there, and the last number, which is 1 from now on, separates reading from
    decoding. The same linear layer maps the state after each tick ahead to the actions of all modes
    at that tick; another one maps the state now, after the last past action, to the logits.

    The actions of a mode are not fed back. Janjoš et al. (2021) count their segments as a middle
    ground between approaches that build a trajectory step by step from their own outputs and
    approaches that predict it at once (sections I and VI), and name the feed-forward prediction
    one-shot: within a segment nothing is autoregressive. All modes share the states, so that the
    time of the GRU does not grow with their number, and there is no embedding of modes: as in the
    paper's first extension to modes (section IV-A), the decoder has M outputs.
    """

    def __init__(
        self, context: int, width: int, layers: int, *, modes: int, static: int = 0, hidden: int = 0
    ) -> None:
        """Initialises the weights at random.

        Args:
            context: Number of inputs besides the action; they are the same at every tick.
            width: Width of the GRU's state.
            layers: Number of layers.
            modes: Number of modes M.
            static: Number of inputs that reach the outputs without the GRU; 0 for none.
            hidden: Width of a hidden layer before the outputs; 0 for none.
        """
        super().__init__()
        self._modes = modes
        self.gru = _make_gru(context + 3, width, layers)
        first = hidden or 2 * modes
        self.from_state = nn.Linear(width, first)
        self.from_static = nn.Linear(static, first, bias=False) if static else None
        self.out = nn.Linear(hidden, 2 * modes) if hidden else None
        self.logits = nn.Sequential(*_hidden_layer(width + static, hidden))
        self.logits.append(nn.Linear(hidden or width + static, modes))

    def forward(
        self,
        context: Float[Tensor, "n context"],
        actions: Float[Tensor, "n h 2"],
        ticks: int,
        static: Float[Tensor, "n static"] | None = None,
    ) -> HeadOutputs:
        """Returns pairs (n, m, t, 2) and logits (n, m).

        Args:
            context: Inputs that do not change over time.
            actions: Past actions in units of the action range.
            ticks: Number of ticks ahead.
            static: Inputs that reach the outputs without the GRU, if there are any.
        """
        past = functional.pad(actions, (0, 1))
        none = actions.new_tensor([0.0, 0.0, 1.0]).expand(actions.shape[0], ticks, 3)
        states = _gru_states(self.gru, context, torch.cat([past, none], dim=1))
        history = actions.shape[1]
        ahead = states[history:]
        later = torch.stack(ahead, dim=1) if isinstance(ahead, list) else ahead.transpose(0, 1)
        outputs = self.from_state(later)
        now = states[history - 1]
        if self.from_static is not None:
            assert static is not None
            outputs = outputs + self.from_static(static)[:, None]
            now = torch.cat([now, static], dim=-1)
        if self.out is not None:
            outputs = self.out(outputs.relu())
        pairs = outputs.unflatten(2, (self._modes, 2)).transpose(1, 2)
        return pairs, self.logits(now)


def _hidden_layer(width: int, hidden: int) -> list[nn.Module]:
    """A hidden layer and its activation; nothing for a width of 0."""
    return [nn.Linear(width, hidden), nn.ReLU(inplace=True)] if hidden else []


def _gru_states(
    gru: nn.GRU, context: Float[Tensor, "n context"], inputs: Float[Tensor, "n t inputs"]
) -> list[Tensor] | Float[Tensor, "t n width"]:
    """The states (n, width) of the last layer after each tick.

    Args:
        gru: A GRU whose inputs at a tick are [context, inputs].
        context: Inputs that do not change over time.
        inputs: Inputs of each tick.
    """
    # On a GPU one fused kernel over all ticks is faster than fewer multiplications, and ONNX
    # has a GRU operator.
    if context.is_cuda or torch.compiler.is_exporting():
        repeated = context[:, None].expand(-1, inputs.shape[1], -1)
        return gru(torch.cat([repeated, inputs], dim=-1))[0].transpose(0, 1)
    width = context.shape[1]
    weights: Sequence[Sequence[Tensor]] = gru.all_weights
    from_input, from_state, input_bias, state_bias = weights[0]
    # The context is the same at every tick, so its part of the gates is computed once.
    context_gates = functional.linear(context, from_input[:, :width], input_bias)
    gates = functional.linear(inputs.transpose(0, 1), from_input[:, width:]) + context_gates
    states = _gru_layer(gates, from_state, state_bias)
    for from_input, from_state, input_bias, state_bias in weights[1:]:
        gates = functional.linear(torch.stack(states), from_input, input_bias)
        states = _gru_layer(gates, from_state, state_bias)
    return states


def _gru_layer(
    input_gates: Float[Tensor, "t n gates"],
    from_state: Float[Tensor, "gates width"],
    bias: Float[Tensor, " gates"],
) -> list[Tensor]:
    """The states (n, width) of a GRU layer after each tick, from the inputs' part of the gates."""
    width = from_state.shape[1]
    state = input_gates.new_zeros(input_gates.shape[1], width)
    states: list[Tensor] = []
    for from_inputs in input_gates.unbind(0):
        recurrent = functional.linear(state, from_state, bias)
        reset, update = (from_inputs + recurrent)[:, : 2 * width].sigmoid().chunk(2, dim=1)
        new = torch.addcmul(from_inputs[:, 2 * width :], reset, recurrent[:, 2 * width :]).tanh()
        state = new.lerp(state, update)
        states.append(state)
    return states

"""Decoder parts: a fully connected head, and a GRU that reads the past actions.

Dimensions: n targets, m modes, t ticks.
"""

from collections.abc import Sequence
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

HeadOutputs = tuple[Float[Tensor, "n m t 2"], Float[Tensor, "n m"]]
"""Two numbers per mode and tick, and one logit per mode."""


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
        layers: list[nn.Module] = []
        if hidden:
            layers = [nn.Linear(width, hidden), nn.ReLU(inplace=True)]
            width = hidden
        self.layers = nn.Sequential(*layers, nn.Linear(width, modes * (2 * ticks + 1)))

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
        self.gru = nn.GRU(context + 2, width, layers, batch_first=True)

    def forward(
        self, context: Float[Tensor, "n context"], actions: Float[Tensor, "n t 2"]
    ) -> Float[Tensor, "n width"]:
        """Returns the last state of the last layer.

        Args:
            context: Inputs that do not change over time.
            actions: Past actions in units of the action range.
        """
        # On a GPU one fused kernel over all ticks is faster than fewer multiplications, and ONNX
        # has a GRU operator.
        if context.is_cuda or torch.compiler.is_exporting():
            repeated = context[:, None].expand(-1, actions.shape[1], -1)
            return self.gru(torch.cat([repeated, actions], dim=-1))[0][:, -1]
        width = context.shape[1]
        weights: Sequence[Sequence[Tensor]] = self.gru.all_weights
        from_input, from_state, input_bias, state_bias = weights[0]
        # The context is the same at every tick, so its part of the gates is computed once.
        context_gates = functional.linear(context, from_input[:, :width], input_bias)
        gates = functional.linear(actions.transpose(0, 1), from_input[:, width:]) + context_gates
        states = _gru_layer(gates, from_state, state_bias)
        for from_input, from_state, input_bias, state_bias in weights[1:]:
            gates = functional.linear(torch.stack(states), from_input, input_bias)
            states = _gru_layer(gates, from_state, state_bias)
        return states[-1]


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

"""From features to modes: a fully connected head, and one that reads the past actions in turn."""

from collections.abc import Sequence
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

Outputs = tuple[Float[Tensor, "n m t 2"], Float[Tensor, "n m"]]


@final
class ConnectedHead(nn.Module):
    """A hidden layer, if any, and a linear one to two numbers per mode and tick and a logit."""

    def __init__(self, width: int, hidden: int, *, modes: int, ticks: int) -> None:
        """From so many inputs; `hidden` 0 leaves the hidden layer out."""
        super().__init__()
        self._modes, self._ticks = modes, ticks
        layers: list[nn.Module] = []
        if hidden:
            layers = [nn.Linear(width, hidden), nn.ReLU(inplace=True)]
            width = hidden
        self.layers = nn.Sequential(*layers, nn.Linear(width, modes * (2 * ticks + 1)))

    def forward(self, inputs: Float[Tensor, "n width"]) -> Outputs:
        """Two numbers per mode and tick, and the modes' logits."""
        out = self.layers(inputs)
        pairs = out[:, self._modes :].unflatten(1, (self._modes, self._ticks, 2))
        return pairs, out[:, : self._modes]


@final
class RecurrentReader(nn.Module):
    """Reads [context, action] at every tick of the past actions; its last state is the answer."""

    def __init__(self, context: int, width: int, layers: int) -> None:
        """A GRU of so many layers."""
        super().__init__()
        self.gru = nn.GRU(context + 2, width, layers, batch_first=True)

    def forward(
        self, context: Float[Tensor, "n context"], actions: Float[Tensor, "n t 2"]
    ) -> Float[Tensor, "n width"]:
        """The last state of the last layer."""
        # Where one kernel for all ticks is faster than fewer multiplications, and for ONNX, which
        # knows a GRU as a whole.
        if context.is_cuda or torch.compiler.is_exporting():
            repeated = context[:, None].expand(-1, actions.shape[1], -1)
            return self.gru(torch.cat([repeated, actions], dim=-1))[0][:, -1]
        width = context.shape[1]
        weights: Sequence[Sequence[Tensor]] = self.gru.all_weights
        from_input, from_state, input_bias, state_bias = weights[0]
        # The context is the same at every tick: its share of the gates is worked out once.
        of_context = functional.linear(context, from_input[:, :width], input_bias)
        gates = functional.linear(actions.transpose(0, 1), from_input[:, width:]) + of_context
        states = _read(gates, from_state, state_bias)
        for from_input, from_state, input_bias, state_bias in weights[1:]:
            gates = functional.linear(torch.stack(states), from_input, input_bias)
            states = _read(gates, from_state, state_bias)
        return states[-1]


def _read(
    gates: Float[Tensor, "t n gates"],
    from_state: Float[Tensor, "gates width"],
    bias: Float[Tensor, " gates"],
) -> list[Tensor]:
    """The states of one layer of a GRU after each tick, given its input's share of the gates."""
    width = from_state.shape[1]
    state = gates.new_zeros(gates.shape[1], width)
    states: list[Tensor] = []
    for given in gates.unbind(0):
        recalled = functional.linear(state, from_state, bias)
        reset, update = (given + recalled)[:, : 2 * width].sigmoid().chunk(2, dim=1)
        new = torch.addcmul(given[:, 2 * width :], reset, recalled[:, 2 * width :]).tanh()
        state = new.lerp(state, update)
        states.append(state)
    return states

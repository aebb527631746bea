"""From features to modes: a fully connected head, and one that reads the past actions in turn."""

from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn

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
        steps = torch.cat([context[:, None].expand(-1, actions.shape[1], -1), actions], dim=-1)
        return self.gru(steps)[0][:, -1]

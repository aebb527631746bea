"""From vectors to features: a star graph with the target in its middle.

After Gao et al., VectorNet (2020), made cheap. Every agent and every piece of a line become a
token each; the target's token then reads all of them by attention, layer after layer. Nothing else
is read by anyone, so attention costs as much as there are tokens, not their square. What the others
have to do with the target shows in their tokens already, since all is seen from its frame.

VectorNet's pooling over the points of a polyline is replaced by one layer over all of them: their
number is fixed, and differences between ticks survive. Normalisation is by layer, so that a
forecast does not depend on its batch. What is not valid is never read, whatever stands there.

Dimensions: n targets, k tokens, h heads, w width.
"""

import math
from typing import NamedTuple, final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from asp_env.errors import AspEnvError
from asp_env.views.vectors import VectorShape

MOTION_FIELDS = 5
"""x, y, cos, sin, speed: what changes from tick to tick. Other fields are read of the present."""

PLACE_M = 20.0
"""What positions are divided by."""

STEP_M = 5.0
"""What the way between an agent's past and its present is divided by."""

SPEED_MPS = 10.0
SIZE_M = 5.0


class VectorTensors(NamedTuple):
    """What N targets see, each in its own frame now; fields as `asp_env.views.vectors` names."""

    agents: Float[Tensor, "n agents ticks fields"]
    agents_valid: Bool[Tensor, "n agents ticks"]
    lines: Float[Tensor, "n lines points line_fields"]
    lines_valid: Bool[Tensor, "n lines points"]


@final
class VectorEncoder(nn.Module):
    """Features of vectors; the order of agents but the first, and of lines, does not matter."""

    def __init__(
        self,
        shape: VectorShape,
        features: int,
        *,
        width: int = 64,
        layers: int = 2,
        heads: int = 4,
    ) -> None:
        """With random weights.

        Args:
            shape: of what is read; more or fewer agents and lines can be read as well.
            features: how many come out.
            width: of the tokens.
            layers: how often the target reads the tokens.
            heads: of each reading.

        Raises:
            AspEnvError: the heads do not share the width evenly.
        """
        super().__init__()
        if width % heads:
            raise AspEnvError(
                f"vector encoder of width {width} with {heads} heads: give heads that divide it"
            )
        agent_inputs = shape.ticks * MOTION_FIELDS + shape.agent_fields
        line_inputs = shape.points * shape.line_fields
        self.target = _perceptron(agent_inputs, width)
        self.agent = _perceptron(agent_inputs, width)
        self.line = _perceptron(line_inputs, width)
        self.norm = nn.LayerNorm(width)
        self.readings = nn.ModuleList(Reading(width, heads) for _ in range(layers))
        self.out = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, features))
        present = [PLACE_M, PLACE_M, 1, 1, SPEED_MPS, SIZE_M, SIZE_M]
        motion = [STEP_M, STEP_M, 1, 1, SPEED_MPS]
        for name, divisors, fields in (
            ("present_scale", present, shape.agent_fields),
            ("motion_scale", motion, MOTION_FIELDS),
            ("point_scale", [PLACE_M, PLACE_M], shape.line_fields),
        ):
            rest = [1.0] * (fields - len(divisors))
            self.register_buffer(name, 1 / torch.tensor([*divisors, *rest]), persistent=False)

    def forward(self, vectors: VectorTensors) -> Float[Tensor, "n features"]:
        """Features of every target."""
        agents = self._agent_inputs(vectors)
        lines = vectors.lines.masked_fill(~vectors.lines_valid[..., None], 0)
        lines = (lines * self.get_buffer("point_scale")).flatten(2)
        query = self.target(agents[:, 0])
        tokens = torch.cat([query[:, None], self.agent(agents[:, 1:]), self.line(lines)], dim=1)
        # The target's own token is always read, so that there is always something to read.
        own = torch.ones_like(vectors.agents_valid[:, :1, -1])
        others, pieces = vectors.agents_valid[:, 1:].any(dim=-1), vectors.lines_valid.any(dim=-1)
        valid = torch.cat([own, others, pieces], dim=1)
        tokens = self.norm(tokens)
        for reading in self.readings:
            query = reading(query, tokens, valid)
        return self.out(query)

    def _agent_inputs(self, vectors: VectorTensors) -> Float[Tensor, "n agents inputs"]:
        states = vectors.agents.masked_fill(~vectors.agents_valid[..., None], 0)
        present = states[:, :, -1]
        motion = states[..., :MOTION_FIELDS] * self.get_buffer("motion_scale")
        here = present[:, :, None, :2] * vectors.agents_valid[..., None]
        ways = motion[..., :2] - here / STEP_M
        motion = torch.cat([ways, motion[..., 2:]], dim=-1).flatten(2)
        return torch.cat([motion, present * self.get_buffer("present_scale")], dim=-1)


@final
class Reading(nn.Module):
    """The target's token reads all tokens and thinks it over."""

    def __init__(self, width: int, heads: int) -> None:
        """With pre-normalised residuals."""
        super().__init__()
        self._heads = heads
        self.norm = nn.LayerNorm(width)
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width, bias=False)
        self.value = nn.Linear(width, width)
        self.out = nn.Linear(width, width)
        self.think = nn.Sequential(
            nn.LayerNorm(width),
            nn.Linear(width, 2 * width),
            nn.ReLU(inplace=True),
            nn.Linear(2 * width, width),
        )

    def forward(
        self,
        query: Float[Tensor, "n w"],
        tokens: Float[Tensor, "n k w"],
        valid: Bool[Tensor, "n k"],
    ) -> Float[Tensor, "n w"]:
        """The target's token with what it found.

        With one query it is cheaper to lead it through the keys' weights than all tokens, and to
        lead what was read through the values' weights: (W q)·(V t) = (Vᵀ W q)·t.
        """
        heads, width = self._heads, query.shape[-1]
        q = self.query(self.norm(query)).unflatten(1, (heads, -1))
        key = self.key.weight.unflatten(0, (heads, -1))
        asked = torch.einsum("nhd,hdw->nhw", q, key) / math.sqrt(width // heads)
        scores = torch.matmul(asked, tokens.transpose(1, 2)).float()
        weights = scores.masked_fill(~valid[:, None], -math.inf).softmax(dim=-1)
        read = torch.matmul(weights.to(tokens.dtype), tokens)
        value = self.value.weight.unflatten(0, (heads, -1))
        found = torch.einsum("nhw,hdw->nhd", read, value).flatten(1) + self.value.bias
        query = query + self.out(found)
        return query + self.think(query)


def _perceptron(inputs: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, width), nn.ReLU(inplace=True), nn.Linear(width, width))

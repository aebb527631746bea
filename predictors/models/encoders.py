"""Encoders φ: from observations to features.

- `resnet18`: ResNet18 (He et al. 2016) for rasters, as in the paper.
- `small`: four convolutions, for small rasters.
- `vector`: a star graph over vectors with the target in its middle, after VectorNet (Gao et al.
  2020). Every agent and every piece of a line is a token; only the target's token attends to the
  others, so attention costs as much as there are tokens, not their square. All tokens are in
  the target's frame, so they hold their relation to it already. VectorNet's pooling over the points
  of a polyline is replaced by one layer over all of them: their number is fixed, and differences
  between ticks survive. Normalisation is by layer, so that a forecast does not depend on its batch.
  Invalid entries are masked and never influence the features.

The names of modules are keys of the files of weights.

Dimensions: n targets, k tokens of width w, d width of an attention head; c channels, h rows and
w columns of rasters.
"""

import math
from pathlib import Path
from typing import final

import torch
from jaxtyping import Bool, Float, UInt8
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from asp_env.errors import AspEnvError, CheckpointError, unknown_name
from asp_env.views.vectors import VectorShape
from predictors.models.batch import Observation, VectorTensors
from predictors.models.network import NetworkShape

RASTER_ENCODERS = ("resnet18", "small")
ENCODERS = (*RASTER_ENCODERS, "vector")


def make_encoder(name: str, shape: NetworkShape, features: int) -> nn.Module:
    """Makes an encoder with random weights.

    Args:
        name: One of `ENCODERS`.
        shape: Sizes of the observation.
        features: Number of features. ResNet18 has 512; a linear layer follows it for others.

    Raises:
        AspEnvError: The name is unknown, or the encoder does not fit the observation.
    """
    if name not in ENCODERS:
        raise unknown_name("encoder", name, ENCODERS)
    if isinstance(shape.observation, VectorShape):
        if name in RASTER_ENCODERS:
            raise AspEnvError(
                f"encoder {name} reads rasters, the view renders vectors: take vector"
            )
        return VectorEncoder(shape.observation, features)
    if name not in RASTER_ENCODERS:
        raise AspEnvError(
            f"encoder {name} reads vectors, the view renders rasters: take "
            f"{' or '.join(RASTER_ENCODERS)}"
        )
    return RasterEncoder(name, shape.observation, features, packed=shape.packed)


@final
class RasterEncoder(nn.Module):
    """ResNet18 or the small encoder; unpacks and scales the rasters on the network's device."""

    def __init__(
        self, name: str, shape: tuple[int, int, int], features: int, *, packed: bool
    ) -> None:
        """Initialises the weights at random.

        Args:
            name: One of `RASTER_ENCODERS`.
            shape: Channels, height and width of the rasters.
            features: Number of features.
            packed: Whether the rasters are packed to bits along their rows.
        """
        super().__init__()
        self._width = shape[2] if packed else None
        if name == "small":
            self.body: nn.Module = SmallEncoder(shape, features)
            self.ahead: nn.Module = nn.Identity()
        else:
            self.body = ResNet18(shape[0])
            same = features == ResNet18.features
            self.ahead = nn.Identity() if same else nn.Linear(ResNet18.features, features)

    def forward(self, rasters: Observation) -> Float[Tensor, "n features"]:
        """Returns the features of rasters with values from 0 to 255, or packed to bits."""
        assert isinstance(rasters, Tensor)
        device = rasters.device.type
        dtype = torch.bfloat16 if torch.is_autocast_enabled(device) else torch.float32
        if self._width is None:
            # Bytes are moved to channels-last before they become floats: there is less to move.
            pixels = rasters.contiguous(memory_format=torch.channels_last).to(dtype) * (1 / 255)
        else:
            pixels = unpack_bits(rasters, self._width).to(dtype)
        return self.ahead(self.body(pixels.contiguous(memory_format=torch.channels_last)))


def unpack_bits(packed: UInt8[Tensor, "n c h bytes"], width: int) -> UInt8[Tensor, "n c h w"]:
    """Unpacks bits along rows to 0 and 1, the highest bit first (`asp_env.views.draw` packs them).

    Args:
        packed: Rasters whose rows are bytes of 8 columns.
        width: Columns of a raster.

    Returns:
        Rasters in channels-last memory order, where each bit of all bytes is one operation.
    """
    channels_last = packed.permute(0, 2, 3, 1).contiguous()
    bits = torch.stack([(channels_last >> shift) & 1 for shift in range(7, -1, -1)], dim=3)
    return bits.flatten(2, 3)[:, :, :width].permute(0, 3, 1, 2)


def load_resnet18(network: nn.Module, path: Path) -> None:
    """Loads weights with torchvision's names into every ResNet18 of a network.

    The classifier is left out, and so is a first convolution of other channels.

    Args:
        network: The network.
        path: A safetensors file.

    Raises:
        CheckpointError: The file cannot be read or does not fit, or the network has no ResNet18.
    """
    resnets = [module for module in network.modules() if isinstance(module, ResNet18)]
    if not resnets:
        raise CheckpointError(f"{path}: the network has no resnet18 to start from these weights")
    try:
        weights = load_file(path)
    except (OSError, ValueError, SafetensorError) as error:
        raise CheckpointError(
            f"{path} cannot be read as safetensors ({error}); other formats are not loaded, "
            "convert the file first"
        ) from error
    for resnet in resnets:
        own = resnet.state_dict()
        skipped = {name for name in weights if name.startswith("fc.")}
        first = weights.get("conv1.weight")
        if first is not None and first.shape != own["conv1.weight"].shape:
            skipped.add("conv1.weight")
        loaded = {name: value for name, value in weights.items() if name not in skipped}
        missing = set(own) - set(loaded) - skipped
        if missing or set(loaded) - set(own):
            name = sorted(missing or set(loaded) - set(own))[0]
            raise CheckpointError(f"{path} holds no weights of a ResNet18: {name} does not fit")
        try:
            resnet.load_state_dict(loaded, strict=False)
        except RuntimeError as error:
            raise CheckpointError(f"{path} holds no weights of a ResNet18: {error}") from error


@final
class SmallEncoder(nn.Module):
    """Four convolutions of stride 2 and a linear layer over all positions.

    About 30.7 M multiplications for 12x90x60 rasters and 256 features.
    """

    def __init__(self, shape: tuple[int, int, int], features: int) -> None:
        """Initialises the weights at random.

        Args:
            shape: Channels, height and width of the rasters.
            features: Number of features.
        """
        super().__init__()
        channels, height, width = shape
        layers: list[nn.Module] = []
        for out, kernel in ((32, 5), (64, 3), (128, 3), (128, 3)):
            layers += [
                nn.Conv2d(channels, out, kernel, stride=2, padding=kernel // 2, bias=False),
                nn.BatchNorm2d(out),
                nn.ReLU(inplace=True),
            ]
            channels, height, width = out, (height + 1) // 2, (width + 1) // 2
        self.convolutions = nn.Sequential(*layers)
        self.linear = nn.Linear(channels * height * width, features)

    def forward(self, rasters: Float[Tensor, "n c h w"]) -> Float[Tensor, "n features"]:
        """Returns the features of rasters with values in [0, 1]."""
        return self.linear(self.convolutions(rasters).flatten(1))


@final
class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a shortcut (He et al. 2016)."""

    def __init__(self, in_channels: int, channels: int, stride: int) -> None:
        """Initialises the weights; the shortcut is a 1x1 convolution where the shape changes."""
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, channels, 3, stride=stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.relu = nn.ReLU(inplace=True)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)
        self.downsample: nn.Module | None = None
        if stride != 1 or in_channels != channels:
            self.downsample = nn.Sequential(
                nn.Conv2d(in_channels, channels, 1, stride=stride, bias=False),
                nn.BatchNorm2d(channels),
            )

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n d i j"]:
        """Returns d channels; rows and columns are divided by the stride."""
        shortcut = x if self.downsample is None else self.downsample(x)
        y = self.relu(self.bn1(self.conv1(x)))
        return self.relu(self.bn2(self.conv2(y)) + shortcut)


@final
class ResNet18(nn.Module):
    """ResNet18 without its classifier; parameters are named as in torchvision."""

    features = 512

    def __init__(self, in_channels: int) -> None:
        """Initialises the convolutions as He et al. (2015)."""
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        self.layer1 = nn.Sequential(BasicBlock(64, 64, 1), BasicBlock(64, 64, 1))
        self.layer2 = nn.Sequential(BasicBlock(64, 128, 2), BasicBlock(128, 128, 1))
        self.layer3 = nn.Sequential(BasicBlock(128, 256, 2), BasicBlock(256, 256, 1))
        self.layer4 = nn.Sequential(BasicBlock(256, 512, 2), BasicBlock(512, 512, 1))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, rasters: Float[Tensor, "n c h w"]) -> Float[Tensor, "n 512"]:
        """Returns the features of rasters with values in [0, 1], averaged over all positions."""
        x = self.maxpool(self.relu(self.bn1(self.conv1(rasters))))
        x = self.layer4(self.layer3(self.layer2(self.layer1(x))))
        return torch.flatten(x.mean(dim=(2, 3)), 1)


MOTION_FIELDS = 5
"""x, y, cos, sin, speed: the fields that are read at every tick; the others are read now only."""

POSITION_M = 20.0
"""Divisor of positions. This and the following divisors are chosen by hand, so that typical inputs
lie within [-1, 1]."""

STEP_M = 5.0
"""Divisor of the displacement between a past and the present position of an agent."""

SPEED_MPS = 10.0
"""Divisor of speeds."""

SIZE_M = 5.0
"""Divisor of lengths and widths."""


@final
class VectorEncoder(nn.Module):
    """The star graph over vectors.

    The order of the agents behind the first one, the target, and of the lines does not matter.
    """

    def __init__(
        self,
        shape: VectorShape,
        features: int,
        *,
        width: int = 64,
        layers: int = 2,
        heads: int = 4,
    ) -> None:
        """Initialises the weights at random.

        Args:
            shape: Sizes of the vectors; the number of agents and lines may differ later.
            features: Number of features.
            width: Width of the tokens.
            layers: Number of attention layers.
            heads: Attention heads of each layer.

        Raises:
            AspEnvError: The heads do not divide the width.
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
        self.readings = nn.ModuleList(TargetAttention(width, heads) for _ in range(layers))
        self.out = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, features))
        present = [POSITION_M, POSITION_M, 1, 1, SPEED_MPS, SIZE_M, SIZE_M]
        motion = [STEP_M, STEP_M, 1, 1, SPEED_MPS]
        for name, divisors, fields in (
            ("present_scale", present, shape.agent_fields),
            ("motion_scale", motion, MOTION_FIELDS),
            ("point_scale", [POSITION_M, POSITION_M], shape.line_fields),
        ):
            rest = [1.0] * (fields - len(divisors))
            self.register_buffer(name, 1 / torch.tensor([*divisors, *rest]), persistent=False)

    def forward(self, vectors: VectorTensors) -> Float[Tensor, "n features"]:
        """Returns the features of every target."""
        agents = self._agent_inputs(vectors)
        lines = vectors.lines.masked_fill(~vectors.lines_valid[..., None], 0)
        lines = (lines * self.get_buffer("point_scale")).flatten(2)
        query = self.target(agents[:, 0])
        tokens = torch.cat([query[:, None], self.agent(agents[:, 1:]), self.line(lines)], dim=1)
        # The target's own token is always valid, so the softmax has at least one entry.
        own = torch.ones_like(vectors.agents_valid[:, :1, -1])
        neighbours = vectors.agents_valid[:, 1:].any(dim=-1)
        valid = torch.cat([own, neighbours, vectors.lines_valid.any(dim=-1)], dim=1)
        tokens = self.norm(tokens)
        for attention in self.readings:
            query = attention(query, tokens, valid)
        return self.out(query)

    def _agent_inputs(self, vectors: VectorTensors) -> Float[Tensor, "n agents inputs"]:
        """Past displacements and motion at every tick, and all fields now; zero where not valid."""
        states = vectors.agents.masked_fill(~vectors.agents_valid[..., None], 0)
        present = states[:, :, -1]
        motion = states[..., :MOTION_FIELDS] * self.get_buffer("motion_scale")
        position = present[:, :, None, :2] * vectors.agents_valid[..., None]
        displacements = motion[..., :2] - position / STEP_M
        motion = torch.cat([displacements, motion[..., 2:]], dim=-1).flatten(2)
        return torch.cat([motion, present * self.get_buffer("present_scale")], dim=-1)


@final
class TargetAttention(nn.Module):
    """One layer in which the target's token attends to all tokens, and a perceptron."""

    def __init__(self, width: int, heads: int) -> None:
        """Initialises the weights at random; both residual branches are normalised first."""
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
        """Returns the updated token of the target.

        With a single query it is cheaper to apply the keys' weights to the query than to all
        tokens, and the values' weights to the weighted mean: (W q)·(V t) = (Vᵀ W q)·t.

        Args:
            query: The target's token.
            tokens: All tokens.
            valid: Mask of the tokens to attend to, at least one of each target.
        """
        heads, width = self._heads, query.shape[-1]
        q = self.query(self.norm(query)).unflatten(1, (heads, -1))
        key = self.key.weight.unflatten(0, (heads, -1))
        queries = torch.einsum("nhd,hdw->nhw", q, key) / math.sqrt(width // heads)
        scores = torch.matmul(queries, tokens.transpose(1, 2)).float()
        weights = scores.masked_fill(~valid[:, None], -math.inf).softmax(dim=-1)
        means = torch.matmul(weights.to(tokens.dtype), tokens)
        value = self.value.weight.unflatten(0, (heads, -1))
        attended = torch.einsum("nhw,hdw->nhd", means, value).flatten(1) + self.value.bias
        query = query + self.out(attended)
        return query + self.think(query)


def _perceptron(inputs: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, width), nn.ReLU(inplace=True), nn.Linear(width, width))

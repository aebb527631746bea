"""From vectors to features: a star graph with the target in its middle.

After Gao et al., VectorNet (2020), made cheap. Every agent and every piece of a line become a
token each; the target's token then reads all of them by attention, layer after layer. Nothing else
is read by anyone, so attention costs as much as there are tokens, not their square. What the others
have to do with the target shows in their tokens already, since all is seen from its frame.

VectorNet's pooling over the points of a polyline is replaced by one layer over all of them: their
number is fixed, and differences between ticks survive. Normalisation is by layer, so that a
forecast does not depend on its batch. What is not valid is never read, whatever stands there.

Dimensions: n targets, k tokens, h heads, w width.

MERGED: From what is seen to features: ResNet18, a small network for small pictures, one for vectors.
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
from predictors.models.batch import Seen, VectorTensors
from predictors.models.network import NetworkShape

MOTION_FIELDS = 5
"""x, y, cos, sin, speed: what changes from tick to tick. Other fields are read of the present."""

PLACE_M = 20.0
"""What positions are divided by."""

STEP_M = 5.0
"""What the way between an agent's past and its present is divided by."""

SPEED_MPS = 10.0
SIZE_M = 5.0


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


PICTURE_ENCODERS = ("resnet18", "small")
ENCODERS = (*PICTURE_ENCODERS, "vector")


def make_encoder(name: str, shape: NetworkShape, features: int) -> nn.Module:
    """The encoder of what is seen into so many features.

    ResNet18 always has 512 features; others are reached by a linear layer behind it.

    Raises:
        AspEnvError: the name is unknown, or the encoder does not read what is seen.
    """
    if name not in ENCODERS:
        raise unknown_name("encoder", name, ENCODERS)
    if isinstance(shape.seen, VectorShape):
        if name in PICTURE_ENCODERS:
            raise AspEnvError(f"encoder {name} reads pictures, the view draws vectors: take vector")
        return VectorEncoder(shape.seen, features)
    if name not in PICTURE_ENCODERS:
        raise AspEnvError(
            f"encoder {name} reads vectors, the view draws pictures: take "
            f"{' or '.join(PICTURE_ENCODERS)}"
        )
    return PictureEncoder(name, shape.seen, features, packed=shape.packed)


@final
class PictureEncoder(nn.Module):
    """Pictures of bytes or bits into features; unpacked and scaled where the network runs."""

    def __init__(
        self, name: str, shape: tuple[int, int, int], features: int, *, packed: bool
    ) -> None:
        """For pictures (channels, height, width)."""
        super().__init__()
        self._width = shape[2] if packed else None
        if name == "small":
            self.body: nn.Module = SmallEncoder(shape, features)
            self.ahead: nn.Module = nn.Identity()
        else:
            self.body = ResNet18(shape[0])
            same = features == ResNet18.features
            self.ahead = nn.Identity() if same else nn.Linear(ResNet18.features, features)

    def forward(self, seen: Seen) -> Float[Tensor, "n features"]:
        """Features of pictures of 0 to 255, or of bits along rows."""
        assert isinstance(seen, Tensor)
        device = seen.device.type
        dtype = torch.bfloat16 if torch.is_autocast_enabled(device) else torch.float32
        if self._width is None:
            # Small integers are moved to channels-last before they grow: there is less to move.
            pixels = seen.contiguous(memory_format=torch.channels_last).to(dtype) * (1 / 255)
        else:
            pixels = unpack_bits(seen, self._width).to(dtype)
        return self.ahead(self.body(pixels.contiguous(memory_format=torch.channels_last)))


def unpack_bits(packed: UInt8[Tensor, "n c h bytes"], width: int) -> UInt8[Tensor, "n c h w"]:
    """Bits along rows as 0 and 1, the highest bit first, as `asp_env.views.draw` packs them.

    In channels-last order, where bits of one place in a byte lie side by side: one operation each.
    """
    channels_last = packed.permute(0, 2, 3, 1).contiguous()
    bits = torch.stack([(channels_last >> shift) & 1 for shift in range(7, -1, -1)], dim=3)
    return bits.flatten(2, 3)[:, :, :width].permute(0, 3, 1, 2)


def load_resnet18(network: nn.Module, path: Path) -> None:
    """Starts the ResNet18 of a network from a file of weights with torchvision's names.

    The classifier is left out, and so is the first convolution where it has other channels.

    Raises:
        CheckpointError: the file cannot be read or does not fit, or the network has no ResNet18.
    """
    found = [module for module in network.modules() if isinstance(module, ResNet18)]
    if not found:
        raise CheckpointError(f"{path}: the network has no resnet18 to start from these weights")
    try:
        weights = load_file(path)
    except (OSError, ValueError, SafetensorError) as error:
        raise CheckpointError(
            f"{path} cannot be read as safetensors ({error}); other formats are not loaded, "
            "convert the file first"
        ) from error
    for resnet in found:
        own = resnet.state_dict()
        skipped = {name for name in weights if name.startswith("fc.")}
        first = weights.get("conv1.weight")
        if first is not None and first.shape != own["conv1.weight"].shape:
            skipped.add("conv1.weight")
        taken = {name: value for name, value in weights.items() if name not in skipped}
        lacking = set(own) - set(taken) - skipped
        if lacking or set(taken) - set(own):
            name = sorted(lacking or set(taken) - set(own))[0]
            raise CheckpointError(f"{path} holds no weights of a ResNet18: {name} does not fit")
        try:
            resnet.load_state_dict(taken, strict=False)
        except RuntimeError as error:
            raise CheckpointError(f"{path} holds no weights of a ResNet18: {error}") from error


@final
class SmallEncoder(nn.Module):
    """Four convolutions of stride 2 and a linear layer that keeps apart what lies where.

    About 30.7 M multiplications for 12x90x60 and 256 features.
    """

    def __init__(self, shape: tuple[int, int, int], features: int) -> None:
        """For rasters (channels, height, width)."""
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

    def forward(self, raster: Float[Tensor, "n c h w"]) -> Float[Tensor, "n features"]:
        """Features of rasters in [0, 1]."""
        return self.linear(self.convolutions(raster).flatten(1))


@final
class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a shortcut (He et al. 2016)."""

    def __init__(self, in_channels: int, channels: int, stride: int) -> None:
        """With a 1x1 convolution in the shortcut where the shape changes."""
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
        """The block's output."""
        shortcut = x if self.downsample is None else self.downsample(x)
        y = self.relu(self.bn1(self.conv1(x)))
        return self.relu(self.bn2(self.conv2(y)) + shortcut)


@final
class ResNet18(nn.Module):
    """ResNet18 without its classifier; parameters are named as in torchvision."""

    features = 512

    def __init__(self, in_channels: int) -> None:
        """For rasters of so many channels, with He's initial weights."""
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

    def forward(self, raster: Float[Tensor, "n c h w"]) -> Float[Tensor, "n 512"]:
        """Features of rasters in [0, 1], averaged over the picture."""
        x = self.maxpool(self.relu(self.bn1(self.conv1(raster))))
        x = self.layer4(self.layer3(self.layer2(self.layer1(x))))
        return torch.flatten(x.mean(dim=(2, 3)), 1)

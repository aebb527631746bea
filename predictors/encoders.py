"""From rasters to features: ResNet18, and a small network for small rasters on a CPU."""

from typing import Literal, final

import torch
from jaxtyping import Float
from torch import Tensor, nn

EncoderName = Literal["resnet18", "small"]


def make_encoder(name: EncoderName, shape: tuple[int, int, int], features: int) -> nn.Module:
    """The encoder of rasters (channels, height, width) into so many features.

    ResNet18 always has 512 features; others are reached by a linear layer behind it.
    """
    if name == "small":
        return SmallEncoder(shape, features)
    resnet = ResNet18(shape[0])
    if features == resnet.features:
        return resnet
    return nn.Sequential(resnet, nn.Linear(resnet.features, features))


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

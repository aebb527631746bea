"""Encoders: sizes, names, and that rasters reach the features."""

import torch

from predictors.encoders import ResNet18, SmallEncoder, make_encoder


def test_resnet18_has_torchvisions_parameters() -> None:
    """11,176,512 weights without the classifier for 3 channels, under torchvision's names."""
    network = ResNet18(3)
    assert sum(parameter.numel() for parameter in network.parameters()) == 11_176_512
    names = set(network.state_dict())
    assert len(names) == 120
    assert {
        "conv1.weight",
        "bn1.running_mean",
        "layer1.0.conv1.weight",
        "layer2.0.downsample.0.weight",
        "layer2.0.downsample.1.num_batches_tracked",
        "layer4.1.bn2.bias",
    } <= names
    assert tuple(network.state_dict()["layer4.0.downsample.0.weight"].shape) == (512, 256, 1, 1)


def test_resnet18_takes_twelve_channels() -> None:
    """Rasters of 12x90x60 become 512 features."""
    assert ResNet18(12).eval()(torch.zeros(2, 12, 90, 60)).shape == (2, 512)


def test_other_numbers_of_features_are_reached_by_a_linear_layer() -> None:
    """ResNet18 with 64 features asked for gives 64."""
    assert make_encoder("resnet18", (3, 36, 24), 64).eval()(torch.zeros(1, 3, 36, 24)).shape == (
        1,
        64,
    )


def test_small_encoder_tells_places_apart() -> None:
    """The same patch at two places gives different features: nothing is averaged away."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = SmallEncoder((1, 90, 60), 16).eval()
    rasters = torch.zeros(2, 1, 90, 60)
    rasters[0, 0, 10:20, 10:20] = rasters[1, 0, 60:70, 40:50] = 1
    with torch.no_grad():
        here, there = network(rasters)
    assert float((here - there).abs().max()) > 1e-3

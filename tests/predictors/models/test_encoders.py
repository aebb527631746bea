"""Encoders: sizes, names, and that pictures reach the features."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from asp_env.errors import AspEnvError, CheckpointError
from predictors.models.encoders import (
    PictureEncoder,
    ResNet18,
    SmallEncoder,
    load_resnet18,
    make_encoder,
    unpack_bits,
)
from tests.predictors.tiny import tiny_shape


def norm(name: str, width: int) -> dict[str, tuple[int, ...]]:
    """A batch normalisation's entries."""
    vectors = ("weight", "bias", "running_mean", "running_var")
    return {f"{name}.{each}": (width,) for each in vectors} | {f"{name}.num_batches_tracked": ()}


def torchvisions(channels: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of torchvision's resnet18 without its classifier, for so many channels."""
    found: dict[str, tuple[int, ...]] = {"conv1.weight": (64, channels, 7, 7), **norm("bn1", 64)}
    before = 64
    for number, width in enumerate((64, 128, 256, 512), start=1):
        for block in (0, 1):
            name = f"layer{number}.{block}"
            found[f"{name}.conv1.weight"] = (width, before, 3, 3)
            found[f"{name}.conv2.weight"] = (width, width, 3, 3)
            found |= norm(f"{name}.bn1", width) | norm(f"{name}.bn2", width)
            if before != width:
                found[f"{name}.downsample.0.weight"] = (width, before, 1, 1)
                found |= norm(f"{name}.downsample.1", width)
            before = width
    return found


@pytest.mark.parametrize("channels", [3, 12])
def test_resnet18_has_torchvisions_parameters(channels: int) -> None:
    """All 120 names and shapes; 11,176,512 weights without the classifier for 3 channels."""
    network = ResNet18(channels)
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    assert shapes == torchvisions(channels)
    assert len(shapes) == 120
    weights = sum(parameter.numel() for parameter in network.parameters())
    assert weights == 11_176_512 + (channels - 3) * 64 * 49


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file as torchvision's weights for RGB pictures, with the classifier."""
    path = tmp_path_factory.mktemp("weights") / "resnet18.safetensors"
    tensors = {
        name: torch.full(shape, 0.25) if shape else torch.tensor(7)
        for name, shape in torchvisions(3).items()
    }
    save_file(tensors | {"fc.weight": torch.zeros(1000, 512), "fc.bias": torch.zeros(1000)}, path)
    return path


def encoder(
    name: str = "resnet18", view: str = "chauffeurnet", features: int = 8
) -> PictureEncoder:
    """For a view's small pictures."""
    made = make_encoder(name, tiny_shape(view), features)
    assert isinstance(made, PictureEncoder)
    return made


def test_weights_of_rgb_pictures_start_twelve_channels(weights: Path) -> None:
    """Everything is taken but the classifier and a first convolution of other channels."""
    made = encoder()
    first = made.body.get_parameter("conv1.weight").detach().clone()
    load_resnet18(made, weights)
    for name, value in made.body.state_dict().items():
        if name == "conv1.weight":
            assert torch.equal(value, first)
        elif value.ndim:
            assert (value == 0.25).all(), name
    rgb = encoder(view="mtp")
    load_resnet18(rgb, weights)
    assert (rgb.body.get_parameter("conv1.weight") == 0.25).all()


def test_unfitting_weights_are_one_line(weights: Path, tmp_path: Path) -> None:
    """A pickle, a missing or foreign or misshapen tensor, no file, or no ResNet18 to start."""
    good = load_file(weights)
    bad = tmp_path / "bad.safetensors"
    faults = {
        "layer4.1.bn2.bias does not fit": {
            n: v for n, v in good.items() if n != "layer4.1.bn2.bias"
        },
        "extra does not fit": good | {"extra": torch.zeros(1)},
        "holds no weights of a ResNet18": good | {"bn1.weight": torch.zeros(3)},
    }
    for message, tensors in faults.items():
        save_file(tensors, bad)
        with pytest.raises(CheckpointError, match=message):
            load_resnet18(encoder(), bad)
    bad.write_bytes(pickle.dumps(good))
    with pytest.raises(CheckpointError, match="cannot be read as safetensors") as caught:
        load_resnet18(encoder(), bad)
    assert "\n" not in str(caught.value)
    with pytest.raises(CheckpointError, match="cannot be read"):
        load_resnet18(encoder(), tmp_path / "none.safetensors")
    with pytest.raises(CheckpointError, match="has no resnet18"):
        load_resnet18(encoder("small"), weights)


def test_other_numbers_of_features_are_reached_by_a_linear_layer() -> None:
    """ResNet18 with 64 features asked for gives 64, with 512 its own."""
    pictures = torch.zeros(1, 3, 36, 36, dtype=torch.uint8)
    for features, linears in ((64, 1), (512, 0)):
        made = encoder("resnet18", "mtp", features).eval()
        assert made(pictures).shape == (1, features)
        assert sum(isinstance(each, torch.nn.Linear) for each in made.modules()) == linears


def test_small_encoder_tells_places_apart() -> None:
    """The same patch at two places gives different features: nothing is averaged away."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = SmallEncoder((1, 90, 60), 16).eval()
    pictures = torch.zeros(2, 1, 90, 60)
    pictures[0, 0, 10:20, 10:20] = pictures[1, 0, 60:70, 40:50] = 1
    with torch.no_grad():
        here, there = network(pictures)
    assert float((here - there).abs().max()) > 1e-3


@pytest.mark.parametrize("width", [1, 8, 24, 29])
def test_bits_are_unpacked_as_they_were_packed(width: int) -> None:
    """Pictures of 0 and 255 come back as 0 and 1, also where the last byte is not full."""
    pictures = np.random.default_rng(width).choice(np.array([0, 255], np.uint8), (2, 3, 4, width))
    packed = torch.from_numpy(np.packbits(pictures, axis=-1))
    assert torch.equal(unpack_bits(packed, width), torch.from_numpy(pictures // 255))


def test_packed_pictures_have_the_features_of_whole_ones() -> None:
    """The same network says the same of bits and of bytes of 0 and 255."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        bits = PictureEncoder("small", (2, 12, 20), 4, packed=True).eval()
    whole = PictureEncoder("small", (2, 12, 20), 4, packed=False).eval()
    whole.load_state_dict(bits.state_dict())
    pictures = np.random.default_rng(0).choice(np.array([0, 255], np.uint8), (3, 2, 12, 20))
    with torch.no_grad():
        one = bits(torch.from_numpy(np.packbits(pictures, axis=-1)))
        other = whole(torch.from_numpy(pictures))
    torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


def test_encoder_of_another_kind_of_view_is_refused() -> None:
    """Pictures are not read as vectors, nor vectors as pictures; unknown names are listed."""
    with pytest.raises(AspEnvError, match="reads pictures, the view draws vectors: take vector"):
        make_encoder("small", tiny_shape("vectors"), 8)
    with pytest.raises(AspEnvError, match="take resnet18 or small"):
        make_encoder("vector", tiny_shape(), 8)
    with pytest.raises(AspEnvError, match="did you mean 'resnet18'"):
        make_encoder("resnet", tiny_shape(), 8)

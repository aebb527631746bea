"""Raster encoders: sizes, names of weights, loading of ResNet18, packed rasters."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from asp_env.errors import AspEnvError, CheckpointError
from predictors.models.encoders import (
    RasterEncoder,
    ResNet18,
    SmallEncoder,
    load_resnet18,
    make_encoder,
    unpack_bits,
)
from tests.predictors.tiny import tiny_shape


def norm(name: str, width: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a batch normalisation's weights."""
    vectors = ("weight", "bias", "running_mean", "running_var")
    return {f"{name}.{each}": (width,) for each in vectors} | {f"{name}.num_batches_tracked": ()}


def torchvision_shapes(channels: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of torchvision's resnet18 without its classifier."""
    shapes: dict[str, tuple[int, ...]] = {"conv1.weight": (64, channels, 7, 7), **norm("bn1", 64)}
    before = 64
    for number, width in enumerate((64, 128, 256, 512), start=1):
        for block in (0, 1):
            name = f"layer{number}.{block}"
            shapes[f"{name}.conv1.weight"] = (width, before, 3, 3)
            shapes[f"{name}.conv2.weight"] = (width, width, 3, 3)
            shapes |= norm(f"{name}.bn1", width) | norm(f"{name}.bn2", width)
            if before != width:
                shapes[f"{name}.downsample.0.weight"] = (width, before, 1, 1)
                shapes |= norm(f"{name}.downsample.1", width)
            before = width
    return shapes


@pytest.mark.parametrize("channels", [3, 12])
def test_resnet18_has_torchvisions_parameters(channels: int) -> None:
    """All 120 names and shapes; 11,176,512 weights without the classifier for 3 channels."""
    network = ResNet18(channels)
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    assert shapes == torchvision_shapes(channels)
    assert len(shapes) == 120
    weights = sum(parameter.numel() for parameter in network.parameters())
    assert weights == 11_176_512 + (channels - 3) * 64 * 49


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file as torchvision's weights for RGB rasters, with the classifier."""
    path = tmp_path_factory.mktemp("weights") / "resnet18.safetensors"
    tensors = {
        name: torch.full(shape, 0.25) if shape else torch.tensor(7)
        for name, shape in torchvision_shapes(3).items()
    }
    save_file(tensors | {"fc.weight": torch.zeros(1000, 512), "fc.bias": torch.zeros(1000)}, path)
    return path


def encoder(name: str = "resnet18", view: str = "chauffeurnet", features: int = 8) -> RasterEncoder:
    """An encoder for a view's small rasters."""
    made = make_encoder(name, tiny_shape(view), features)
    assert isinstance(made, RasterEncoder)
    return made


def test_weights_for_rgb_are_loaded_for_twelve_channels(weights: Path) -> None:
    """All weights are loaded except the classifier and a first convolution of other channels."""
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


def test_weights_that_do_not_fit_are_refused(weights: Path, tmp_path: Path) -> None:
    """A pickle, a missing, unknown or misshapen tensor, no file, or a network without ResNet18."""
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


def test_other_numbers_of_features_need_a_linear_layer() -> None:
    """A linear layer follows ResNet18 for 64 features, none for its own 512."""
    rasters = torch.zeros(1, 3, 36, 36, dtype=torch.uint8)
    for features, linears in ((64, 1), (512, 0)):
        made = encoder("resnet18", "mtp", features).eval()
        assert made(rasters).shape == (1, features)
        assert sum(isinstance(each, torch.nn.Linear) for each in made.modules()) == linears


def test_small_encoder_distinguishes_positions() -> None:
    """The same patch at two positions has different features."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = SmallEncoder((1, 90, 60), 16).eval()
    rasters = torch.zeros(2, 1, 90, 60)
    rasters[0, 0, 10:20, 10:20] = rasters[1, 0, 60:70, 40:50] = 1
    with torch.no_grad():
        one, other = network(rasters)
    assert float((one - other).abs().max()) > 1e-3


@pytest.mark.parametrize("width", [1, 8, 24, 29])
def test_unpacking_inverts_packing(width: int) -> None:
    """Rasters of 0 and 255 become 0 and 1, also if the last byte is not full."""
    rasters = np.random.default_rng(width).choice(np.array([0, 255], np.uint8), (2, 3, 4, width))
    packed = torch.from_numpy(np.packbits(rasters, axis=-1))
    assert torch.equal(unpack_bits(packed, width), torch.from_numpy(rasters // 255))


def test_packed_rasters_have_the_same_features() -> None:
    """The same weights give the same features of bits and of bytes of 0 and 255."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        bits = RasterEncoder("small", (2, 12, 20), 4, packed=True).eval()
    unpacked = RasterEncoder("small", (2, 12, 20), 4, packed=False).eval()
    unpacked.load_state_dict(bits.state_dict())
    rasters = np.random.default_rng(0).choice(np.array([0, 255], np.uint8), (3, 2, 12, 20))
    with torch.no_grad():
        one = bits(torch.from_numpy(np.packbits(rasters, axis=-1)))
        other = unpacked(torch.from_numpy(rasters))
    torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


def test_encoder_that_does_not_fit_the_view_is_refused() -> None:
    """A raster encoder for vectors, a vector encoder for rasters, and an unknown name."""
    with pytest.raises(AspEnvError, match="reads rasters, the view renders vectors: take vector"):
        make_encoder("small", tiny_shape("vectors"), 8)
    with pytest.raises(AspEnvError, match="take resnet18 or small"):
        make_encoder("vector", tiny_shape(), 8)
    with pytest.raises(AspEnvError, match="did you mean 'resnet18'"):
        make_encoder("resnet", tiny_shape(), 8)

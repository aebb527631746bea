"""Packing binary pictures to bits and back."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.errors import AspEnvError
from asp_env.views.chauffeurnet import ChauffeurNet
from asp_env.views.draw import pack_bits, unpack_bits
from asp_env.views.view import View
from tests.views.scenes import COARSE, busy_scene


def test_bits_by_hand() -> None:
    """Of ten pixels the first, the eighth and the last are set: 1000 0001 and 0100 0000."""
    picture = np.zeros((1, 1, 1, 10), dtype=np.uint8)
    picture[..., [0, 7, 9]] = 255
    assert pack_bits(picture).tolist() == [[[[0b10000001, 0b01000000]]]]


@given(
    shape=st.tuples(*[st.integers(0, 3)] * 2, st.integers(1, 4), st.integers(1, 40)),
    seed=st.integers(0, 1000),
    share=st.sampled_from([0.0, 0.1, 0.5, 1.0]),
)
def test_round_trip(shape: tuple[int, int, int, int], seed: int, share: float) -> None:
    """Unpacking gives the same pictures; the bits are those of NumPy, along rows."""
    pictures = np.where(np.random.default_rng(seed).random(shape) < share, 255, 0).astype(np.uint8)
    packed = pack_bits(pictures)
    np.testing.assert_array_equal(packed, np.packbits(pictures, axis=-1))
    again = unpack_bits(packed, shape[-1])
    assert again.dtype == np.uint8
    np.testing.assert_array_equal(again, pictures)


def test_pictures_that_do_not_lie_together() -> None:
    """Every other picture of a batch, upside down, is packed like a copy of it."""
    pictures = COARSE.draw(busy_scene())[::2, :, ::-1]
    np.testing.assert_array_equal(pack_bits(pictures), pack_bits(pictures.copy()))


@pytest.mark.parametrize("width_px", [7, 16, 17, 24])
def test_another_width_is_refused(width_px: int) -> None:
    """Two bytes hold 9 to 16 pixels; but for 16 the widths given need another number of bytes."""
    packed = np.zeros((1, 1, 1, 2), dtype=np.uint8)
    if width_px == 16:
        assert unpack_bits(packed, width_px).shape == (1, 1, 1, 16)
        return
    with pytest.raises(AspEnvError, match="do not hold"):
        unpack_bits(packed, width_px)


@pytest.mark.parametrize("width_px", [1, 5, 8, 60, 63, 64, 240])
@pytest.mark.parametrize("ego_trail", [True, False])
def test_drawn_packed_equals_packed_afterwards(width_px: int, ego_trail: bool) -> None:
    """Bit for bit, for widths that fill their last byte and those that do not."""
    view = dataclasses.replace(View(), width_px=width_px, anchor_column_px=0.5 * width_px)
    drawer = ChauffeurNet(view, ego_trail)
    scene = busy_scene()
    scene.valid[0, 3, -1] = False  # one of the targets is not there
    np.testing.assert_array_equal(drawer.draw_packed(scene), pack_bits(drawer.draw(scene)))

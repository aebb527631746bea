"""Binary pictures as bits: an eighth of the memory on the way from drawing to a network.

Rows are packed one by one, the first pixel into the highest bit (the order of `np.packbits`); the
last byte of a row is filled up with zeros.
"""

import numpy as np
from jaxtyping import UInt8

from asp_env.errors import AspEnvError
from asp_env.views.draw import pack_rows


def pack_bits(pictures: UInt8[np.ndarray, "n c h w"]) -> UInt8[np.ndarray, "n c h bytes"]:
    """Packs pixels of 0 or 255 to bits; the width becomes ⌈width / 8⌉.

    A binary view's `draw_packed` gives the same without drawing bytes first, which is faster.
    """
    *shape, width_px = pictures.shape
    packed = np.empty((*shape, -(-width_px // 8)), dtype=np.uint8)
    rows = np.ascontiguousarray(pictures).reshape(-1, width_px)
    pack_rows(rows, packed.reshape(len(rows), packed.shape[-1]))
    return packed


def unpack_bits(
    packed: UInt8[np.ndarray, "n c h bytes"], width_px: int
) -> UInt8[np.ndarray, "n c h w"]:
    """The pictures of which `pack_bits` or `draw_packed` made these bits, 0 or 255.

    Args:
        packed: bits.
        width_px: of the pictures.

    Raises:
        AspEnvError: rows of that width take another number of bytes.
    """
    if packed.shape[-1] != -(-width_px // 8):
        raise AspEnvError(
            f"rows of {packed.shape[-1]} bytes do not hold {width_px} pixels: expected "
            f"{-(-width_px // 8)} bytes, 8 pixels each"
        )
    # 0 - 1 is 255 in bytes.
    return np.negative(np.unpackbits(packed, axis=-1, count=width_px))

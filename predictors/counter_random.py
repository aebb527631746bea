"""Random numbers as functions of a stream and a counter, without a state.

Equal arguments give equal numbers, so that they depend neither on the order in which they are drawn
nor on which others are drawn with them. The hash is SplitMix64 (Steele, Lea and Flood 2014).
"""

import math

import numpy as np
from jaxtyping import Float, Int, UInt64

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_SHIFTS = tuple(np.uint64(bits) for bits in (30, 27, 31))
_FACTORS = (np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB))


def mixed(bits: UInt64[np.ndarray, "*n"]) -> UInt64[np.ndarray, "*n"]:
    """The output function of SplitMix64, a hash of 64 bits."""
    bits = bits + _GAMMA
    for shift, factor in zip(_SHIFTS[:2], _FACTORS, strict=True):
        bits = (bits ^ (bits >> shift)) * factor
    return bits ^ (bits >> _SHIFTS[2])


def uniform(
    streams: UInt64[np.ndarray, "*#n"], counters: Int[np.ndarray, "*#n"]
) -> Float[np.ndarray, "*n"]:
    """Uniform numbers in [0, 1).

    Args:
        streams: Stream of each number; both arguments are broadcast.
        counters: Number within its stream.
    """
    return (_bits(streams, counters) >> np.uint64(11)).astype(np.float64) * 2.0**-53


def nearly_normal(
    streams: UInt64[np.ndarray, "*#n"], counters: Int[np.ndarray, "*#n"]
) -> Float[np.ndarray, "*n"]:
    """Nearly normal numbers of mean 0 and variance 1: sums of four uniform 16-bit numbers.

    They lie within ±3.5.

    Args:
        streams: Stream of each number; both arguments are broadcast.
        counters: Number within its stream.
    """
    bits = _bits(streams, counters)
    total = sum((bits >> np.uint64(shift)) & np.uint64(0xFFFF) for shift in (0, 16, 32, 48))
    return (np.asarray(total, dtype=np.float64) / 2**16 - 2 + 2 / 2**16) * math.sqrt(3)


def _bits(
    streams: UInt64[np.ndarray, "*#n"], counters: Int[np.ndarray, "*#n"]
) -> UInt64[np.ndarray, "*n"]:
    return mixed(streams + counters.astype(np.int64).view(np.uint64) * _GAMMA)

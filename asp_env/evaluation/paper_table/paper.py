"""The table of Janjoš, Dolgov and Zöllner (2021): on inD and rounD, 3 s and 6 s."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

DATA = ("inD", "rounD")
HORIZONS_S = (3.0, 6.0)
CAVEAT = "other data, not comparable in size"


class Numbers(NamedTuple):
    """Metres; MSE square metres."""

    mae: float
    mse: float
    fde: float


Line = tuple[Numbers, Numbers, Numbers, Numbers]


def _line(*numbers: tuple[float, float, float]) -> Line:
    first, second, third, fourth = (Numbers(*each) for each in numbers)
    return first, second, third, fourth


PAPER: Mapping[tuple[str, str], Line] = MappingProxyType(
    {
        ("chauffeurnet", "dkm"): _line(
            (0.48, 0.86, 2.01), (1.27, 7.44, 5.91), (0.29, 0.29, 1.12), (1.35, 7.22, 5.55)
        ),
        ("chauffeurnet", "ffw-asp"): _line(
            (0.27, 0.33, 1.23), (1.13, 6.42, 5.45), (0.22, 0.18, 0.93), (1.12, 6.17, 5.08)
        ),
        ("chauffeurnet", "ssp-asp"): _line(
            (0.21, 0.24, 0.98), (1.23, 6.52, 5.15), (0.17, 0.12, 0.73), (1.34, 6.44, 4.69)
        ),
        ("mtp", "dkm"): _line(
            (0.58, 1.19, 2.36), (1.34, 7.89, 6.29), (0.29, 0.28, 1.22), (1.25, 6.13, 5.51)
        ),
        ("mtp", "ffw-asp"): _line(
            (0.30, 0.39, 1.41), (1.19, 6.78, 5.72), (0.22, 0.18, 0.94), (1.08, 5.84, 4.76)
        ),
        ("mtp", "ssp-asp"): _line(
            (0.22, 0.25, 1.04), (1.15, 6.08, 5.02), (0.17, 0.12, 0.74), (1.25, 7.08, 4.61)
        ),
    }
)
"""By view and predictor: inD 3 s, inD 6 s, rounD 3 s, rounD 6 s."""


def paper_numbers(view: str, predictor: str, site: int, horizon_s: float) -> Numbers | None:
    """What the paper has at a place of its table; None where it has nothing.

    Args:
        view: of the table.
        predictor: of the table.
        site: 0 is inD, 1 is rounD.
        horizon_s: seconds.
    """
    line = PAPER.get((view, predictor))
    if line is None or site >= len(DATA) or horizon_s not in HORIZONS_S:
        return None
    return line[site * len(HORIZONS_S) + HORIZONS_S.index(horizon_s)]

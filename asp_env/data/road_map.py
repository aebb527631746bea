"""Road maps: boundaries, drivable area and lanes, in the metric frame of a recording."""

import hashlib
from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.errors import DataError


class LineType(IntEnum):
    """Type of a polyline of the map."""

    CURB = 0
    SOLID = 1
    DASHED = 2
    VIRTUAL = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Ragged:
    """Sequences of points of different lengths, stored back to back."""

    points: Float[np.ndarray, "points 2"]
    """All points, metres."""
    starts: Int[np.ndarray, " bounds"]
    """Sequence i is `points[starts[i]:starts[i + 1]]`."""

    def __len__(self) -> int:
        return len(self.starts) - 1

    def __getitem__(self, index: int) -> np.ndarray:
        """Points (n, 2) of one sequence, metres."""
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        index %= len(self)
        return self.points[self.starts[index] : self.starts[index + 1]]

    @classmethod
    def pack(cls, sequences: "list[np.ndarray]") -> "Ragged":
        """Stores arrays of shape (n_i, 2) back to back."""
        lengths = [len(sequence) for sequence in sequences]
        points = np.concatenate(sequences) if sequences else np.zeros((0, 2))
        return cls(
            points=points.astype(np.float64),
            starts=np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)]).astype(np.int64),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadMap:
    """Boundaries and lane markings, drivable area, and lanes with their successors."""

    name: str
    lines: Ragged
    """Polylines of boundaries and lane markings."""
    line_types: Int[np.ndarray, " lines"]
    """`LineType` of each polyline."""
    drivable: Ragged
    """Rings, not closed, whose union is the drivable area."""
    lanes: Ragged
    """Centre lines of the vehicle lanes, in the direction of travel."""
    successors: Int[np.ndarray, "edges 2"]
    """(lane, next lane), indices into `lanes`."""
    areas: Ragged = field(default_factory=lambda: Ragged.pack([]))
    """Ring, not closed, that each lane covers; empty if only centre lines are known."""
    two_way: Bool[np.ndarray, " areas"] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    """Mask of the lanes that may be driven in both directions."""
    limits_mps: Float[np.ndarray, " areas"] = field(default_factory=lambda: np.zeros(0))
    """Speed limit of each lane, where `limited`."""
    limited: Bool[np.ndarray, " areas"] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    """Mask of the lanes whose speed limit is in the map."""
    region_m: tuple[float, float, float, float] | None = None
    """Smallest x and y, largest x and y of the part of a larger map that this map covers; None if
    it is the whole map. Lanes and lines that reach out of the region are complete."""
    repairs: tuple[str, ...] = ()
    """Repairs made by the reader, one line for each kind."""
    _geometry_hash: bytes = field(default=b"", init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Checks that the numbers of lines, lanes and their properties agree.

        Raises:
            DataError: they do not.
        """
        if len(self.line_types) != len(self.lines):
            raise DataError(
                f"map {self.name}: {len(self.lines)} lines but {len(self.line_types)} line types"
            )
        if self.successors.size and self.successors.max() >= len(self.lanes):
            raise DataError(
                f"map {self.name}: a successor names lane {self.successors.max()} "
                f"of {len(self.lanes)}"
            )
        columns = (self.areas, self.two_way, self.limits_mps, self.limited)
        counts = {len(column) for column in columns}
        if counts not in ({0}, {len(self.lanes)}):
            raise DataError(
                f"map {self.name}: {sorted(counts)} areas, directions and limits of lanes; "
                f"expected one of each for all {len(self.lanes)} lanes, or none"
            )

    def __deepcopy__(self, memo: dict[int, Any]) -> "RoadMap":
        """The same object: maps are immutable."""
        del memo
        return self

    @property
    def geometry_hash(self) -> bytes:
        """Hash of everything except name and repairs, computed once."""
        if not self._geometry_hash:
            seen = hashlib.blake2b(repr(self.region_m).encode(), digest_size=16)
            for each in fields(self):
                value = getattr(self, each.name)
                for array in (
                    (value.points, value.starts) if isinstance(value, Ragged) else (value,)
                ):
                    if isinstance(array, np.ndarray):
                        seen.update(f"{each.name}{array.dtype}{array.shape}".encode())
                        seen.update(np.ascontiguousarray(array).data)
            object.__setattr__(self, "_geometry_hash", seen.digest())
        return self._geometry_hash

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Smallest x and y, largest x and y of lines and drivable area in the region, metres."""
        points = np.concatenate([self.lines.points, self.drivable.points])
        if not len(points):
            return (0.0, 0.0, 1.0, 1.0)
        low, high = points.min(axis=0), points.max(axis=0)
        if self.region_m is not None:
            low, high = np.maximum(low, self.region_m[:2]), np.minimum(high, self.region_m[2:])
        return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))

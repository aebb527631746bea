"""Where metric frames lie on the globe."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from pyproj import Transformer


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """Where a recording's metric frame lies: local = UTM(lat, lon) - (x, y)."""

    x_m: float
    y_m: float
    longitude_deg: float
    """Somewhere at the place: it tells the zone."""
    latitude_deg: float

    @property
    def epsg(self) -> int:
        """The code of the UTM zone."""
        zone = int((self.longitude_deg + 180.0) // 6.0) % 60 + 1
        return (32600 if self.latitude_deg >= 0 else 32700) + zone

    @classmethod
    def at(cls, *, latitude_deg: float, longitude_deg: float) -> "Origin":
        """The frame whose origin is a point on the globe."""
        here = cls(x_m=0.0, y_m=0.0, longitude_deg=longitude_deg, latitude_deg=latitude_deg)
        ((x_m, y_m),) = project(np.array([latitude_deg]), np.array([longitude_deg]), here)
        return cls(
            x_m=float(x_m), y_m=float(y_m), longitude_deg=longitude_deg, latitude_deg=latitude_deg
        )


def project(
    latitudes_deg: Float[np.ndarray, " n"], longitudes_deg: Float[np.ndarray, " n"], origin: Origin
) -> Float[np.ndarray, "n 2"]:
    """Points in the frame that `origin` describes, metres."""
    utm = Transformer.from_crs(4326, origin.epsg, always_xy=True)
    x_m, y_m = utm.transform(longitudes_deg, latitudes_deg)
    return np.stack([np.asarray(x_m) - origin.x_m, np.asarray(y_m) - origin.y_m], axis=-1)

"""Local NED to latitude and longitude, flat around the origin."""

from __future__ import annotations

import math
from dataclasses import dataclass

from uavctl.data import Vec3

EARTH_M = 6378137.0
LARGEST_E7 = 2**31 - 1


@dataclass(frozen=True)
class Origin:
    """Where local NED has its zero."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    def degrees_e7(self, place_m: Vec3) -> tuple[int, int]:
        """Latitude and longitude of a place, as MAVLink has them [1e-7 degrees]."""
        lat = self.latitude_deg + math.degrees(place_m[0] / EARTH_M)
        lon = self.longitude_deg + math.degrees(place_m[1] / (EARTH_M * self._shrink))
        return _clipped(1e7 * lat), _clipped(1e7 * lon)

    def altitude_mm(self, place_m: Vec3) -> int:
        """Height of a place above the sea [mm]."""
        return _clipped(1000.0 * (self.altitude_m - place_m[2]))

    def local_m(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> Vec3:
        """Local NED of a place on the globe."""
        return (
            math.radians(latitude_deg - self.latitude_deg) * EARTH_M,
            math.radians(longitude_deg - self.longitude_deg) * EARTH_M * self._shrink,
            self.altitude_m - altitude_m,
        )

    @property
    def _shrink(self) -> float:
        return max(math.cos(math.radians(self.latitude_deg)), 1e-3)


def _clipped(value: float) -> int:
    return min(max(round(value), -LARGEST_E7 - 1), LARGEST_E7)

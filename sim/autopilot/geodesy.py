"""Conversion between local NED and latitude and longitude, flat around the origin."""

from __future__ import annotations

import math
from dataclasses import dataclass

from uavctl.records import Vec3

EARTH_M = 6378137.0
MAX_E7 = 2**31 - 1


@dataclass(frozen=True)
class GeodeticOrigin:
    """Geographic position of local NED's zero."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    def compute_degrees_e7(self, position_m: Vec3) -> tuple[int, int]:
        """Return latitude and longitude of a place, in MAVLink's unit [1e-7 degrees]."""
        lat = self.latitude_deg + math.degrees(position_m[0] / EARTH_M)
        lon = self.longitude_deg + math.degrees(position_m[1] / (EARTH_M * self._longitude_scale))
        return _clip_e7(1e7 * lat), _clip_e7(1e7 * lon)

    def compute_altitude_mm(self, position_m: Vec3) -> int:
        """Return the height of a place above the sea [mm]."""
        return _clip_e7(1000.0 * (self.altitude_m - position_m[2]))

    def compute_local_m(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> Vec3:
        """Return a place on the globe in local NED [m]."""
        return (
            math.radians(latitude_deg - self.latitude_deg) * EARTH_M,
            math.radians(longitude_deg - self.longitude_deg) * EARTH_M * self._longitude_scale,
            self.altitude_m - altitude_m,
        )

    @property
    def _longitude_scale(self) -> float:
        return max(math.cos(math.radians(self.latitude_deg)), 1e-3)


def _clip_e7(value: float) -> int:
    return min(max(round(value), -MAX_E7 - 1), MAX_E7)

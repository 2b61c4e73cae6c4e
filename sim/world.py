"""Effects of simulated vehicles on each other: downwash and collisions.

Sources of the downwash:

* Shi: G. Shi, W. Hönig, Y. Yue, S.-J. Chung, Neural-Swarm, ICRA 2020 (arXiv 2003.02992), Fig. 3, as read by other
  public simulators: a Crazyflie of 34 g is pushed down by 10, 8, 6, 4 g at 0.2, 0.3, 0.4, 0.5 m below another one.
* Bauersfeld: L. Bauersfeld and others, Robotics meets Fluid Dynamics, RA-L 2024 (arXiv 2403.13321): the flow below a
  quadrotor is a turbulent jet, whose distances scale with the vehicle's size.
* Pope: S. B. Pope, Turbulent Flows, 2000: the half-width of a round jet grows by a tenth of the distance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Protocol

from sim.vehicle.airframe import GRAVITY_MPS2
from uavctl.errors import ConfigError
from uavctl.records import ClosestApproach, Collision, Vec3

# At 4 m/s two vehicles move 40 mm towards each other in a period; their path in it is taken as straight, which at
# 20 m/s² is off by 0.3 mm.
PERIOD_NS = 10_000_000
# Shi: (14 - 20 d) g of 34 g at the depth d [m] below a vehicle with a radius of 0.07 m; Bauersfeld: d counts in radii.
DOWNWASH_SHARE = 7.0 / 17.0
DOWNWASH_REACH_RADII = 10.0
JET_SPREAD = 0.1  # Pope
# Beyond three half-widths the force is below 1/500 of that on the axis, and taken as zero.
DOWNWASH_HALF_WIDTHS = 3.0

OnCollision = Callable[[Collision], None]


class InteractingVehicle(Protocol):
    """A vehicle as others meet it; vectors are local NED."""

    @property
    def position_m(self) -> Vec3:
        """True position [m]."""
        ...

    @property
    def is_wrecked(self) -> bool:
        """Whether a collision broke its rotors."""
        ...

    @property
    def has_downwash(self) -> bool:
        """Whether its rotors carry it in the air."""
        ...

    def wreck(self) -> None:
        """Break its rotors: it falls, and flies no more."""

    def set_downwash(self, accel_mps2: float) -> None:
        """Set the downward acceleration by the downwash of others, from now on [m/s²]."""


@dataclass(frozen=True)
class WorldBody:
    """A vehicle in a world of several."""

    system_id: int  # MAVLink system id
    vehicle: InteractingVehicle
    radius_m: float  # of the sphere that holds rotors and body
    downwash: float  # factor of the force by the downwash of others


def compute_downwash_share(upper_m: Vec3, lower_m: Vec3, radius_m: float) -> float:
    """Return the downward force on a vehicle below another one, as a share of the lower one's weight.

    With depth d, horizontal distance r and radius ρ of the upper one: 7/17 (1 - d / 10ρ) 2^(-(r / h)²), h = ρ + d/10.
    """
    depth_m = lower_m[2] - upper_m[2]
    reach_m = DOWNWASH_REACH_RADII * radius_m
    if not 0.0 < depth_m < reach_m:
        return 0.0
    half_widths = math.hypot(lower_m[0] - upper_m[0], lower_m[1] - upper_m[1]) / (radius_m + JET_SPREAD * depth_m)
    if half_widths > DOWNWASH_HALF_WIDTHS:
        return 0.0
    return DOWNWASH_SHARE * (1.0 - depth_m / reach_m) * math.exp2(-half_widths * half_widths)


def compute_segment_approach(start_m: Vec3, end_m: Vec3) -> tuple[float, float]:
    """Return the least distance [m] of a relative position that moves straight, and the part of the way to it.

    With r(s) = r₀ + s Δ: s = -r₀·Δ / Δ·Δ, within 0 and 1.
    """
    step = _subtract(end_m, start_m)
    square = _dot(step, step)
    part = min(max(-_dot(start_m, step) / square, 0.0), 1.0) if square > 0.0 else 0.0
    return math.hypot(*(r + part * d for r, d in zip(start_m, step, strict=True))), part


def compute_contact_part(start_m: Vec3, end_m: Vec3, contact_m: float) -> float:
    """Return the part of a straight way at which a distance first falls to `contact_m`; it does on this way.

    The smaller root of |r₀ + s Δ|² = c²: s = (-b - √(b² - a (r₀·r₀ - c²))) / a with a = Δ·Δ, b = r₀·Δ.
    """
    step = _subtract(end_m, start_m)
    a, b, excess = _dot(step, step), _dot(start_m, step), _dot(start_m, start_m) - contact_m * contact_m
    if excess <= 0.0 or a == 0.0:
        return 0.0
    return min(max((-b - math.sqrt(max(b * b - a * excess, 0.0))) / a, 0.0), 1.0)


def _subtract(a: Vec3, b: Vec3) -> Vec3:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _dot(a: Vec3, b: Vec3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def check_start_distances(bodies: Sequence[WorldBody]) -> None:
    """Refuse vehicles that touch at the start.

    Raises:
        ConfigError: with all pairs that do.
    """
    problems = []
    for first, second in combinations(bodies, 2):
        distance_m = math.dist(first.vehicle.position_m, second.vehicle.position_m)
        contact_m = first.radius_m + second.radius_m
        if distance_m < contact_m:
            problems.append(
                f"sim.start_position_m: vehicles {first.system_id} and {second.system_id} start {distance_m:.2f} m "
                f"apart, nearer than their radii (sim.radius_m) allow, {contact_m:.2f} m; move one, or reduce the radii"
            )
    if problems:
        raise ConfigError(tuple(problems))


class Interactions:
    """Downwash and collisions of the vehicles of one world, computed every 10 ms from `start_ns` on.

    Between two computations the force is held, and each vehicle's path is taken as straight. A vehicle that touches
    another one is wrecked, and so is the other; no momentum passes between them.

    Attributes:
        next_ns: time of the next computation; all vehicles have moved there before it.
        collisions: all collisions so far, in order of time.

    Raises:
        ConfigError: vehicles touch at the start.
    """

    def __init__(self, bodies: Sequence[WorldBody], start_ns: int, on_collision: OnCollision | None = None) -> None:
        check_start_distances(bodies)
        self.next_ns = self._start_ns = start_ns
        self.collisions: list[Collision] = []
        self._bodies = tuple(bodies)
        self._on_collision = on_collision
        self._pairs = tuple(combinations(range(len(bodies)), 2))
        self._positions_m = tuple(body.vehicle.position_m for body in bodies)
        self._closest: dict[tuple[int, int], tuple[float, int]] = {}

    @property
    def closest_approaches(self) -> tuple[ClosestApproach, ...]:
        """Least distance of each pair so far, in order of the pairs."""
        return tuple(
            ClosestApproach(
                at_ns=at_ns,
                vehicles=(self._bodies[first].system_id, self._bodies[second].system_id),
                distance_m=distance_m,
            )
            for (first, second), (distance_m, at_ns) in sorted(self._closest.items())
        )

    def run(self) -> None:
        """Find the collisions since the last computation, and set the forces until the next one."""
        positions_m = tuple(body.vehicle.position_m for body in self._bodies)
        contacts = sorted(self._find_contacts(positions_m))
        for _, (first, second), collision in contacts:
            for number in (first, second):
                self._bodies[number].vehicle.wreck()
            self.collisions.append(collision)
            if self._on_collision is not None:
                self._on_collision(collision)
        self._positions_m = positions_m
        self._set_downwash()
        self.next_ns += PERIOD_NS

    def _find_contacts(self, positions_m: Sequence[Vec3]) -> Iterator[tuple[int, tuple[int, int], Collision]]:
        """Yield time, pair and record of each collision, and note how near all pairs came."""
        for pair in self._pairs:
            first, second = (self._bodies[number] for number in pair)
            if first.vehicle.is_wrecked and second.vehicle.is_wrecked:
                continue
            start_m, end_m = (_subtract(where[pair[1]], where[pair[0]]) for where in (self._positions_m, positions_m))
            distance_m, part = compute_segment_approach(start_m, end_m)
            if pair not in self._closest or distance_m < self._closest[pair][0]:
                self._closest[pair] = distance_m, self._get_time_ns(part)
            contact_m = first.radius_m + second.radius_m
            if distance_m < contact_m:
                at_ns = self._get_time_ns(compute_contact_part(start_m, end_m, contact_m))
                collision = Collision(
                    at_ns=at_ns,
                    vehicles=(first.system_id, second.system_id),
                    distance_m=distance_m,
                    speed_mps=math.dist(start_m, end_m) / (PERIOD_NS * 1e-9),
                )
                yield at_ns, pair, collision

    def _get_time_ns(self, part: float) -> int:
        return max(self.next_ns - round((1.0 - part) * PERIOD_NS), self._start_ns)

    def _set_downwash(self) -> None:
        shares = [0.0] * len(self._bodies)
        for pair in self._pairs:
            for upper, lower in (pair, pair[::-1]):
                body = self._bodies[upper]
                if self._positions_m[upper][2] < self._positions_m[lower][2] and body.vehicle.has_downwash:
                    shares[lower] += compute_downwash_share(
                        self._positions_m[upper], self._positions_m[lower], body.radius_m
                    )
        for body, share in zip(self._bodies, shares, strict=True):
            body.vehicle.set_downwash(body.downwash * share * GRAVITY_MPS2)

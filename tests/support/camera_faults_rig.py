"""Flights between walls with everyday faults of cameras: positions that are right on the whole."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
from deception_rig import DeceivedFlight, choose_plant, fly_deceived, prepare_believed

from sim.cameras import Cameras
from sim.simulation import World
from uavctl.arrays import Array
from uavctl.config import Config, load_config
from uavctl.flight.controller import Controller
from uavctl.frames import Quaternion
from uavctl.records import Vec3

BEGIN_S, DURATION_S = 3.0, 23.0
SMOOTHING_S = 0.2
FAULTS = (
    *("two-10cm", "two-20cm", "two-30cm"),  # two solutions so far apart, each for 0.2 to 2 s
    *("burst-apart", "burst-together"),  # 5 to 20 samples 0.3 to 3 m away, each 3 to 6 s: anywhere, or at one place
    *("heavy-1cm", "heavy-2cm", "heavy-3cm"),  # noise with Student's t distribution of 3 degrees of freedom
    "white-5cm",  # noise with a normal distribution
    *("average", "first-order"),  # smoothing over 0.2 s
)


class CameraFault:
    """Everyday fault of a camera system; it changes positions one after the other.

    Args:
        kind: One of `FAULTS`.
    """

    def __init__(self, kind: str, rng: np.random.Generator) -> None:
        self._kind, self._rng = kind, rng
        self._next_s = 0.0  # time of the next switch or burst
        self._is_second = False
        self._left = 0  # samples left of a burst
        self._offset = self._draw_offset()
        self._kept: deque[tuple[float, Array]] = deque()
        self._smooth: tuple[float, Array] | None = None

    def distort(self, at_s: float, position_m: Array) -> Array:
        """Return the position that is sent."""
        name, _, size = self._kind.partition("-")
        match name:
            case "two":
                return self._switch(at_s, position_m, 0.01 * float(size.removesuffix("cm")))
            case "burst":
                return self._burst(at_s, position_m, together=size == "together")
            case "heavy":
                return position_m + 0.01 * float(size.removesuffix("cm")) * self._rng.standard_t(3, 3)
            case "white":
                return position_m + 0.01 * float(size.removesuffix("cm")) * self._rng.standard_normal(3)
            case "average":
                self._kept.append((at_s, position_m))
                while self._kept[0][0] <= at_s - SMOOTHING_S:
                    self._kept.popleft()
                mean: Array = np.mean([kept_m for _, kept_m in self._kept], axis=0)
                return mean
        before_s, before_m = self._smooth or (at_s, position_m)
        smooth_m: Array = before_m + (1.0 - math.exp(-(at_s - before_s) / SMOOTHING_S)) * (position_m - before_m)
        self._smooth = at_s, smooth_m
        return smooth_m

    def _switch(self, at_s: float, position_m: Array, apart_m: float) -> Array:
        if at_s >= self._next_s:
            self._is_second = not self._is_second
            self._next_s = at_s + float(self._rng.uniform(0.2, 2.0))
        return position_m + self._is_second * apart_m * self._offset

    def _burst(self, at_s: float, position_m: Array, *, together: bool) -> Array:
        if at_s >= self._next_s:
            self._left, self._next_s = int(self._rng.integers(5, 21)), at_s + float(self._rng.uniform(3.0, 6.0))
            self._offset = float(self._rng.uniform(0.3, 3.0)) * self._draw_offset()
        if self._left == 0:
            return position_m
        self._left -= 1
        offset_m = self._offset if together else float(self._rng.uniform(0.3, 3.0)) * self._draw_offset()
        return position_m + offset_m

    def _draw_offset(self) -> Array:
        """Draw a direction."""
        normal = self._rng.standard_normal(3)
        direction: Array = normal / np.linalg.norm(normal)
        return direction


def distort_cameras(cameras: Cameras, kind: str, seed: int) -> None:
    """Let cameras have an everyday fault: jumps from `BEGIN_S` on, the others from the start."""
    capture, fault = cameras.capture, CameraFault(kind, np.random.default_rng([seed, 100]))

    def capture_distorted(position_m: Vec3, velocity_mps: Vec3, attitude: Quaternion) -> Any:
        at_s = cameras.next_ns * 1e-9
        if at_s >= BEGIN_S or not kind.startswith(("two", "burst")):
            north, east, down = map(float, fault.distort(at_s, np.array(position_m)))
            position_m = north, east, down
        return capture(position_m, velocity_mps, attitude)

    cameras.capture = capture_distorted  # type: ignore[method-assign]


def draw_pair(
    seed: int, preset: str, autopilot: str, *more: str, plant: str = "quadrotor"
) -> tuple[Config, Config, Controller]:
    """Draw a flight between the corners of a room in gusts of 3 m/s: its world, and what the controller believes."""
    rng = np.random.default_rng([seed, 41])
    believed, _ = prepare_believed(preset, autopilot, more)
    lower, upper = ([limits[i * (len(limits) // 3)] for i in range(2)] for limits in
                    (believed.sets.state_lower, believed.sets.state_upper))  # fmt: skip
    height_m = -float(rng.uniform(0.8, 1.6))
    sides = [(0.9 * lower[0], 0.9 * lower[1]), (0.9 * upper[0], 0.9 * upper[1])]
    if rng.random() < 0.5:
        sides = [(0.9 * lower[0], 0.9 * upper[1]), (0.9 * upper[0], 0.9 * lower[1])]
    waypoints = ", ".join(f"[{n:.2f}, {e:.2f}, {height_m:.2f}]" for n, e in [*sides, *sides, *sides, *sides])
    mission = f"mission.waypoints=[{waypoints}]"
    world = [f"sim.autopilot={autopilot}", f"sim.seed={seed}", *choose_plant(plant, 3.0), mission]
    world += [f"duration_s={DURATION_S}", *more]
    believed, controller = prepare_believed(preset, autopilot, (mission, *more))
    return load_config(preset, world), believed, controller


def fly_with_fault(
    kind: str, seed: int, preset: str, autopilot: str, *more: str, plant: str = "quadrotor"
) -> DeceivedFlight:
    """Fly with an everyday fault of the cameras; an empty kind is none."""
    config, believed, controller = draw_pair(seed, preset, autopilot, *more, plant=plant)

    def prepare(world: World) -> None:
        if kind:
            distort_cameras(world.peers.cameras, kind, seed)

    return fly_deceived(config, believed, controller, [], BEGIN_S, prepare=prepare)

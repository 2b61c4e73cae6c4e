"""Flights on relayed poses whose positions are right and whose attitude is wrong, judged on the true vehicle."""

from __future__ import annotations

import math
from typing import Any

from sim_rig import decode
from soak_pairs import compute_outside_m
from take_off_rig import GOAL, RELAYED, SECOND, TakeOffRig

from sim.vehicle.interface import compute_heading_rad
from uavctl.frames import Quaternion, multiply_quaternions, quaternion_from_euler
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Vec3

# Rotations of the body by which a camera system is wrong, about its axes; `creep` turns by 5°/s.
TURNS_DEG: dict[str, Vec3] = {
    "right": (0.0, 0.0, 0.0),
    "yaw-180": (0.0, 0.0, 180.0),
    "yaw-90": (0.0, 0.0, 90.0),
    "roll-180": (180.0, 0.0, 0.0),
    "pitch-90": (0.0, 90.0, 0.0),
    "creep": (0.0, 0.0, 5.0),
}


class TurnedPosesFlight(TakeOffRig):
    """A flight of a vehicle that has its position and heading from the relay only.

    Args:
        turn: A key of `TURNS_DEG`.
        begin_s: When the attitude begins to be wrong, since the vehicle began to be flown [s]; None for the first pose.
        wrong_s: For how long [s].
        every_s: The wrong attitude lasts for half of each such period [s]; 0 for all the time.

    Attributes:
        outside_m: Furthest beyond a wall or the ceiling [m]; negative is inside.
        error_rad: Largest error of the heading that the vehicle's estimator has had.
        wrong_sent: Poses with an attitude more than 30° off that were passed on.
    """

    def __init__(
        self,
        autopilot: str,
        turn: str,
        *more: str,
        begin_s: float | None,
        wrong_s: float,
        every_s: float = 0.0,
        plant: str = "quadrotor",
    ) -> None:
        flown = ["sim.inertial.flown=true"] if plant == "quadrotor" else []  # the linear plant is always level
        super().__init__(autopilot, *RELAYED, f"sim.plant={plant}", *flown, *more)
        self.relayed()
        self._turn, self._begin_s, self._wrong_s, self._every_s = turn, begin_s, wrong_s, every_s
        self._flown_ns: int | None = None
        self.outside_m, self.error_rad, self.wrong_sent = -math.inf, 0.0, 0
        self._distort_cameras()
        self.hears = self._count_wrong

    def fly(self, seconds: float) -> TurnedPosesFlight:
        """Take off by order, fly to the goal, and on for a time; poses wrong from the first on leave only the time."""
        self.run(8.0)
        self.take_off()
        if self._begin_s is not None:
            self.run(60.0, until=HandoverState.ENGAGED)
        self._flown_ns = self.now_ns
        for _ in range(round(seconds * 20)):
            if self.loop.finished:
                break
            self.run(0.05)
            position_m = self.peers.vehicle.position_m
            self.outside_m = max(self.outside_m, compute_outside_m(self.config, position_m))
            self.error_rad = max(self.error_rad, abs(self.peers.autopilot.estimator.heading_error_rad))
        return self

    @property
    def distance_m(self) -> float:
        """Distance of the true vehicle to the goal [m]."""
        return math.dist(self.peers.vehicle.position_m, GOAL)

    def _find_turn_deg(self, at_ns: int) -> Vec3 | None:
        if self._begin_s is None:
            since_s = at_ns / SECOND
        elif self._flown_ns is None:
            return None
        else:
            since_s = (at_ns - self._flown_ns) / SECOND - self._begin_s
        if not 0.0 <= since_s < self._wrong_s or (self._every_s and since_s % self._every_s > self._every_s / 2):
            return None
        roll, pitch, yaw = TURNS_DEG[self._turn]
        return (roll, pitch, yaw * since_s) if self._turn == "creep" else (roll, pitch, yaw)

    def _distort_cameras(self) -> None:
        cameras = self.peers.cameras
        capture = cameras.capture

        def capture_turned(position_m: Vec3, velocity_mps: Vec3, attitude: Quaternion) -> Any:
            turn_deg = self._find_turn_deg(cameras.next_ns)
            if turn_deg is not None:
                roll, pitch, yaw = map(math.radians, turn_deg)
                turn = quaternion_from_euler((roll, pitch, yaw))
                assert turn is not None
                attitude = multiply_quaternions(attitude, turn)
            return capture(position_m, velocity_mps, attitude)

        cameras.capture = capture_turned  # type: ignore[method-assign]

    def _count_wrong(self, data: bytes) -> bool:
        """Count a pose whose attitude is not that of the true vehicle; the vehicle hears all datagrams."""
        for message in decode(data):
            if message.get_type() == "VISION_POSITION_ESTIMATE":
                heading_rad = compute_heading_rad(self.peers.vehicle.attitude)
                error_rad = abs(math.remainder(message.yaw - heading_rad, math.tau))
                self.wrong_sent += max(error_rad, abs(message.roll), abs(message.pitch)) > math.radians(30.0)
        return True

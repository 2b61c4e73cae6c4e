"""A vehicle and its cameras in bare pymavlink, sharing no code with the project.

Run as a script against `uavctl fly`; prints one JSON line with what it got back once it has come to rest at the target
that it is told, and flies on until it is killed. Its time is that of the setpoints: each moves it by one tick, and
their number ends a phase. A machine that stands still so takes nothing from the flight.
"""

from __future__ import annotations

import json
import math
import select
import socket
import sys
import time

from pymavlink.dialects.v20 import ardupilotmega as mavlink

ARMED_CUSTOM = mavlink.MAV_MODE_FLAG_SAFETY_ARMED | mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
PX4_OFFBOARD = 6 << 16
FLIGHT, PAUSE, AFTER, LONGEST = 80, 80, 80, 1200  # setpoints: seen, unseen, seen again at least, and all at most
WAIT_S = 0.02
NEAR_M, SLOW_MPS = 0.1, 0.1


class Vehicle:
    """A point mass without friction, moved in real time by the last setpoint, and its received messages."""

    def __init__(self, now: float) -> None:
        self.now, self.accel_mps2 = now, [0.0, 0.0, 0.0]
        self.position_m, self.velocity_mps = [0.5, 0.5, -1.0], [0.0, 0.0, 0.0]
        self.setpoints, self.poses, self.largest_mps2 = 0, 0, 0.0
        self.masks: set[int] = set()

    @property
    def unseen(self) -> bool:
        return FLIGHT <= self.setpoints < FLIGHT + PAUSE

    def move(self, now: float) -> None:
        """Fly on to a time by the last setpoint."""
        for axis, accel in enumerate(self.accel_mps2):
            s, self.velocity_mps[axis] = now - self.now, self.velocity_mps[axis] + accel * (now - self.now)
            self.position_m[axis] += s * self.velocity_mps[axis] - 0.5 * s * s * accel
        self.now = now

    def fly(self, message: mavlink.MAVLink_message) -> None:
        """Take a setpoint."""
        accel = [message.afx, message.afy, message.afz]
        self.accel_mps2 = accel
        self.setpoints += 1
        self.largest_mps2 = max(self.largest_mps2, *map(abs, accel))
        self.masks.add(message.type_mask)

    def is_over(self, target_m: list[float]) -> bool:
        rests = math.dist(self.position_m, target_m) < NEAR_M and math.hypot(*self.velocity_mps) < SLOW_MPS
        return (rests and self.setpoints >= FLIGHT + PAUSE + AFTER) or self.setpoints >= LONGEST


def main(port: int, target_m: list[float]) -> None:
    """Fly; be unseen for a while in the middle."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.connect(("127.0.0.1", port))
    out = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    next_pose = next_heartbeat = time.monotonic()
    vehicle, is_reported = Vehicle(next_pose), False
    while True:
        now = time.monotonic()
        vehicle.move(now)
        if now >= next_heartbeat:
            next_heartbeat = now + 0.5
            beat = out.heartbeat_encode(
                mavlink.MAV_TYPE_QUADROTOR,
                mavlink.MAV_AUTOPILOT_PX4,
                ARMED_CUSTOM,
                PX4_OFFBOARD,
                mavlink.MAV_STATE_ACTIVE,
            )
            send(sock, out, beat)
        if now >= next_pose and not vehicle.unseen:
            next_pose = now + 0.1
            pose = out.vision_position_estimate_encode(round(now * 1e6), *vehicle.position_m, 0.0, 0.0, 0.0)
            send(sock, out, pose)
            vehicle.poses += 1
        select.select([sock], [], [], WAIT_S)
        for message in drain(sock, parser):
            vehicle.fly(message)
        if not is_reported and vehicle.is_over(target_m):
            is_reported = True
            sys.stdout.write(json.dumps(seen(vehicle)) + "\n")
            sys.stdout.flush()


def seen(vehicle: Vehicle) -> dict[str, object]:
    """What the vehicle got, and where that has taken it."""
    return {
        "setpoints": vehicle.setpoints,
        "poses": vehicle.poses,
        "largest_mps2": vehicle.largest_mps2,
        "masks": sorted(vehicle.masks),
        "position_m": [round(p, 3) for p in vehicle.position_m],
        "velocity_mps": [round(v, 3) for v in vehicle.velocity_mps],
    }


def send(sock: socket.socket, out: mavlink.MAVLink, message: mavlink.MAVLink_message) -> None:
    """Pack with the next sequence number and send."""
    data = message.pack(out)
    out.seq = (out.seq + 1) % 256
    sock.send(data)


def drain(sock: socket.socket, parser: mavlink.MAVLink) -> list[mavlink.MAVLink_message]:
    """Acceleration setpoints that have arrived."""
    sock.setblocking(False)
    results = []
    try:
        while True:
            for message in parser.parse_buffer(sock.recv(2048)) or []:
                if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
                    results.append(message)
    except (BlockingIOError, ConnectionRefusedError):
        return results


if __name__ == "__main__":
    main(int(sys.argv[1]), [float(word) for word in sys.argv[2:]])

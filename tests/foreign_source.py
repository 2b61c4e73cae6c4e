"""A vehicle and its cameras in bare pymavlink, sharing no code with the project.

Run as a script against `uavctl fly`; prints one JSON line with what it got back.
"""

from __future__ import annotations

import json
import select
import socket
import sys
import time

from pymavlink.dialects.v20 import ardupilotmega as mavlink

ARMED_CUSTOM = mavlink.MAV_MODE_FLAG_SAFETY_ARMED | mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
PX4_OFFBOARD = 6 << 16
FLIGHT_S, PAUSE_S, AFTER_S, STEP_S = 4.0, 4.0, 4.0, 0.02


def main(port: int) -> None:
    """Fly a frictionless point mass on the setpoints that come back; be silent for a while in the middle."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.connect(("127.0.0.1", port))
    out = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    position, velocity, accel = [0.5, 0.5, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    received: list[tuple[float, float]] = []
    masks: set[int] = set()
    start = now = time.monotonic()
    next_pose = next_heartbeat = start
    while now - start < FLIGHT_S + PAUSE_S + AFTER_S:
        if now >= next_heartbeat:
            next_heartbeat += 0.5
            beat = out.heartbeat_encode(
                mavlink.MAV_TYPE_QUADROTOR,
                mavlink.MAV_AUTOPILOT_PX4,
                ARMED_CUSTOM,
                PX4_OFFBOARD,
                mavlink.MAV_STATE_ACTIVE,
            )
            send(sock, out, beat)
        if now >= next_pose:
            next_pose += 0.1
            if not FLIGHT_S <= now - start < FLIGHT_S + PAUSE_S:
                pose = out.vision_position_estimate_encode(round(now * 1e6), *position, 0.0, 0.0, 0.0)
                send(sock, out, pose)
        select.select([sock], [], [], STEP_S)
        before, now = now, time.monotonic()
        for axis in range(3):
            velocity[axis] += accel[axis] * (now - before)
            position[axis] += velocity[axis] * (now - before)
        for message in drain(sock, parser):
            accel = [message.afx, message.afy, message.afz]
            masks.add(message.type_mask)
            received.append((now - start, max(map(abs, accel))))
    seen = {
        "setpoints": len(received),
        "in_pause": sum(FLIGHT_S < t < FLIGHT_S + PAUSE_S for t, _ in received),
        "largest_mps2": max((a for _, a in received), default=0.0),
        "masks": sorted(masks),
        "position_m": [round(p, 3) for p in position],
        "velocity_mps": [round(v, 3) for v in velocity],
    }
    sys.stdout.write(json.dumps(seen) + "\n")


def send(sock: socket.socket, out: mavlink.MAVLink, message: mavlink.MAVLink_message) -> None:
    """Pack with the next sequence number and send."""
    data = message.pack(out)
    out.seq = (out.seq + 1) % 256
    sock.send(data)


def drain(sock: socket.socket, parser: mavlink.MAVLink) -> list[mavlink.MAVLink_message]:
    """Acceleration setpoints that have arrived."""
    sock.setblocking(False)
    found = []
    try:
        while True:
            for message in parser.parse_buffer(sock.recv(2048)) or []:
                if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
                    found.append(message)
    except (BlockingIOError, ConnectionRefusedError):
        return found


if __name__ == "__main__":
    main(int(sys.argv[1]))

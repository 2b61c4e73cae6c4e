"""Time of the sender of `uavctl cameras` for each message: `python tools/sender_cost.py --vehicles 20`.

All positions of all vehicles are received, and what the channel allows is sent and, with `--signed`, signed. It prints
the median and the 90th percentile in milliseconds. Exit code 1 where a median is above the limit.
"""

from __future__ import annotations

import argparse
import json
import sys
import time

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.config import load_config
from uavctl.io.shared_sources import find_shared_sources
from uavctl.mavlink.encoder import Encoder
from uavctl.mavlink.signing import FrameSigner, SigningKey, SigningTimestamps
from uavctl.wiring.radio import RadioConfig
from uavctl.wiring.sender import PositionMessage, PositionSender

LIMIT_MS = 0.2
PERIOD_NS, START_NS = 20_000_000, 1_000_000_000_000


def main() -> int:
    """Measure; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0, help="virtual time")
    parser.add_argument("--schedule", default="value", choices=("round-robin", "oldest-first", "value"))
    parser.add_argument("--signed", action="store_true")
    given = parser.parse_args()
    configs = [load_config("room-px4", ["source.report=true"])] * given.vehicles
    radio = RadioConfig(
        bytes_per_s=5760.0, rate_hz=50.0, loss=0.3, feedback_s=0.2, signed=given.signed, schedule=given.schedule
    )
    sources = find_shared_sources([f"udpin://127.0.0.1:1/{1 + number}" for number in range(given.vehicles)])
    sender = PositionSender(configs, sources, radio, spacing_m=0.4, start_ns=START_NS)
    signer = FrameSigner(SigningKey(b"k" * 32), 1, SigningTimestamps(), 0)
    encoder, rng = Encoder(245, 25), np.random.default_rng(1)
    sending_s: list[float] = []
    receiving_s: list[float] = []
    frame_ns = at_ns = START_NS
    while at_ns < START_NS + given.seconds * 1e9:
        at_ns += 1_000_000
        if at_ns >= frame_ns:
            frame_ns += PERIOD_NS
            for number in range(given.vehicles):
                place = 0.3 * rng.standard_normal(3)
                message = mavlink.MAVLink_vision_position_estimate_message(1 + at_ns // 1000, *place, 0, 0, 0)
                data = bytes(message.pack(mavlink.MAVLink(None, 1 + number, 197)))
                last = time.perf_counter()
                sender.receive_positions(0, data, at_ns)
                receiving_s.append(time.perf_counter() - last)
        last = time.perf_counter()
        sent = sender.send_next(at_ns)
        if sent is None:
            continue
        if given.signed:
            signer.sign(sent.frame, at_ns)
        sending_s.append(time.perf_counter() - last)
        if isinstance(sent, PositionMessage) and rng.random() > radio.loss:
            report = encoder.encode_position_report(sent.captured_ns // 1000, 1, 246, 197)
            sender.receive_reports(sent.vehicle, report, at_ns)
    result = {
        name: {
            "count": len(times_s),
            "median_ms": 1e3 * float(np.median(times_s)),
            "p90_ms": 1e3 * float(np.quantile(times_s, 0.9)),
        }
        for name, times_s in (("receive", receiving_s), ("send", sending_s))
    }
    sys.stdout.write(json.dumps(result, indent=2) + "\n")
    return int(any(values["median_ms"] > LIMIT_MS for values in result.values()))


if __name__ == "__main__":
    sys.exit(main())

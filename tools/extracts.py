"""Compact excerpts of recorded flights of real autopilot software, for the tests to fly again.

`python tools/extracts.py FOLDER` reads `*.tlog`, `*-truth.csv` and `*-events.txt` of FOLDER and writes, packed by xz,
the same names into `tests/data/flights`: still valid recordings, with those messages only that the tests look at, and
the truth ten times a second. What is left out is what an autopilot streams beside that: attitudes, sensors, servos.
"""

from __future__ import annotations

import argparse
import lzma
import struct
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.recording.tlog import TlogPacket, read_tlog
from uavctl.errors import UavctlError
from uavctl.mavlink.framing import scan_frames

OUT = Path(__file__).parents[1] / "tests" / "data" / "flights"
TRUTH_S = 0.1
SHORT_S = 10.0  # a recording shorter than this is kept as it is, with all that its autopilot streams
OWN_IDS = frozenset({245})  # our own client, whose relayed positions repeat the cameras'

KEPT = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_HEARTBEAT,
        mavlink.MAVLINK_MSG_ID_SYS_STATUS,
        mavlink.MAVLINK_MSG_ID_PARAM_VALUE,
        mavlink.MAVLINK_MSG_ID_PARAM_SET,
        mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_READ,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
        mavlink.MAVLINK_MSG_ID_SET_GPS_GLOBAL_ORIGIN,
        mavlink.MAVLINK_MSG_ID_COMMAND_LONG,
        mavlink.MAVLINK_MSG_ID_COMMAND_ACK,
        mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED,
        mavlink.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE,
        mavlink.MAVLINK_MSG_ID_TIMESYNC,
        mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
        mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
        mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
        mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
        mavlink.MAVLINK_MSG_ID_STATUSTEXT,
    }
)
THINNED = {mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 5, mavlink.MAVLINK_MSG_ID_SYS_STATUS: 5}  # where cameras tell
# One flight keeps the vehicle's own estimate, of which there is more than of the cameras' positions.
WITH_ODOMETRY = "px4-sih-relay-waypoints"


def kept(name: str, packets: Sequence[TlogPacket]) -> Iterator[TlogPacket]:
    """The packets of a recording that its excerpt has."""
    whole = (packets[-1].at_ns - packets[0].at_ns) * 1e-9 < SHORT_S
    relayed = "-relay-" in name
    seen = dict.fromkeys(THINNED, 0)
    for packet in packets:
        frames = scan_frames(packet.data, final=True).frames
        if whole:
            yield packet
            continue
        if not frames:
            continue
        kind, system = frames[0].message_id, packet.data[5]
        if kind == mavlink.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE and system in OWN_IDS:
            continue
        if relayed and kind in THINNED:
            seen[kind] += 1
            if seen[kind] % THINNED[kind] != 1:
                continue
        if kind in KEPT or (kind == mavlink.MAVLINK_MSG_ID_ODOMETRY and name == WITH_ODOMETRY):
            yield packet


def thinned_truth(lines: Sequence[str]) -> list[str]:
    """The head, and rows of a truth at least a tenth of a second apart."""
    rows, last_s = [lines[0]], -TRUTH_S
    for line in lines[1:]:
        at_s = float(line.split(",", 1)[0])
        if at_s - last_s >= TRUTH_S - 1e-6:
            rows.append(line)
            last_s = at_s
    return rows


def packed(path: Path, data: bytes) -> int:
    """Write bytes, packed; how many they became."""
    small = lzma.compress(data, preset=9 | lzma.PRESET_EXTREME)
    path.write_bytes(small)
    return len(small)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the excerpts; exit code 1 where the folder has no recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of the recordings")
    parser.add_argument("--out", type=Path, default=OUT)
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    found = sorted(given.folder.glob("*.tlog"))
    total = 0
    try:
        for path in found:
            packets = tuple(kept(path.stem, read_tlog(path).packets))
            data = b"".join(struct.pack(">Q", one.at_ns // 1000) + one.data for one in packets)
            size = packed(given.out / f"{path.name}.xz", data)
            sys.stdout.write(f"{path.name}: {len(packets)} packets, {size / 1000:.0f} kB\n")
            total += size
        for path in sorted(given.folder.glob("*-truth.csv")):
            total += packed(
                given.out / f"{path.name}.xz", ("\n".join(thinned_truth(path.read_text().splitlines())) + "\n").encode()
            )
        for path in sorted(given.folder.glob("*-events.txt")):
            total += packed(given.out / f"{path.name}.xz", path.read_bytes())
    except UavctlError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    sys.stdout.write(f"{len(found)} recordings, {total / 1e6:.2f} MB altogether\n")
    return 0 if found else 1


if __name__ == "__main__":
    sys.exit(main())

"""Mutated messages with a right checksum, and what a simulated autopilot may do on them.

The mutants are made from the definitions of the whole dialect; what is allowed is decided here from the decoded
message, by rules that share nothing with the simulator's handlers.
"""

from __future__ import annotations

import math
import random
import re
import struct
from collections import Counter
from typing import Any, Literal

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import SimRig, decode, make_rig

from sim.autopilot.parameters import TABLES

HANDLED = (
    "ATT_POS_MOCAP",
    "COMMAND_INT",
    "COMMAND_LONG",
    "FILE_TRANSFER_PROTOCOL",
    "HEARTBEAT",
    "LOG_REQUEST_LIST",
    "MISSION_CLEAR_ALL",
    "MISSION_COUNT",
    "MISSION_REQUEST",
    "MISSION_REQUEST_INT",
    "MISSION_REQUEST_LIST",
    "ODOMETRY",
    "PARAM_REQUEST_LIST",
    "PARAM_REQUEST_READ",
    "PARAM_SET",
    "REQUEST_DATA_STREAM",
    "SET_GPS_GLOBAL_ORIGIN",
    "SET_MODE",
    "SET_POSITION_TARGET_LOCAL_NED",
    "TIMESYNC",
    "VISION_POSITION_ESTIMATE",
)
KINDS = {kind.msgname: kind for kind in mavlink.mavlink_map.values()}
COMMANDS = (400, 176, 21, 22, 511, 510, 512, 520, 410, 179, 401, 246, 65535)
NUMBERS = (math.nan, math.inf, -math.inf, 3.4e38, -3.4e38, 1e-45, -1.0, 0.0, 0.5, 1.0, 4.0, 6.0, 30.0, 32.0, 21196.0)
WIDTH = {"b": 8, "B": 8, "h": 16, "H": 16, "i": 32, "I": 32, "q": 64, "Q": 64}
PER_SESSION = 500


def letters(form: str) -> list[str]:
    """One format letter for every value of a struct format; strings keep their length."""
    result: list[str] = []
    for count, letter in re.findall(r"(\d*)([a-zA-Z])", form):
        result += [count + letter] if letter == "s" else [letter] * int(count or 1)
    return result


class Mutants:
    """An endless supply of datagrams, the same for a seed."""

    def __init__(self, seed: int, autopilot: str) -> None:
        self._rng = random.Random(seed)
        self._names = [*TABLES[autopilot], "_HASH_CHECK", "NO_SUCH", ""]

    def next(self) -> bytes:
        rng = self._rng
        kind = KINDS[rng.choice(HANDLED)] if rng.random() < 0.9 else rng.choice(list(KINDS.values()))
        payload = rng.randbytes(kind.unpacker.size) if rng.random() < 0.1 else self._payload(kind)
        if rng.random() < 0.1:
            payload = payload[: rng.randint(1, len(payload))]  # cut zeros, or more
        return self._framed(kind, payload)

    def _payload(self, kind: Any) -> bytes:
        """Likely values for all fields, and hostile ones for a few."""
        if kind.msgname == "FILE_TRANSFER_PROTOCOL":
            return bytes((0, self._rng.choice((1, 1, 0, 7)), self._rng.choice((1, 0, 9)))) + self._request()
        forms = letters(kind.unpacker.format)
        hostile = {self._rng.randrange(len(forms)) for _ in range(self._rng.choice((0, 1, 1, 2, 4)))}
        values = [self._hostile(form) if i in hostile else self._likely(form) for i, form in enumerate(forms)]
        scalars = kind.msgname in HANDLED and len(kind.ordered_fieldnames) == len(forms)
        for i, name in enumerate(kind.ordered_fieldnames if scalars else ()):
            if i not in hostile:
                values[i] = self._named(name, values[i])
        return struct.pack("<" + "".join(forms), *values)

    def _named(self, name: str, value: Any) -> Any:
        """What a field of this name usually holds."""
        rng = self._rng
        choices: dict[str, tuple[Any, ...]] = {
            "target_system": (1, 1, 1, 0, 7),
            "target_component": (1, 1, 0, 9),
            "command": COMMANDS,
            "base_mode": (1, 1, 0),
            "custom_mode": (4, 5, 9, 17, 0, 4 << 16 | 3 << 24, 4 << 16 | 6 << 24, 6 << 16),
            "coordinate_frame": (1, 7, 8, 9, 20),
            "type_mask": (3135, 2111, 0xDF8, 0xDC7, 3135 | 0x40, 3135 | 0x200, 0xFFFF),
            "param_index": (-1, 0, 5, 4000),
            "param_type": (9, 9, 6, 2, 4),
            "param_id": tuple(parameter_name.encode() for parameter_name in self._names),
            "start_stop": (0, 1),
            "req_stream_id": (0, 6, 10),
            "frame_id": (20, 1),
            "child_frame_id": (12,),
        }
        return rng.choice(choices[name]) if name in choices else value

    def _request(self) -> bytes:
        """A request of MAVLink FTP."""
        rng = self._rng
        query = rng.choice((b"", b"?start=2", b"?count=3&start=1", b"?withdefaults=1", b"?start=-1", rng.randbytes(9)))
        path = rng.choice((b"@PARAM/param.pck" + query, b"/", b"", rng.randbytes(30)))
        size = rng.choice((len(path), 80, 239, 240, 0, rng.randrange(256)))
        head = rng.randrange(2**16), rng.randrange(3), rng.choice((4, 4, 5, 15, rng.randrange(256))), size, 0, 0
        return (struct.pack("<HBBBBBxI", *head, rng.choice((0, 80, 2**32 - 1))) + path).ljust(251, b"\0")

    def _likely(self, form: str) -> Any:
        if form.endswith("s"):
            return b""
        if form in "fd":
            return self._rng.choice((0.0, 1.0, 0.5, -1.0, 4.0, 6.0, 32.0))
        return 1 if form == "c" else self._rng.choice((0, 1, 1))

    def _hostile(self, form: str) -> Any:
        rng = self._rng
        if form.endswith("s"):
            return rng.randbytes(int(form[:-1] or 1))
        if form in "fd":
            return rng.choice(NUMBERS)
        bits = WIDTH[form]
        low, high = (0, 2**bits - 1) if form.isupper() else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        return rng.choice((low, high, rng.randint(low, high), rng.randint(0, 127)))

    def _framed(self, kind: Any, payload: bytes) -> bytes:
        rng = self._rng
        source = rng.choice((255, 245, rng.randrange(256)))
        header = bytes([len(payload), 0, 0, rng.randrange(256), source, rng.randrange(256)])
        header += int(kind.id).to_bytes(3, "little")
        crc = int(mavlink.x25crc(header + payload + bytes([kind.crc_extra])).crc)
        return b"\xfd" + header + payload + crc.to_bytes(2, "little")


def snapshot(rig: SimRig) -> dict[str, Any]:
    """All that a message could change and a client could notice."""
    autopilot, vehicle = rig.peers.autopilot, rig.peers.vehicle
    pilot = autopilot.pilot
    return {
        "mode": pilot.mode.name,
        "flags": (pilot.is_armed, pilot.phase, pilot.is_failsafe, vehicle.grounded),
        "crashed": pilot.crash_reason,
        "parameters": tuple(autopilot.parameters[name] for name in autopilot.parameters.names),
        "intervals": tuple(autopilot.telemetry.get_interval_us(kind) for kind in autopilot.telemetry.streams),
        "home": pilot.home_m,
        "origin": autopilot.estimator.has_origin,
        "input": tuple(vehicle.input.tolist()),
    }


# What a message of a kind may change when it is well meant; everything else must stay.
MAY_CHANGE: dict[str, set[str]] = {
    "COMMAND_INT": {"mode", "flags", "intervals", "home", "input"},
    "COMMAND_LONG": {"mode", "flags", "intervals", "home", "input"},
    "PARAM_SET": {"parameters"},
    "REQUEST_DATA_STREAM": {"intervals"},
    "SET_GPS_GLOBAL_ORIGIN": {"origin"},
    "SET_MODE": {"mode", "flags", "input"},
    "SET_POSITION_TARGET_LOCAL_NED": {"input"},
}
ANSWERED = {"COMMAND_INT", "COMMAND_LONG", "SET_MODE"}


class Judge:
    """Sends mutants to a simulated autopilot and raises `AssertionError` on whatever it should not do.

    Attributes:
        results: MAV_RESULTs seen, so that a test can tell that the handlers were reached.
        changed: what changed, by kind of message.
    """

    def __init__(self, autopilot: Literal["px4", "ardupilot"], seed: int) -> None:
        self._name = autopilot
        self._mutants = Mutants(seed, autopilot)
        self._sent = 0
        self._one = make_rig(autopilot, airborne=True)
        self._known: dict[str, Any] | None = None  # the last snapshot, while nothing else has happened
        self.results: Counter[int] = Counter()
        self.changed: Counter[tuple[str, str]] = Counter()
        self.modes: set[str] = set()

    def run(self, messages: int) -> None:
        for _ in range(messages):
            if self._sent % PER_SESSION == 0:
                session = self._sent // PER_SESSION
                plant = "sim.plant=quadrotor" if session % 3 else "sim.plant=linear"
                self._one = make_rig(self._name, plant, airborne=session % 2 == 0)
                self._known = None
            self._sent += 1
            if self._sent % 20 == 0:
                self._one.wait(0.1)
                self._known = None
                self.modes.add(self._one.peers.autopilot.mode_name)
                assert all(map(math.isfinite, self._one.peers.vehicle.position_m))
            self._judge(self._mutants.next())

    def _judge(self, data: bytes) -> None:
        (msg,) = decode(data)
        before = self._known or snapshot(self._one)
        peers = self._one.peers  # time stands still: what follows is of this message alone
        answers = [message for out in peers.autopilot.receive(data, peers.now_ns) for message in decode(out)]
        after = self._known = snapshot(self._one)
        kind = msg.get_type()
        changed = {part for part in before if before[part] != after[part]}
        self.changed.update((kind, part) for part in changed)
        allowed = set(MAY_CHANGE.get(kind, ()))
        if kind not in HANDLED or not self._meant(msg):
            assert answers == [] and not changed, (str(msg), changed)
            return
        if kind in ANSWERED and before["crashed"] is None:
            acks = [answer.result for answer in answers if answer.get_type() == "COMMAND_ACK"]
            assert len(acks) == 1, (str(msg), answers)
            self.results[acks[0]] += 1
            allowed = allowed if acks == [0] else set()
        if kind == "SET_POSITION_TARGET_LOCAL_NED" and self._fatal(msg):
            allowed |= {"crashed"}
        if kind == "SET_POSITION_TARGET_LOCAL_NED" and before["flags"][2] and self._name == "px4":
            allowed |= {"mode", "flags"}  # the stream is back: the failsafe ends
        if kind == "PARAM_SET" and "parameters" in changed:
            self._judge_parameters(msg, before["parameters"], after["parameters"])
        assert changed <= allowed, (str(msg), changed)

    @staticmethod
    def _meant(msg: Any) -> bool:
        return getattr(msg, "target_system", 1) in (0, 1) and getattr(msg, "target_component", 1) in (0, 1)

    def _fatal(self, msg: Any) -> bool:
        nine = (msg.x, msg.y, msg.z, msg.vx, msg.vy, msg.vz, msg.afx, msg.afy, msg.afz)
        return self._name == "ardupilot" and not all(map(math.isfinite, nine))

    def _judge_parameters(self, msg: Any, before: tuple[float, ...], after: tuple[float, ...]) -> None:
        names = self._one.peers.autopilot.parameters.names
        (i,) = [i for i, (old, new) in enumerate(zip(before, after, strict=True)) if old != new]
        assert names[i] == msg.param_id and math.isfinite(after[i]), str(msg)
        allowed = TABLES[self._name][names[i]].allowed
        assert not allowed or after[i] in allowed, str(msg)

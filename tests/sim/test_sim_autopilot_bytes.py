"""The simulated autopilots survive any bytes, and change nothing for bad ones."""

import math
import random

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import ARM, INTERVAL, LAND, SET_MODE, TAKE_OFF, Client, decode, make_rig, read_flight_state


def test_one_bad_datagram_does_not_spoil_the_next() -> None:
    one = make_rig("px4")
    good = one.client.setpoint(1.0, 0.0, 0.0)
    for bad in (good[:20], b"\xfd" * 50, b"\xfd\xff\x00", b"", b"\xfe"):
        one.send(bad)
        one.send(good)
        assert read_flight_state(one) == (1.0, 0.0, 0.0)
        one.send(one.client.setpoint(0.0, 0.0, 0.0))


def test_two_messages_in_one_datagram_are_both_read() -> None:
    one = make_rig("px4")
    answers = one.send(one.client.timesync(1) + one.client.command(LAND))
    assert [msg.get_type() for msg in answers] == ["TIMESYNC", "COMMAND_ACK", "STATUSTEXT"]


def mutants(seed: int, n: int) -> list[bytes]:
    """Datagrams with random damage anywhere: flipped bits, cuts, insertions, two glued together."""
    rng, client = random.Random(seed), Client()
    originals = [
        client.setpoint(0.5, 0.5, 0.5),
        client.command(ARM, 0, 21196),
        client.command(LAND),
        client.command(SET_MODE, 1, 4, 6),
        client.set_mode(4 << 16 | 6 << 24),
        client.timesync(1),
    ]
    made: list[bytes] = []
    while len(made) < n:
        data = bytearray(rng.choice(originals))
        for _ in range(rng.randint(1, 4)):
            at = rng.randrange(len(data))
            match rng.randrange(4):
                case 0:
                    data[at] ^= 1 << rng.randrange(8)
                case 1:
                    data[at] = rng.randrange(256)
                case 2:
                    del data[at:]
                case _:
                    data[at:at] = rng.randbytes(rng.randint(1, 8))
            if not data:
                break
        bad = bytes(data) + (rng.choice([b"", rng.randbytes(12)]))
        if not any(original in bad for original in originals):
            made.append(bad)
    return made


@pytest.mark.long
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_damaged_datagrams_neither_raise_nor_change_anything(autopilot: str) -> None:
    one = make_rig(autopilot)
    one.stream(0.5, 0.0, 0.0, 0.0)
    mode = one.peers.autopilot.mode_name
    bad = [data for data in mutants(17, 20_000) if not readable(data)]
    assert len(bad) > 19_500
    for i, data in enumerate(bad):
        one.send(data)
        if i % 100 == 0:
            one.send(one.client.setpoint(0.0, 0.0, 0.0))
            one.wait(0.05)
    assert one.peers.autopilot.mode_name == mode
    assert one.peers.autopilot.pilot.is_armed
    assert read_flight_state(one) == (0.0, 0.0, 0.0)
    assert one.of("COMMAND_ACK") == []


def readable(data: bytes) -> bool:
    """Whether a good message is left: damage to the flags or behind the end can leave the checksum right."""
    kinds = (msg.get_type() for msg in decode(data))
    return any(kind != "BAD_DATA" and not kind.startswith("UNKNOWN") for kind in kinds)


def any_message(rng: random.Random, client: Client) -> bytes:
    """A message with a right checksum: a random payload, or a likely one with hostile numbers."""
    kind, payload = mavlink.mavlink_map[rng.choice((0, 11, 75, 76, 84, 111, 253))], b""
    match rng.randrange(3):
        case 0:
            payload = rng.randbytes(kind.unpacker.size)
        case 1:
            return client.setpoint(*(rng.choice((0.0, 1e38, math.nan, -3.0)) for _ in range(3)))
        case _:
            numbers = (0.0, 1.0, 4.0, 6.0, 32.0, math.nan, -math.inf, 1e38)
            command = rng.choice((ARM, SET_MODE, LAND, TAKE_OFF, INTERVAL, 9999))
            return client.command(command, *(rng.choice(numbers) for _ in range(7)))
    header = bytes([len(payload), 0, 0, 0, 9, 9, kind.id, 0, 0])
    crc: int = mavlink.x25crc(header + payload + bytes([kind.crc_extra])).crc
    return b"\xfd" + header + payload + crc.to_bytes(2, "little")


@pytest.mark.long
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_well_formed_messages_with_any_content_never_raise(autopilot: str) -> None:
    rng, client = random.Random(23), Client()
    modes = set()
    for start in range(30):
        one = make_rig(autopilot, airborne=start % 2 == 0)
        for i in range(200):
            data = any_message(rng, client)
            assert readable(data)
            one.send(data)
            modes.add(one.peers.autopilot.mode_name)
            if i % 10 == 0:
                one.wait(0.1)
            assert all(map(math.isfinite, one.peers.vehicle.position_m))
    assert ("CRASHED" in modes) == (autopilot == "ardupilot")
    assert len(modes) > 3  # the handlers were reached

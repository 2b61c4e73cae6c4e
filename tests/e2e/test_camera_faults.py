"""Everyday faults of cameras whose positions are right on the whole: flown through between walls, in gusts."""

from __future__ import annotations

import pytest
from camera_faults_rig import fly_with_fault

from uavctl.event_codes import EventCode
from uavctl.flight.supervise import ENVELOPE_CODES
from uavctl.records import ControlMode

pytestmark = pytest.mark.long
# Each kind of fault is flown in one half of the worlds: both autopilots, both plants, and both kinds of preset.
HALVES = (
    (("room", "px4", "quadrotor"), ("room-ardupilot", "ardupilot", "quadrotor"), ("room", "px4", "linear")),
    (("room", "ardupilot", "quadrotor"), ("room-px4", "px4", "quadrotor"), ("room-ardupilot", "ardupilot", "linear")),
)
KINDS = (
    ("two-10cm", 1),
    ("two-20cm", 2),
    ("two-30cm", 22),
    ("burst-apart", 21),
    ("burst-together", 1),
    ("burst-together", 102),  # some of its bursts are inside the gate, and further than positions are shifted
    ("heavy-3cm", 1),
    ("white-5cm", 22),
    ("average", 12),
    ("first-order", 504),
)
SLOW_AND_NOISY = ("sim.camera.rate_hz=5.0", "sim.camera.noise_std_m=0.05", "duration_s=5.0")


@pytest.mark.fault(100)
@pytest.mark.parametrize(
    ("kind", "seed", "preset", "autopilot", "plant"),
    [(*kind, *world) for place, kind in enumerate(KINDS) for world in HALVES[place % 2]],
)
def test_a_camera_fault_is_flown_through(kind: str, seed: int, preset: str, autopilot: str, plant: str) -> None:
    flight = fly_with_fault(kind, seed, preset, autopilot, plant=plant)
    assert flight.codes is not None and flight.modes is not None
    assert not flight.codes.keys() & ENVELOPE_CODES
    assert flight.modes[-1][1] in (ControlMode.TRACK, ControlMode.BRAKE)
    assert flight.outside_m < 0.5


@pytest.mark.fault(100)
@pytest.mark.parametrize("seed", [1004, 1006, 1011, 1012])
def test_smoothing_is_counted_in(seed: int) -> None:
    """These flights ended, up to 0.5 m outside: PX4 answers so late that 0.17 s more made it sway."""
    flight = fly_with_fault("first-order", seed, "room-px4", "px4")
    assert flight.codes is not None and flight.modes is not None
    assert not flight.codes.keys() & ENVELOPE_CODES and flight.modes[-1][1] == ControlMode.TRACK
    assert flight.codes[EventCode.POSITIONS_LATE] < 3.0
    assert flight.outside_m < 0.0


@pytest.mark.fault(100)
@pytest.mark.parametrize(
    ("kind", "seed"),
    [*(("first-order", seed) for seed in (1003, 1006, 1019, 1029)), *(("", seed) for seed in (1003, 1009, 1020))],
)
def test_positions_of_a_vehicle_that_is_quicker_than_its_model_do_not_jump(kind: str, seed: int) -> None:
    """These flights ended: the linear plant answers 0.12 s sooner than the model of PX4, so predictions are far off."""
    flight = fly_with_fault(kind, seed, "room-px4", "px4", plant="linear")
    assert flight.codes is not None and flight.modes is not None
    assert not flight.codes.keys() & ENVELOPE_CODES and flight.modes[-1][1] == ControlMode.TRACK
    assert flight.outside_m < 0.0


@pytest.mark.fault(100)
@pytest.mark.parametrize(
    ("seed", "preset", "autopilot", "plant"),
    [
        (0, "room", "ardupilot", "quadrotor"),
        (2, "room", "px4", "linear"),
        (5, "room", "ardupilot", "quadrotor"),
        (11, "room-ardupilot", "ardupilot", "quadrotor"),
    ],
)
def test_noise_from_the_first_position_on_is_no_motion(seed: int, preset: str, autopilot: str, plant: str) -> None:
    """Two or three positions with noise of 5 cm, taken for exact, make a velocity of metres a second."""
    flight = fly_with_fault("white-5cm", seed, preset, autopilot, "duration_s=5", plant=plant)
    assert flight.codes is not None and flight.modes is not None
    assert not flight.codes.keys() & (ENVELOPE_CODES | {EventCode.POSITIONS_LATE})
    assert flight.modes[-1][1] == ControlMode.TRACK


@pytest.mark.fault(100)
@pytest.mark.parametrize(("seed", "autopilot"), [(2001, "px4"), (2001, "ardupilot"), (2008, "px4")])
def test_noise_of_a_slow_source_that_loses_positions_is_no_motion(seed: int, autopilot: str) -> None:
    """Positions that were lost left no four in a row close enough to show the noise before two monitors judged them."""
    flight = fly_with_fault("", seed, f"room-{autopilot}", autopilot, *SLOW_AND_NOISY)
    assert flight.codes is not None and flight.modes is not None
    assert not flight.codes.keys() & ENVELOPE_CODES and flight.modes[-1][1] == ControlMode.TRACK

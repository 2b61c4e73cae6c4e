"""What the vehicle tells of itself: parameters in both encodings, attitude, estimator, version; by pymavlink."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavlink_rig import NO_COVARIANCE, Peer
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from scipy.spatial.transform import Rotation

from sim.cameras import HALF_ROLL, compute_euler, compute_frame_rotation
from uavctl.config.connections import FrameConfig
from uavctl.frames import (
    Convention,
    Frame,
    Quaternion,
    euler_from_quaternion,
    multiply_quaternions,
    quaternion_from_euler,
    rotate_vector,
)
from uavctl.mavlink.codec import decode
from uavctl.mavlink.messages import AutopilotVersion, EstimatorFlags, Message, ParamValue, Position

VEHICLE, CAMERA = Peer(1, 1), Peer(17, 18)
FORMS = {1: "<B", 2: "<b", 3: "<H", 4: "<h", 5: "<I", 6: "<i"}


def product(p: Quaternion, q: Quaternion) -> Quaternion:
    """The turn q, then p, by a library: not by the product that is tested."""
    both = Rotation.from_quat(p, scalar_first=True) * Rotation.from_quat(q, scalar_first=True)
    w, x, y, z = both.as_quat(scalar_first=True).tolist()
    return w, x, y, z


def one(data: bytes) -> Message:
    (message,) = decode(data).messages
    return message


def bytewise(kind: int, value: int) -> float:
    (as_float,) = struct.unpack("<f", struct.pack(FORMS[kind], value).ljust(4, b"\0"))
    return float(as_float)


@pytest.mark.parametrize(
    ("kind", "value"), [(6, 5), (6, 11), (6, -1), (6, 5_000_000), (2, -3), (1, 255), (4, -300), (3, 65_000), (5, 7)]
)
def test_px4_puts_the_bytes_of_an_integer_into_the_float(kind: int, value: int) -> None:
    got = one(VEHICLE.send("param_value", b"COM_OBL_RC_ACT", bytewise(kind, value), kind, 9, 3))
    assert isinstance(got, ParamValue)
    assert (got.name, got.bytewise) == ("COM_OBL_RC_ACT", float(value))


def test_ardupilot_casts_and_a_real_number_is_the_same_in_both() -> None:
    got = one(VEHICLE.send("param_value", b"EK3_SRC1_POSXY", 6.0, mavlink.MAV_PARAM_TYPE_INT8, 9, 3))
    assert isinstance(got, ParamValue) and got.cast == 6.0
    got = one(VEHICLE.send("param_value", b"COM_OF_LOSS_T", 1.5, mavlink.MAV_PARAM_TYPE_REAL32, 9, 3))
    assert isinstance(got, ParamValue) and (got.cast, got.bytewise) == (1.5, 1.5)


def test_estimator_flags_of_both_autopilots() -> None:
    for data in (
        VEHICLE.send("ekf_status_report", 0x33F, 0.1, 0.1, 0.1, 0.1, 0.0),
        VEHICLE.send("estimator_status", 9, 0x33F, 0.1, 0.1, 0.1, 0.1, 0.0, 0.0, 0.1, 0.1),
    ):
        assert one(data) == EstimatorFlags(system=1, component=1, flags=0x33F)


def test_version_and_capabilities() -> None:
    data = VEHICLE.send("autopilot_version", 16 | 2, 0x040602FF, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0)
    assert one(data) == AutopilotVersion(system=1, component=1, capabilities=18, version=(4, 6, 2))


@pytest.mark.parametrize("q", [[0.0] * 4, [math.nan, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0]])
def test_an_attitude_that_is_none_leaves_the_position(q: list[float]) -> None:
    got = one(CAMERA.send("att_pos_mocap", 9, q, 1.0, 2.0, -3.0, NO_COVARIANCE))
    assert isinstance(got, Position) and got.attitude is None
    got = one(CAMERA.send("vision_position_estimate", 9, 1.0, 2.0, -3.0, math.nan, 0.0, 0.0, NO_COVARIANCE))
    assert isinstance(got, Position) and got.attitude is None


ANGLES = st.tuples(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))


@given(ANGLES, st.tuples(*[st.floats(-1, 1)] * 3))
def test_euler_angles_turn_about_z_y_x(angles: tuple[float, float, float], vector: tuple[float, float, float]) -> None:
    q = quaternion_from_euler(angles)
    assert q is not None
    got = rotate_vector(q, vector)
    for axis in (0, 1, 2):  # one turn after the other
        turned = tuple(angle if i == axis else 0.0 for i, angle in enumerate(angles))
        single = quaternion_from_euler(turned)  # type: ignore[arg-type]
        assert single is not None
        vector = rotate_vector(single, vector) or vector
    assert got == pytest.approx(vector, abs=1e-9)
    again = quaternion_from_euler(euler_from_quaternion(q))
    assert again is not None and abs(sum(a * b for a, b in zip(q, again, strict=True))) == pytest.approx(1.0)


@pytest.mark.parametrize("convention", ["ned", "enu"])
@given(ANGLES, st.floats(-180, 180))
def test_attitudes_come_back_from_the_simulated_cameras_axes(
    convention: Convention, angles: tuple[float, float, float], yaw_deg: float
) -> None:
    """The cameras' side is the simulator's own code."""
    truth = quaternion_from_euler(angles)
    assert truth is not None
    frame = Frame(convention, (0.0, 0.0, 0.0), yaw_deg)
    turned = product(compute_frame_rotation(FrameConfig(convention=convention, yaw_deg=yaw_deg)), truth)  # type: ignore[arg-type]
    told = quaternion_from_euler(compute_euler(turned if convention == "ned" else product(turned, HALF_ROLL)))
    assert told is not None
    for got in (frame.attitude_to_ned(turned, euler=False), frame.attitude_to_ned(told, euler=True)):
        assert abs(sum(a * b for a, b in zip(got, truth, strict=True))) == pytest.approx(1.0, abs=1e-6)


def test_a_product_of_turns_is_one_after_the_other() -> None:
    p, q = quaternion_from_euler((0.3, -0.2, 1.0)), quaternion_from_euler((-1.0, 0.4, 0.1))
    assert p is not None and q is not None
    inner: tuple[float, float, float] | None = rotate_vector(q, (1.0, 2.0, 3.0))
    assert inner is not None
    product: Quaternion = multiply_quaternions(p, q)
    assert rotate_vector(product, (1.0, 2.0, 3.0)) == pytest.approx(rotate_vector(p, inner))

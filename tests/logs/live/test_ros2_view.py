"""Messages of ROS 2 that follow from a flight's records, against an oracle of matrices. No ROS is needed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.spatial.transform import Rotation
from view_rig import fly_view

from logs.live.ros2_view import DIAGNOSTICS, LIMITS, PLAN, POSE, Ros2View
from logs.recording.design_view import read_design
from uavctl.records import ControlMode, Decision, Estimate, Header, Plan, Record, SolveStatus, StepInput, VehicleMotion

UTC_NS = 1_700_000_000 * 10**9
NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def view_flight() -> Iterator[tuple[Record, int, dict[str, Any]]]:
    """Each record of a flight, its log time, and the messages that follow from it."""
    view = Ros2View("drone1")
    for _, at_ns, record in fly_view().entries:
        yield record, UTC_NS + at_ns, dict(view.make_messages(record, UTC_NS + at_ns))


def read_vector(fields: Any) -> tuple[float, ...]:
    return fields["x"], fields["y"], fields["z"]


def read_ns(header: Any) -> int:
    return int(header["stamp"]["sec"]) * 10**9 + int(header["stamp"]["nanosec"])


def test_poses_and_plans_are_those_of_the_records_in_east_north_up() -> None:
    (header,) = fly_view().of(Header)
    design, poses, plans = read_design(header), 0, 0
    for record, utc_ns, messages in view_flight():
        if isinstance(record, Estimate):
            pose, poses = messages[POSE], poses + 1
            assert NED_FROM_ENU @ read_vector(pose["pose"]["position"]) == pytest.approx(
                np.array(design.position_of(record.mean))
            )
            assert (pose["header"]["frame_id"], read_ns(pose["header"])) == ("map", utc_ns)
        elif isinstance(record, Plan) and record.status is SolveStatus.OPTIMAL:
            path, plans = messages[PLAN]["poses"], plans + 1
            places = np.array([read_vector(pose["pose"]["position"]) for pose in path])
            assert places @ NED_FROM_ENU.T == pytest.approx(design.positions_of(record.states))
            assert {read_ns(b["header"]) - read_ns(a["header"]) for a, b in pairwise(path)} == {design.dt_ns}
    assert poses > 10 and plans > 3


def test_limits_are_boxes_and_those_of_a_plan_lie_within() -> None:
    (header,) = fly_view().of(Header)
    design, tightened = read_design(header), 0
    limits = [messages[LIMITS]["markers"] for _, _, messages in view_flight() if LIMITS in messages]
    for markers in limits:
        boxes = [np.array([read_vector(point) for point in marker["points"]]) for marker in markers]
        assert all(box.shape == (24, 3) for box in boxes)
        # Twelve edges, each along one axis.
        assert all((np.count_nonzero(box[::2] != box[1::2], axis=1) <= 1).all() for box in boxes)
        lows = (boxes[0] @ NED_FROM_ENU.T).min(axis=0)
        bounds = [design.state_box.lower[index] for index in design.position_index]
        assert all(
            low == pytest.approx(bound) for low, bound in zip(lows, bounds, strict=False) if math.isfinite(bound)
        )
        for box in boxes[1:]:
            tightened += 1
            assert (box.min(axis=0) >= boxes[0].min(axis=0) - 1e-9).all()
            assert (box.max(axis=0) <= boxes[0].max(axis=0) + 1e-9).all()
    assert len(limits[0]) == 1 and tightened > 1


def test_the_attitude_is_the_vehicle_s_own_while_it_is_of_now() -> None:
    view, euler_rad = Ros2View("drone1"), (0.1, -0.2, 1.3)
    (header,), (estimate, *_) = fly_view().of(Header), fly_view().of(Estimate)
    moved = VehicleMotion(attitude_rad=euler_rad, attitude_ns=estimate.at_ns)
    list(view.make_messages(header, UTC_NS))
    list(view.make_messages(StepInput(tick=0, at_ns=estimate.at_ns, motion=moved), UTC_NS))
    ned = Rotation.from_euler("ZYX", euler_rad[::-1]).as_matrix()
    want = Rotation.from_matrix(NED_FROM_ENU.T @ ned @ np.diag([1.0, -1.0, -1.0]))
    late = replace(estimate, at_ns=estimate.at_ns + 2_000_000_000)
    for record, rotation in ((estimate, want), (late, Rotation.from_euler("z", 90, degrees=True))):
        ((_, pose),) = view.make_messages(record, UTC_NS)
        found = pose["pose"]["orientation"]
        assert Rotation.from_quat([found[axis] for axis in "xyzw"]).approx_equal(rotation, atol=1e-9)


def test_diagnostics_come_each_second_and_at_each_change_of_the_mode() -> None:
    mode, last_ns, found = None, 0, 0
    for record, utc_ns, messages in view_flight():
        if not isinstance(record, Decision):
            assert DIAGNOSTICS not in messages
            continue
        is_due = utc_ns - last_ns >= 10**9 or record.mode is not mode
        assert (DIAGNOSTICS in messages) == is_due
        if is_due:
            mode, last_ns, found = record.mode, utc_ns, found + 1
            (status,) = messages[DIAGNOSTICS]["status"]
            values = {entry["key"]: entry["value"] for entry in status["values"]}
            assert (values["mode"], values["reason"]) == (record.mode.value, record.reason)
            assert (status["level"] == 2) == (record.mode not in (ControlMode.WAIT, ControlMode.TRACK))
            assert status["name"].startswith("drone1")
    assert found > 3


def test_nothing_but_diagnostics_comes_of_a_design_that_cannot_be_read() -> None:
    view = Ros2View("drone1")
    names = {
        name
        for _, at_ns, record in fly_view().entries
        for name, _ in view.make_messages(
            replace(record, design={}) if isinstance(record, Header) else record, UTC_NS + at_ns
        )
    }
    assert names == {DIAGNOSTICS}

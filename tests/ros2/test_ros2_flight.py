"""`uavctl fly` with positions and orders of a user's own program over ROS 2, judged by the true vehicle."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from node_rig import own_domain
from numpy.typing import NDArray
from operation_rig import Scene, end_process, open_scene
from patience import LIMIT_S, wait_until

from logs.recording.reader import read_kind
from uavctl.config import load_config
from uavctl.records import StepInput, Truth, Vec3

NODE = Path(__file__).parent / "user_node.py"
GOAL_M: Vec3 = (0.5, -1.0, -1.4)  # local NED
GOTO = "goto -1.0 0.5 1.4"  # there, in frame `map`
NEAR_M, REST_MPS, REST_S, SAMPLE_M = 0.3, 0.3, 2.0, 0.1
EXACT = ("sim.camera.rate_hz=60.0", "link.loss=0.0", "link.delay_s=0.0", "link.jitter_s=0.0")
# A machine that stands still sends setpoints late, and the vehicle then moves as none says, and far.
PATIENT = (
    "envelope.unexplained_mps2=50",
    "envelope.disagreement_mps=20",
    "limits.accel_mps2=[1,1,1]",
    "sets.input_lower=[-1,-1,-1]",
    "sets.input_upper=[1,1,1]",
    "sets.state_lower=[-20,-1.5,-inf,-20,-1.5,-inf,-10,-1,-inf]",
    "sets.state_upper=[20,1.5,inf,20,1.5,inf,0,1,inf]",
)


class User:
    """A user's program that runs."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def give(self, order: str) -> bool:
        """Give an order; return whether it is accepted."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(f"{order}\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        return bool(answer["ok"])


@contextmanager
def seen_by_a_user(air: Scene) -> Iterator[User]:
    """A user's program that publishes what the simulated cameras see; the daemon's positions are its topic."""
    command = [sys.executable, str(NODE), str(urlsplit(air.mocap).port), "/drone/pose", "drone1"]
    air.mocap = "ros2://drone/pose?frame=map"
    with end_process(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)) as process:
        assert process.stdin is not None
        with process.stdin:
            yield User(process)


def off_m(place: NDArray[np.float64], way: NDArray[np.float64]) -> float:
    """Distance of a place (3,) from the nearest of the straight lines through successive places (n, 3) [m]."""
    begin, step = way[:-1], np.diff(way, axis=0)
    length2 = np.maximum(np.sum(step**2, axis=1), 1e-12)
    part = np.clip(np.sum((place - begin) * step, axis=1) / length2, 0.0, 1.0)
    return float(np.linalg.norm(begin + part[:, None] * step - place, axis=1).min())


def rests(truths: list[Truth], place_m: Vec3 | None = None) -> bool:
    """Whether the true vehicle has been slow, and near its newest place or a given one, in the last seconds."""
    if not truths or truths[-1].at_ns - truths[0].at_ns < REST_S * 1e9:
        return False
    newest = truths[-1]
    recent = [truth for truth in truths if truth.at_ns >= newest.at_ns - REST_S * 1e9]
    return all(
        math.dist(truth.position_m, place_m or newest.position_m) < NEAR_M
        and math.hypot(*truth.velocity_mps) < REST_MPS
        for truth in recent
    )


def test_a_user_s_program_flies_the_true_vehicle_by_poses_and_orders() -> None:
    target_m = load_config("room").target.position_m
    options = ["--ros2", "drone1", "--ros2-orders", *(text for one in PATIENT for text in ("--set", one))]
    with (
        own_domain(),
        open_scene(*EXACT) as air,
        seen_by_a_user(air) as user,
        end_process(air.fly("f", *options, stderr=subprocess.DEVNULL)) as process,
    ):
        wait_until(lambda: user.give("hold"), "the vehicle is heard")
        held = len(air.truths)
        wait_until(lambda: rests(air.truths[held:]), "it holds")
        assert math.dist(air.truths[-1].position_m, target_m) > 1.0  # the order keeps it from there

        assert user.give(GOTO)
        wait_until(lambda: rests(air.truths, GOAL_M), "it is at the goal")
        assert user.give("resume")
        wait_until(lambda: rests(air.truths, target_m), "it is at the mission's target")

        assert user.give("land")
        wait_until(lambda: air.truths[-1].position_m[2] == 0.0, "it is on the floor")
        assert math.dist(air.truths[-1].position_m[:2], target_m[:2]) < 2 * NEAR_M
        process.communicate(timeout=LIMIT_S)
        recording = air.folder / "f" / "flight.mcap"
        samples = [sample for step in read_kind(recording, StepInput) for sample in step.samples]
        way = np.array([truth.position_m for truth in air.truths])
    assert process.returncode == 0
    assert {sample.source for sample in samples} == {"ODOMETRY 246/197"}
    assert max(off_m(np.array(sample.position_m), way) for sample in samples) < SAMPLE_M

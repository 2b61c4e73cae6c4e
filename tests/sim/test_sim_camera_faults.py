"""What goes wrong in the simulated cameras: by spans written by hand, and by distribution."""

from __future__ import annotations

import math
from itertools import groupby
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from sim_rig import decode

from sim.cameras import UPTIME_S, Cameras
from sim.simulation import MOCAP, Peers
from sim.vehicle.interface import LEVEL, Quaternion
from uavctl.config import load_config
from uavctl.config.connections import FrameConfig
from uavctl.config.sim import CameraConfig
from uavctl.errors import ConfigError
from uavctl.records import Vec3

S = 1_000_000_000
PLAIN = CameraConfig(rate_hz=10.0, message="odometry")
TILTED: Quaternion = (0.8, 0.0, 0.6, 0.0)


def cameras(camera: CameraConfig, seed: int = 5, start_ns: int = 7 * S) -> Cameras:
    return Cameras(camera, FrameConfig(), np.random.SeedSequence(seed), start_ns)


def shots(one: Cameras, count: int) -> dict[int, tuple[int, Any]]:
    """Samples that were seen: number -> (when it was sent after its capture [ns], message).

    The vehicle is at x = number of the sample.
    """
    seen = {}
    for i in range(count):
        at_ns = one.next_ns
        where: Vec3 = (float(i), 0.0, -1.0)
        sample = one.capture(where, (1.0, 0.0, 0.0), TILTED)
        if sample is not None:
            (msg,) = decode(sample[1])
            seen[i] = sample[0] - at_ns, msg
    return seen


@pytest.mark.slow
def test_samples_are_processed_in_a_time_even_over_its_range_which_the_stamp_does_not_show() -> None:
    # As the recorded simulator's cameras: 25 to 124 ms.
    seen = shots(cameras(replace(PLAIN, latency_s=0.025, jitter_s=0.099)), 20_000)
    took_s = np.array([after_ns for after_ns, _ in seen.values()]) / S
    assert len(seen) == 20_000
    assert took_s.min() >= 0.025 and took_s.max() <= 0.124
    # Largest distance from the uniform distribution, at the 1e-4 level of Kolmogorov and Smirnov.
    even = np.linspace(0.0, 1.0, len(took_s))
    assert np.abs((np.sort(took_s) - 0.025) / 0.099 - even).max() < 2.23 / math.sqrt(len(took_s))
    assert [msg.time_usec for _, msg in seen.values()] == [round((UPTIME_S + i / 10) * 1e6) for i in range(20_000)]


@pytest.mark.parametrize("ppm", [-100_000.0, -40.0, 13_000.0])
def test_the_cameras_clock_gains_what_it_is_told_from_its_offset_on(ppm: float) -> None:
    seen = shots(cameras(replace(PLAIN, clock_offset_s=467.0, clock_drift_ppm=ppm)), 3001)
    for i, (_, msg) in seen.items():
        assert msg.time_usec == pytest.approx((UPTIME_S + 467.0 + i / 10 * (1.0 + ppm * 1e-6)) * 1e6, abs=1.0)


def test_nothing_is_sent_of_a_vehicle_that_is_not_seen() -> None:
    seen = shots(cameras(replace(PLAIN, occluded=((0.5, 0.9), (1.15, 1.25)))), 20)
    assert sorted(seen) == [0, 1, 2, 3, 4, 10, 11, 13, 14, 15, 16, 17, 18, 19]
    # The sequence numbers show no gap: nothing was sent.
    assert [msg.get_srcSystem() for _, msg in seen.values()] == [17] * 14
    assert [msg.get_seq() for _, msg in seen.values()] == list(range(14))


def test_another_body_is_taken_for_the_vehicle() -> None:
    seen = shots(cameras(replace(PLAIN, swapped=((0.3, 0.5),), other_body_m=(4.0, -2.0, -0.5))), 8)
    for i, (_, msg) in seen.items():
        swapped = 3 <= i <= 5
        assert (msg.x, msg.y, msg.z) == ((4.0, -2.0, -0.5) if swapped else (float(i), 0.0, -1.0))
        assert msg.q == pytest.approx(LEVEL if swapped else TILTED)
        assert math.hypot(msg.vx, msg.vy, msg.vz) == pytest.approx(0.0 if swapped else 1.0)


def test_a_frozen_stream_repeats_the_last_sample_seen_to_the_bit_with_fresh_stamps() -> None:
    camera = replace(PLAIN, noise_std_m=0.01, frozen=((0.3, 0.6), (1.0, 1.1)), occluded=((0.85, 0.95),))
    seen = shots(cameras(camera), 15)
    poses = {i: (msg.x, msg.y, msg.z, msg.vx, msg.vy, msg.vz, *msg.q) for i, (_, msg) in seen.items()}
    assert [i for i, pose in poses.items() if pose == poses[2]] == [2, 3, 4, 5, 6]
    assert 9 not in poses
    assert [i for i, pose in poses.items() if pose == poses[8]] == [8, 10, 11]
    assert len({msg.time_usec for _, msg in seen.values()}) == len(seen)
    free = shots(cameras(replace(camera, frozen=())), 15)
    assert [i for i in seen if (free[i][1].x, free[i][1].y) == poses[i][:2]] == [0, 1, 2, 7, 8, 12, 13, 14]


def test_a_stream_that_begins_frozen_repeats_its_first_sample() -> None:
    seen = shots(cameras(replace(PLAIN, frozen=((0.0, 0.2),))), 5)
    assert [msg.x for _, msg in seen.values()] == [0.0, 0.0, 0.0, 3.0, 4.0]


@pytest.mark.slow
def test_random_occlusions_have_the_rate_and_the_length_asked_for() -> None:
    n, rate_hz = 40_000, 10.0
    seen = shots(cameras(replace(PLAIN, occlusions_per_s=0.5, occlusion_s=0.4)), n)
    # From sample to sample a chain: seen to hidden with 1 - exp(-0.5 / 10), hidden to hidden with exp(-1 / 4).
    begin, end = 1.0 - math.exp(-0.5 / rate_hz), 1.0 - math.exp(-1.0 / (0.4 * rate_hz))
    share, memory = begin / (begin + end), 1.0 - begin - end
    error = math.sqrt(share * (1 - share) * (1 + memory) / (1 - memory) / n)
    hidden = [i not in seen for i in range(n)]
    assert abs(np.mean(hidden) - share) < 4 * error
    runs = [len(list(run)) for is_hidden, run in groupby(hidden) if is_hidden]
    # Geometric runs: mean 1 / end, variance (1 - end) / end².
    assert abs(np.mean(runs) - 1 / end) < 4 * math.sqrt((1 - end) / end**2 / len(runs))


EFFECTS: dict[str, dict[str, Any]] = {
    "jitter": {"jitter_s": 0.1},
    "occluded": {"occluded": ((2.0, 9.0),)},
    "occlusions": {"occlusions_per_s": 1.0},
    "swapped": {"swapped": ((2.0, 9.0),)},
    "frozen": {"frozen": ((2.0, 9.0),)},
    "drift": {"clock_drift_ppm": 100.0},
    "noise": {"noise_std_m": 0.1},
}


@pytest.mark.parametrize("effect", EFFECTS)
def test_an_effect_switched_on_shifts_no_other_draw(effect: str) -> None:
    base = replace(PLAIN, noise_std_m=0.02, jitter_s=0.05, occlusions_per_s=0.2)
    plain, loaded = shots(cameras(base), 200), shots(cameras(replace(base, **EFFECTS[effect])), 200)
    if effect in ("occluded", "occlusions"):
        assert len(loaded) < len(plain)
        plain = {i: plain[i] for i in loaded if i in plain}
        loaded = {i: loaded[i] for i in plain}
    assert loaded.keys() == plain.keys()
    took = [[after_ns for after_ns, _ in one.values()] for one in (plain, loaded)]
    assert (took[0] == took[1]) == (effect != "jitter")
    after = [i for i in plain if i > 90]
    where = [[one[i][1].x for i in after] for one in (plain, loaded)]
    assert (where[0] == where[1]) == (effect != "noise")


def test_cameras_that_creep_say_more_and_more_beside_the_vehicle() -> None:
    one = cameras(PLAIN)
    place = [msg.x for _, msg in shots(one, 5).values()]
    one.set_drift((0.5, 0.0, 0.0))
    place += [msg.x for _, msg in shots(one, 5).values()]
    one.set_drift((-1.0, 0.0, 0.0))
    place += [msg.x for _, msg in shots(one, 3).values()]
    off = [0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.15, 0.05]  # at 10 Hz
    vehicle = [0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 0, 1, 2]
    assert place == pytest.approx([at + beside for at, beside in zip(vehicle, [0.0] * 5 + off, strict=True)], abs=1e-6)


def test_one_seed_one_history() -> None:
    noisy = replace(PLAIN, noise_std_m=0.01, jitter_s=0.1, occlusions_per_s=0.3)

    def history(seed: int) -> list[tuple[int, int, float]]:
        return [(i, after_ns, msg.x) for i, (after_ns, msg) in shots(cameras(noisy, seed), 300).items()]

    assert history(1) == history(1) != history(2)


def test_samples_that_are_not_sent_shift_nothing_of_the_link() -> None:
    def arrived(*overrides: str) -> dict[int, int]:
        peers = Peers(load_config("room-hahn-stursberg", ["link.loss=0.3", "link.jitter_s=0.1", *overrides]), 0)
        due = [(at_ns, decode(data)) for at_ns, link, data in peers.advance(60 * S) if link == MOCAP]
        return {msg.usec: at_ns for at_ns, (msg,) in due}

    everything = arrived()
    rest = arrived("sim.camera.occluded=[[10.0, 20.0]]")
    outside = {usec: at_ns for usec, at_ns in everything.items() if not 10.0 <= usec * 1e-6 - UPTIME_S <= 20.0}
    assert rest == outside
    assert len(rest) < len(everything) - 20


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("occluded", "[[3, 2]]", "sim.camera.occluded[0]: [3, 2] is not a span of time"),
        ("swapped", "[[1, 2], [-1, 2]]", "sim.camera.swapped[1]: [-1, 2] is not a span of time"),
        ("frozen", "[[2, 2]]", "sim.camera.frozen[0]: [2, 2] is not a span of time"),
        ("occlusion_s", "0", "sim.camera.occlusion_s: expected a number >= 0.001"),
        ("clock_drift_ppm", "2e5", "sim.camera.clock_drift_ppm: expected a number <= 100000"),
    ],
)
def test_what_cannot_be_is_refused(key: str, value: str, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config("room-hahn-stursberg", [f"sim.camera.{key}={value}"])
    (problem,) = caught.value.problems
    assert words in problem

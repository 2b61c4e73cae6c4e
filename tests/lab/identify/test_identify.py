from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from places import DATA
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.recording.tlog import read_tlog
from uavctl.arrays import Array
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.errors import RecordingError
from uavctl.lab.identify.fit import (
    FINE_S,
    MAX_TRIES,
    AxisFit,
    choose_dead_time,
    compute_standard_errors,
    fit_axes,
    is_worse,
    predict,
    predict_ahead,
)
from uavctl.lab.identify.history import (
    FlightHistory,
    PositionHistory,
    Senders,
    SetpointHistory,
    Stretch,
    find_stretches,
    make_position_history,
    read_tlog_history,
    thin_positions,
)
from uavctl.lab.identify.response import (
    TIME_UNIT_S,
    AxisModel,
    DragLagAxis,
    LinearMotion,
    ReferenceAxis,
    compute_transition,
    get_values,
    make_parameters,
)
from uavctl.lab.identify.result import fit_link, identify
from uavctl.smpc.plant import Plant, VelocityReferenceAxis, drag_lag, velocity_reference

DRAG_LAG, HELD = DragLagAxis(drifts=False), ReferenceAxis(1.0, 2.0, 1.0)
TICK_S, NOISE_M, WIND_MPS2, DT_S = 0.05, 0.003, 0.15, 0.2


def fly(
    lag_s: float, drag_1ps: float, gain: float, *, seed: int, seconds: float = 60.0, dead_ticks: int = 0
) -> Stretch:
    """One axis of the plant (1), flown with random setpoints, wind held over a tick, 30 % of positions lost."""
    rng = np.random.default_rng(seed)
    plant = drag_lag([drag_1ps], [lag_s], [gain], [1.0], TICK_S, ("north",))
    count = round(seconds / TICK_S)
    setpoints = np.repeat(rng.uniform(-1.5, 1.5, count // 16 + 1), 16)[:count]
    acting = np.concatenate([np.zeros(dead_ticks), setpoints])[:count]
    wind = WIND_MPS2 * np.sqrt(DT_S / TICK_S) * rng.standard_normal(count)
    state, times, places = np.zeros(3), [], []
    for tick in range(count):
        if tick % 4 == 2 and rng.random() > 0.3:
            times.append(tick * TICK_S)
            places.append((state[0] + NOISE_M * rng.standard_normal(), 0.0, 0.0))
        state = plant.a @ state + plant.b[:, 0] * acting[tick] + plant.e[:, 0] * wind[tick]
    inputs = np.column_stack([setpoints, np.zeros(count), np.zeros(count)])
    return Stretch(np.linspace(0.0, (count - 1) * TICK_S, count), inputs, np.array(times), np.array(places))


def fit_axis(flown: Sequence[Stretch], axis: int, model: AxisModel, dead_time_s: float) -> AxisFit:
    return fit_axes(flown, (axis,), (model,), dead_time_s, (None,))[0]


def test_the_plant_that_made_the_data_is_found_within_its_standard_errors() -> None:
    misses = []
    for seed, (lag_s, drag_1ps, gain) in enumerate([(0.25, 0.3, 1.0), (0.4, 0.8, 1.1)]):
        flown = (fly(lag_s, drag_1ps, gain, seed=seed),)
        fit = fit_axis(flown, 0, DRAG_LAG, 0.0)
        standard_errors = compute_standard_errors(flown, 0, fit)
        errors = tuple(standard_errors[name] for name in ("lag_s", "drag_1ps", "gain"))
        result = tuple(fit.value(name) for name in ("lag_s", "drag_1ps", "gain"))
        misses += [(a - b) / e for a, b, e in zip(result, (lag_s, drag_1ps, gain), errors, strict=True)]
        assert max(errors) < 0.1
        assert fit.value("wind_mps2_rts") / np.sqrt(DT_S) == pytest.approx(WIND_MPS2, rel=0.15)
        assert fit.value("noise_m") == pytest.approx(NOISE_M, rel=0.5)
    assert np.max(np.abs(misses)) < 3.5
    assert np.std(misses) == pytest.approx(1.0, abs=0.7)


@pytest.mark.long
@pytest.mark.parametrize("seed", [5, 6, 7])
def test_the_likeliest_dead_time_is_the_one_that_made_the_data(seed: int) -> None:
    flown = (fly(0.1, 0.1, 1.0, seed=seed, dead_ticks=3),)
    tries: list[int] = []
    result = choose_dead_time(flown, (0,), (DRAG_LAG,), lambda: tries.append(1))
    assert result.dead_time_s == pytest.approx(0.15, abs=0.03)
    assert result.range_s[0] - FINE_S <= 0.15 <= result.range_s[1] + FINE_S
    assert result.range_s[1] - result.range_s[0] < 0.15
    assert result.fits[0].value("lag_s") == pytest.approx(0.1, abs=0.03)
    # What was tried in a chain is no other hill than a search from the start finds.
    for dead_time_s, rise in result.curve[::3]:
        single = fit_axis(flown, 0, DRAG_LAG, dead_time_s)
        assert result.fits[0].deviance + rise == pytest.approx(single.deviance, abs=0.1)
    assert len(tries) == MAX_TRIES


def flown_by_reference(seed: int) -> Stretch:
    """The plant velocity-reference under random setpoints, two ticks late."""
    rng = np.random.default_rng(seed)
    vehicle = VelocityReferenceAxis(0.25, 0.1, 1.0, 2.0, 1.0, 0.03, 0.1, 0.05)
    plant = velocity_reference([vehicle], TICK_S, ("north",))
    setpoints = np.repeat(np.diff(rng.uniform(-0.6, 0.6, 77)) / (16 * TICK_S), 16)  # the reference stays below 0.6 m/s
    acting = np.concatenate([np.zeros(2), setpoints])
    state, times, rows = np.zeros(6), [], []
    for tick in range(len(setpoints)):
        if rng.random() > 0.3:
            times.append(tick * TICK_S)
            rows.append((state[0] + NOISE_M * rng.standard_normal(), 0.0, 0.0))
        kicks = np.sqrt(np.diag(plant.w)) * rng.standard_normal(3)
        state = plant.a @ state + plant.b[:, 0] * acting[tick] + plant.e @ kicks
    inputs = np.column_stack([setpoints, np.zeros((len(setpoints), 2))])
    return Stretch(TICK_S * np.arange(len(setpoints), dtype=np.float64), inputs, np.array(times), np.array(rows))


def missed(flown: Stretch, fit: AxisFit) -> Array:
    """Rms errors of the motion of the next times [m]."""
    return np.array([np.sqrt(np.mean(ahead.errors_m**2)) for ahead in predict_ahead((flown,), 0, fit)])


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_the_plant_with_a_reference_is_found_and_predicts_another_flight(seed: int) -> None:
    flown, other = (flown_by_reference(seed),), flown_by_reference(20 + seed)
    right, wrong = (choose_dead_time(flown, (0,), (kind,), lambda: None) for kind in (HELD, DragLagAxis(drifts=True)))
    fit = right.fits[0]
    assert right.dead_time_s == pytest.approx(0.1, abs=FINE_S + 1e-9)
    assert right.dead_time_s + fit.value("lag_s") == pytest.approx(0.2, abs=0.01)
    assert fit.value("drag_1ps") == pytest.approx(0.25, abs=3.0 * compute_standard_errors(flown, 0, fit)["drag_1ps"])
    assert fit.value("input_mps2_rts") == pytest.approx(0.1 * np.sqrt(TICK_S), rel=0.4)
    assert fit.value("noise_m") == pytest.approx(NOISE_M, rel=0.1)
    assert fit.deviance < wrong.fits[0].deviance - 20.0  # 22 000 times as likely
    # On the halves not fitted to, and on a flight that neither has seen: there it is as good as the truth.
    assert right.held_out.error_m < 0.9 * wrong.held_out.error_m
    assert not is_worse(right.held_out, wrong.held_out)
    true = {
        "lag_s": 0.1,
        "drag_1ps": 0.25,
        "wind_mps2_rts": 0.03 * np.sqrt(TICK_S),
        "noise_m": NOISE_M,
        "input_mps2_rts": 0.1 * np.sqrt(TICK_S),
        "drift_mps2_rts": 0.05,
    }
    truth = AxisFit(HELD, 0.1, tuple(make_parameters(HELD, true).tolist()), 0.0)
    assert np.all(missed(other, fit) < 1.1 * missed(other, truth))
    assert np.all(missed(other, fit) < missed(other, wrong.fits[0]))
    assert missed(other, fit)[-1] < 0.7 * missed(other, wrong.fits[0])[-1]  # 2 s ahead


def test_a_right_model_leaves_white_innovations_and_a_wrong_one_does_not() -> None:
    flown = (fly(0.25, 0.3, 1.0, seed=7),)
    fit = fit_axis(flown, 0, DRAG_LAG, 0.0)
    right = predict(flown, 0, fit)
    inside = np.mean(np.abs(right.innovations_m) <= 2.0 * right.stds_m)
    assert 0.92 <= inside <= 0.98
    assert np.count_nonzero(np.abs(right.correlation) > 1.96 / np.sqrt(len(right.innovations_m))) <= 4
    assert right.r2 > 0.9
    lazy = replace(fit, parameters=(np.log(1.5), *fit.parameters[1:]))
    wrong = predict(flown, 0, lazy)
    assert wrong.r2 < right.r2 - 0.05
    assert wrong.residual_std_m > 1.5 * right.residual_std_m


def advanced(motion: LinearMotion, plant: Plant) -> None:
    """Compare the motion over many instants with the plant's own."""
    count = round(plant.dt_s / TIME_UNIT_S)
    result = compute_transition(motion, np.array([0, count]))
    n_x = plant.n_x
    np.testing.assert_allclose(result.transition[1, 0, :n_x, :n_x], plant.a, atol=1e-11)
    np.testing.assert_allclose(result.input_effect[1, 0, :n_x], plant.b[:, 0], atol=1e-11)
    np.testing.assert_array_equal(result.transition[0, 0], np.eye(motion.a.shape[-1]))


@pytest.mark.parametrize(("lag_s", "drag_1ps"), [(0.25, 0.3), (0.02, 0.0), (0.5, 1.4)])
def test_the_motion_is_that_of_the_plant(lag_s: float, drag_1ps: float) -> None:
    parameters = {
        "lag_s": lag_s,
        "drag_1ps": drag_1ps,
        "gain": 0.9,
        "wind_mps2_rts": 0.7,
        "noise_m": 0.01,
        "input_mps2_rts": 0.2,
        "drift_mps2_rts": 0.3,
    }
    advanced(
        DRAG_LAG.motion(make_parameters(DRAG_LAG, parameters)[None]),
        drag_lag([drag_1ps], [lag_s], [0.9], [1.0], 0.13, ("north",)),
    )
    vehicle = VelocityReferenceAxis(drag_1ps, lag_s, 1.0, 2.0, 1.0, 0.7, 0.2, 0.3)
    motion = HELD.motion(make_parameters(HELD, parameters)[None])
    advanced(motion, velocity_reference([vehicle], 0.13, ("north",)))
    # White noise as the limit of noise that is held over ever shorter parts.
    fine_s = 0.13 / 4000
    white = VelocityReferenceAxis(drag_1ps, lag_s, 1.0, 2.0, 1.0, 0.7 / np.sqrt(fine_s), 0.2 / np.sqrt(fine_s), 0.3)
    part = velocity_reference([white], fine_s, ("north",))
    cov = np.zeros((6, 6))
    for _ in range(4000):
        cov = part.a @ cov @ part.a.T + part.e @ part.w @ part.e.T
    spread = compute_transition(motion, np.array([round(0.13 / TIME_UNIT_S)])).noise_cov[0, 0]
    np.testing.assert_allclose(spread, cov, rtol=2e-3, atol=1e-5)
    assert get_values(HELD, make_parameters(HELD, parameters).tolist())["lag_s"] == pytest.approx(lag_s)


def test_an_outlier_does_not_spoil_the_fit() -> None:
    clean = fly(0.25, 0.3, 1.0, seed=3, seconds=60.0)
    bad = clean.positions_m.copy()
    bad[::25, 0] += 2.0
    rows = zip(clean.times_s, bad[:, 0], strict=True)
    positions = make_position_history([(float(t), float(t), (float(x), 0.0, 0.0)) for t, x in rows])
    gone = ~np.isin(clean.times_s, positions.times_s)
    assert gone[::25][1:].all()
    assert np.count_nonzero(gone) <= len(bad[::25]) + 3
    outliers = clean.positions_m.copy()
    outliers[::25, 0] += 0.1  # too small to be told beforehand
    fit = fit_axis((replace(clean, positions_m=outliers),), 0, DRAG_LAG, 0.0)
    assert fit.value("lag_s") == pytest.approx(0.25, abs=0.1)


def asked_for(times_s: list[float], flown: list[bool]) -> SetpointHistory:
    accel = np.column_stack([np.sin(times_s), np.cos(times_s), np.zeros(len(times_s))])
    return SetpointHistory(np.array(times_s), accel, np.array(flown))


def test_a_pause_and_a_pilot_end_a_stretch() -> None:
    ticks = [0.05 * i for i in range(600)]
    times = [t for t in ticks if not 10.0 < t < 11.0]
    positions = make_position_history([(0.1 * i, 0.1 * i + 0.02, (0.0, 0.0, -1.0)) for i in range(300)])
    result = find_stretches(asked_for(times, [t < 20.0 for t in times]), positions)
    assert [(round(s.times_s[0], 3), round(s.times_s[-1], 3)) for s in result] == [(0.1, 10.0), (11.1, 19.9)]


def test_too_little_is_refused_with_what_is_missing() -> None:
    positions = make_position_history([(0.1 * i, 0.1 * i, (0.0, 0.0, 0.0)) for i in range(30)])
    with pytest.raises(RecordingError, match=r"flown for 3\.0 s, and 30 positions .* at least 5 s"):
        find_stretches(asked_for([0.05 * i for i in range(60)], [True] * 60), positions)


def sent(lost: NDArray[np.bool_]) -> tuple[PositionHistory, NDArray[np.int64]]:
    """What a receiver sees of cameras at 25 Hz whose messages are lost as told, 20 to 120 ms on their way."""
    rng = np.random.default_rng(0)
    at_s = [float(t) for t in np.arange(len(lost))[~lost] / 25.0]
    came = [(t, t + 0.02 + 0.1 * rng.random(), (0.0, 0.0, 0.0)) for t in at_s]
    return make_position_history(came), np.diff(np.flatnonzero(~lost)) - 1


def test_independent_losses_and_delays_are_measured() -> None:
    link = fit_link(*sent(np.random.default_rng(1).random(4000) < 0.3))
    assert link.rate_hz == pytest.approx(25.0, rel=0.01)
    assert link.loss == pytest.approx(0.3, abs=0.02)
    assert not link.bursts
    assert link.delay_s == pytest.approx(0.02, abs=0.002)
    assert link.jitter_s == pytest.approx(0.099, abs=0.004)


def test_bursts_are_distinguished_from_independent_losses() -> None:
    rng = np.random.default_rng(2)
    lost, bad = np.zeros(4000, dtype=bool), False
    for i in range(4000):
        bad = rng.random() < (0.7 if bad else 0.1)
        lost[i] = bad
    link = fit_link(*sent(lost))
    assert link.bursts
    assert link.loss == pytest.approx(0.25, abs=0.04)
    assert sum(link.runs) == pytest.approx(1.0)
    assert sum(link.runs[4:]) > 2.0 * link.loss**4


def camera(number: int, stamp_us: int) -> bytes:
    """A position from system 17, component 18."""
    encoder = mavlink.MAVLink(None, srcSystem=17, srcComponent=18)
    encoder.seq = number % 256
    message = mavlink.MAVLink_vision_position_estimate_message(stamp_us, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return bytes(message.pack(encoder))


def test_numbers_of_messages_wrap_and_overtake() -> None:
    senders = Senders()
    stamps_us = np.cumsum(np.random.default_rng(1).integers(1_000, 90_000, 500)).tolist()  # tell nothing
    order = [*range(200), 203, 202, 204, *range(210, 500)]  # 200, 201, 205 ... 209 are lost, 202 is overtaken
    for number in order:
        senders.take(camera(number, stamps_us[number]), 0)
        if number == 100:  # an id that the dialect has not, of the same sender, has a number of its own
            senders.take(bytes((0xFD, 1, 0, 0, 205, 17, 18, 0x9A, 0x01, 0x00, 7, 0, 0)), 0)
    gaps = senders.count_losses((17, 18))
    assert gaps.sum() == 6
    assert sorted(gaps[gaps > 0]) == [2, 4]


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6])
def test_losses_before_numbering_are_counted_by_the_stamps(share: float) -> None:
    rng = np.random.default_rng(5)
    senders, came = Senders(), np.flatnonzero(rng.random(2000) >= share)
    for number, frame in enumerate(came.tolist()):
        stamp_us = 1_000_000_000 + 25_000 * frame + round(rng.normal(0.0, 1_200.0))
        senders.take(camera(number, stamp_us), 1000 * stamp_us + round(rng.uniform(10e6, 40e6)))
    np.testing.assert_array_equal(senders.count_losses((17, 18)), np.diff(came) - 1)
    shortest_s = senders.estimate_min_delay_s((17, 18))
    assert shortest_s is not None
    assert shortest_s == pytest.approx(0.010, abs=0.001)


def test_a_stamp_of_another_clock_gives_no_delay() -> None:
    for ahead_us in (-30_000_000, 500_000):
        senders = Senders()
        for number in range(100):
            senders.take(camera(number, 25_000 * number + 60_000_000), 1000 * (25_000 * number + 60_000_000 - ahead_us))
        assert senders.estimate_min_delay_s((17, 18)) is None


def test_the_cameras_of_a_recorded_px4_are_not_mistaken_for_its_own_odometry() -> None:
    """The rig stamped 40 positions a second by the recorder's clock, lost 30 %, and let the rest wait 10 to 40 ms.

    It numbered part of what it then lost, and PX4 sends ODOMETRY of its own at 30 Hz without a loss.
    """
    for name in ("room-px4", "room"):
        history = read_tlog_history(read_tlog(DATA / "px4-relay.tlog").packets, load_config(name))
        link = fit_link(history.positions, history.losses)
        sent = 1.0 + 40.0 * (history.positions.times_s[-1] - history.positions.times_s[0])
        assert link.loss == pytest.approx(1.0 - link.received / sent, abs=0.01)
        assert link.loss == pytest.approx(0.3, abs=0.02)
        assert link.bursts
        assert link.rate_hz == pytest.approx(40.0, rel=0.01)
        assert history.latency_s == pytest.approx(0.010, abs=0.002)
        assert link.delay_s == pytest.approx(0.010, abs=0.002)
        assert link.delay_s + link.jitter_s == pytest.approx(0.040, abs=0.005)


def test_the_recorded_arducopter_answers_as_its_own_log_says() -> None:
    """Its truth was fitted with gain 0.95 and dead time + lag 0.14 to 0.16 s, and no drag.

    Seen through positions the shortest delay of 25 ms comes on top, and the ramp of a limited jerk counts as lag.
    """
    config = load_config("room-hahn-stursberg", ["daemon.mocap=tlog", "daemon.vehicle=tlog"])
    history = read_tlog_history(read_tlog(DATA / "arducopter-vicon-loop.tlog").packets, config)
    flown = [thin_positions(stretch, 0.2) for stretch in find_stretches(history.setpoints, history.positions)]
    fit = fit_axis(flown, 0, DRAG_LAG, 0.0)
    assert 0.9 < fit.value("gain") < 1.2
    assert 0.16 < fit.value("lag_s") < 0.32
    assert fit.value("drag_1ps") < 0.15
    assert predict(flown, 0, fit).r2 > 0.97
    link = fit_link(history.positions, history.losses)
    assert link.rate_hz == pytest.approx(24.7, rel=0.03)
    assert link.loss < 0.01
    # Arrivals alone tell what is above the shortest, for which `clock.latency_s` stands.
    assert link.delay_quantiles_s[2] == pytest.approx(0.08, abs=0.02)


def test_an_axis_that_was_not_steered_is_refused_by_name() -> None:
    flown = fly(0.25, 0.3, 1.0, seed=1, seconds=20.0)
    setpoints = SetpointHistory(flown.input_times_s, flown.inputs_mps2, np.ones(len(flown.input_times_s), dtype=bool))
    positions = PositionHistory(flown.times_s, np.zeros(len(flown.times_s)), flown.positions_m)
    with pytest.raises(RecordingError, match="hardly changed in east"):
        identify(
            FlightHistory(setpoints, positions, np.zeros(0, dtype=np.int64)),
            load_config("room-hahn-stursberg"),
            lambda: None,
        )


@pytest.mark.slow
@pytest.mark.usefixtures("no_page")
def test_the_command_writes_a_configuration_that_loads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    waypoints = "[[1.5,1.0,-1.2],[-1.5,-1.0,-1.0],[1.5,-1.0,-1.6],[1.5,1.0,-1.2]]"
    flying = [
        "loopback",
        "--config",
        "room-hahn-stursberg",
        "--set",
        f"mission.waypoints={waypoints}",
        "--duration",
        "30",
        "--out",
        str(tmp_path),
        "--json",
    ]
    assert run(flying) == 0
    capsys.readouterr()
    assert run(["identify", str(tmp_path / "flight.mcap"), "--json"]) == 0
    standard_errors = msgspec.json.decode(capsys.readouterr().out)
    assert {"plant", "residual_std", "r2"} <= standard_errors.keys()
    config = load_config(standard_errors["config"])
    assert config.plant.lag_s == tuple(standard_errors["plant"]["lag_s"])
    assert standard_errors["plant"]["dead_time_s"] <= 0.04
    flown = load_config("room-hahn-stursberg").plant.lag_s  # `clock.latency_s` stands for the shortest delay
    for standard_error, lag_s in zip(standard_errors["response"], flown, strict=True):
        assert abs(standard_errors["plant"]["dead_time_s"] + standard_error["lag_s"] - lag_s) < 0.06
    page = Path(standard_errors["report"]).read_text(encoding="utf-8")
    assert page.count("<svg") == 12
    assert run(["identify", str(tmp_path / "flight.mcap")]) == 0
    told_in_words = capsys.readouterr().out
    for heading in ("lag [s]", "drag [1/s]", "wind [m/s²]", "residual [mm]"):
        assert heading in told_in_words
    assert run(["identify", str(tmp_path / "flight.mcap"), "--config", "paper"]) == 2
    assert run(["identify", str(tmp_path / "nothing.mcap")]) == 1

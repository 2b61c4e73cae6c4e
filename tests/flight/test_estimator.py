"""The filter against brute-force conditioning, the Riccati equation, and itself with another order of arrival."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
from flight_rig import (
    DT_NS,
    MS,
    START_NS,
    TICK_NS,
    TICKS,
    boundary_ns,
    drag_lag_generator,
    estimator_parameters,
    sample,
    small_plant,
)
from msgspec.structs import replace as changed
from scipy.linalg import expm, solve_discrete_are

from uavctl.arrays import Array
from uavctl.event_codes import EventCode
from uavctl.flight.estimator import (
    FilterHistory,
    absorb_samples,
    advance_window,
    begin_history,
    drop_samples,
    estimate_at,
    insert_sample,
    note_input,
    predict_belief,
    weaken_samples,
)
from uavctl.flight.kalman import (
    Belief,
    Kalman,
    divide_by_spread,
    is_consistent,
    make_kalman,
    predict,
    update_with_inertial,
    update_with_position,
)
from uavctl.flight.monitors.inertial import MOST_CHI2, InertialTrust
from uavctl.flight.propagation import make_propagation
from uavctl.records import Estimate, PositionSample
from uavctl.smpc.plant import Plant

S = 1_000_000_000


def make(axes: tuple[str, ...] = ("north",), wind_std: float = 0.15, **changes: float) -> tuple[Kalman, FilterHistory]:
    kalman = make_kalman(small_plant(axes, wind_std), estimator_parameters(**changes), DT_NS)
    return kalman, begin_history(kalman, START_NS, START_NS)


def fly(
    kalman: Kalman, samples: Sequence[PositionSample], inputs: Sequence[float], ticks: int
) -> list[Estimate | None]:
    """Tick by tick: the samples that have arrived, then this tick's input; the estimate of each tick."""
    history = begin_history(kalman, START_NS, START_NS)
    result = []
    for tick in range(ticks):
        at_ns = START_NS + tick * TICK_NS
        due = [one for one in samples if at_ns - TICK_NS < one.received_ns <= at_ns]
        history, _, _ = absorb_samples(kalman, history, at_ns, due)
        result.append(estimate_at(kalman, history, at_ns))
        history = note_input(history, at_ns, np.full(kalman.n_u, inputs[tick]))
    return result


def test_propagation_is_the_matrix_exponential_over_any_part_of_a_step() -> None:
    propagation = make_propagation(small_plant(), DT_NS)
    generator = drag_lag_generator(0.3, 0.25)
    for dt_ns in (1, 3 * MS, 77 * MS, 100 * MS, DT_NS - 1, DT_NS):
        f, _, g = propagation.over(dt_ns)
        want = expm(generator * dt_ns * 1e-9)
        np.testing.assert_allclose(f, want[:4, :4], rtol=0, atol=2e-12)
        np.testing.assert_allclose(g, want[:4, 4:], rtol=0, atol=2e-12)


@pytest.mark.slow
def test_a_span_asked_for_again_gives_the_same_bits_and_cannot_be_written_to() -> None:
    plant, rng = small_plant(), np.random.default_rng(3)
    propagation = make_propagation(plant, DT_NS)
    spans = [*rng.integers(1, DT_NS, 200).tolist(), DT_NS]
    for dt_ns in (*spans, *spans[::-1]):
        fresh = make_propagation(plant, DT_NS).over(dt_ns)
        for known, new in zip(propagation.over(dt_ns), fresh, strict=True):
            assert known.tobytes() == new.tobytes() and not known.flags.writeable
    assert len(propagation.parts) < 100  # arbitrary stamps do not fill the memory


@pytest.mark.parametrize("axes", [("north",), ("north", "east", "down")])
def test_a_prediction_has_the_bits_of_its_formula_written_down(axes: tuple[str, ...]) -> None:
    """Recordings replay bit for bit: products may be made in a faster way, and give nothing else."""
    kalman, _ = make(axes, bias_drift=0.1, bias_max=0.4, inertial_std_mps2=0.2)
    rng, n_x, n_z = np.random.default_rng(5), kalman.n_x, len(kalman.identity)
    for _ in range(200):
        root, u = rng.normal(size=(n_z, n_z)), rng.normal(size=kalman.n_u)
        mean, cov = rng.normal(size=n_z), root @ root.T * 10.0 ** rng.uniform(-4, 0)
        begun_ns, at_ns = sorted((START_NS + rng.integers(0, 2 * DT_NS, 2)).tolist())
        known = Belief(
            at_ns=begun_ns, captured_ns=begun_ns, mean=mean, cov=cov, inertial=InertialTrust(used_ns=begun_ns)
        )
        found = predict(kalman, START_NS, known, u, at_ns)
        now_ns = begun_ns
        while now_ns < at_ns:
            end_ns = min(at_ns, START_NS + ((now_ns - START_NS) // DT_NS + 1) * DT_NS)
            f, _, g = kalman.propagation.over(end_ns - now_ns)
            mean, cov = f @ mean + g @ u, f @ cov @ f.T
            cov = 0.5 * (cov + cov.T)
            if (end_ns - START_NS) % DT_NS == 0:
                mean[n_x:], cov[:n_x, n_x:], cov[n_x:, :n_x], cov[n_x:, n_x:] = 0.0, 0.0, 0.0, kalman.w
            now_ns = end_ns
        assert found.mean.tobytes() == mean.tobytes() and found.cov.tobytes() == cov.tobytes()


@pytest.mark.parametrize("axes", [("north",), ("north", "east", "down")])
def test_an_update_has_the_bits_of_its_formula_written_down(axes: tuple[str, ...]) -> None:
    kalman, _ = make(axes, bias_drift=0.1, bias_max=0.4, inertial_std_mps2=0.2)
    rng, n_z = np.random.default_rng(6), len(kalman.identity)

    def joseph(belief: Belief, of_z: Array, off: Array, noise: Array) -> tuple[Array, Array]:
        ph = belief.cov @ of_z.T
        gain = np.linalg.solve(of_z @ ph + noise, ph.T).T
        keep = np.eye(n_z) - gain @ of_z
        cov = keep @ belief.cov @ keep.T + gain @ noise @ gain.T
        return belief.mean + gain @ off, 0.5 * (cov + cov.T)

    for _ in range(200):
        root, u = rng.normal(size=(n_z, n_z)), rng.normal(size=kalman.n_u)
        belief = Belief(at_ns=START_NS, captured_ns=START_NS, mean=rng.normal(size=n_z), cov=root @ root.T)
        belief = changed(belief, inertial=InertialTrust(used_ns=START_NS))  # not the first one
        accel = kalman.inertial_z @ belief.mean + kalman.inertial_u @ u + 0.01 * rng.normal(size=kalman.n_inertial)
        off = accel - kalman.inertial_z @ belief.mean - kalman.inertial_u @ u
        mean, cov = joseph(belief, kalman.inertial_z, off, np.eye(kalman.n_inertial) * 0.2**2)
        found = update_with_inertial(kalman, belief, accel, u)
        assert found.mean.tobytes() == mean.tobytes() and found.cov.tobytes() == cov.tobytes()
        one = sample(START_NS, position_m=tuple(rng.normal(size=3).tolist()))
        values = np.array(one.position_m)[list(kalman.axes)]
        of_z = np.eye(n_z)[kalman.measured_index[: len(values)]]
        noise = np.diag([max(one.std_m, kalman.parameters.position_std_m) ** 2] * len(values))
        mean, cov = joseph(belief, of_z, values - belief.mean[kalman.measured_index[: len(values)]], noise)
        found = update_with_position(kalman, belief, one)
        # Rows picked out of the covariance and a product with them differ in nothing either.
        assert found.mean.tobytes() == mean.tobytes() and found.cov.tobytes() == cov.tobytes()


@pytest.mark.parametrize("count", range(1, 7))
def test_the_gain_of_independent_axes_has_the_bits_of_the_solution(count: int) -> None:
    rng = np.random.default_rng(count)
    for _ in range(500):
        root, ph = rng.normal(size=(count, count)), rng.normal(size=(24, count))
        coupled = root @ root.T * 10.0 ** rng.uniform(-6, 2)
        independent = np.diag(coupled.diagonal() * 10.0 ** rng.uniform(-3, 3, count))
        for spread in (coupled, independent):
            assert divide_by_spread(ph, spread).tobytes() == np.linalg.solve(spread, ph.T).T.tobytes()


@pytest.mark.parametrize("axes", [("north",), ("north", "east", "down")])
def test_a_sample_contradicts_by_its_distance_whether_that_has_to_be_solved_for_or_not(axes: tuple[str, ...]) -> None:
    kalman, _ = make(axes, bias_drift=0.1, bias_max=0.4, inertial_std_mps2=0.2)
    rng, n_z, found = np.random.default_rng(7), len(kalman.identity), []
    index = kalman.measured_index[: len(axes)]
    for _ in range(2000):
        root = rng.normal(size=(n_z, n_z)) * 10.0 ** rng.uniform(-4, 0)
        belief = Belief(at_ns=START_NS, captured_ns=START_NS, mean=rng.normal(size=n_z), cov=root @ root.T)
        variances = 10.0 ** rng.uniform(-5, -3, len(axes))
        of_values = belief.cov[np.ix_(index, index)] + np.diag(variances)
        off = np.linalg.cholesky(of_values) @ rng.normal(size=len(axes)) * 10.0 ** rng.uniform(-1, 1.5)
        distance = float(off @ np.linalg.inv(of_values) @ off)
        assert is_consistent(kalman, belief, belief.mean[index] + off, variances) == (distance <= MOST_CHI2)
        plain = off @ off <= 0.9 * MOST_CHI2 * variances.min()
        found.append((bool(plain), distance > MOST_CHI2))
    assert all(found.count(one) > 50 for one in ((True, False), (False, False), (False, True)))
    broken = np.full(len(axes), np.nan)
    assert is_consistent(kalman, belief, broken, variances)


def test_the_belief_of_the_instant_may_be_given_with_an_input() -> None:
    kalman, history = make()
    rng = np.random.default_rng(4)
    given = history
    for tick in range(4 * TICKS):  # boundaries with their marks among them
        at_ns = START_NS + tick * TICK_NS
        due = [sample(at_ns - 3 * MS, at_ns, position_m=(float(rng.normal()), 0.0, 0.0))] if tick % 3 == 1 else []
        history, given = (absorb_samples(kalman, one, at_ns, due)[0] for one in (history, given))
        u = rng.normal(size=1)
        history = note_input(history, at_ns, u)
        given = note_input(given, at_ns, u, predict_belief(kalman, given, at_ns))
        later_ns = at_ns + TICK_NS // 2
        assert repr(estimate_at(kalman, given, later_ns)) == repr(estimate_at(kalman, history, later_ns))


def test_the_belief_of_the_capture_time_may_be_given_with_a_sample() -> None:
    kalman, history = make()
    rng = np.random.default_rng(5)
    given = history
    # Late and in order, at the instant of an input and of a boundary, and twice at one instant from two sources.
    due = {
        2: [(85, "left")],
        3: [(150, "left"), (100, "left")],
        5: [(200, "left"), (230, "right"), (230, "left"), (230, "west")],
    }
    for tick in range(3 * TICKS):
        at_ns = START_NS + tick * TICK_NS
        for since_ms, source in due.get(tick, ()):
            one = sample(START_NS + since_ms * MS, at_ns, position_m=(float(rng.normal()), 0.0, 0.0), source=source)
            belief = predict_belief(kalman, given, one.captured_ns)
            history, _, _ = absorb_samples(kalman, history, at_ns, (one,))
            given, refused = insert_sample(kalman, advance_window(kalman, given, at_ns), one, belief)
            assert refused is None
        u = rng.normal(size=1)
        history, given = (note_input(known, at_ns, u) for known in (history, given))
        later_ns = at_ns + TICK_NS // 2
        assert repr(estimate_at(kalman, given, later_ns)) == repr(estimate_at(kalman, history, later_ns))


def brute_force(
    samples: Sequence[PositionSample], inputs: Sequence[tuple[int, float]], at_ns: int, wind_std: float
) -> tuple[Array, Array]:
    """Condition the joint Gaussian of (x at the first sample, one w a Δt) on all other samples at once.

    Each state is written as an affine function of those; the input changes and boundaries cut the time.
    """
    ordered = sorted(samples, key=lambda one: one.captured_ns)
    begin_ns = ordered[0].captured_ns
    first_interval = (begin_ns - START_NS) // DT_NS
    draws = (at_ns - START_NS) // DT_NS - first_interval + 1
    prior = np.diag([0.005**2, 0.3**2, 0.3**2, *[wind_std**2] * draws])
    offset = np.array([ordered[0].position_m[0], 0.0, 0.0])
    linear = np.hstack([np.eye(3), np.zeros((3, draws))])
    cuts = {begin_ns, at_ns, *(one.captured_ns for one in ordered), *(when for when, _ in inputs)}
    cuts |= {START_NS + (first_interval + n) * DT_NS for n in range(draws + 1)}
    times = sorted(t for t in cuts if begin_ns <= t <= at_ns)
    rows, values, variances = [], [], []

    def observe(when: int) -> None:
        for one in ordered[1:]:
            if one.captured_ns == when:
                rows.append(linear[0])
                values.append(one.position_m[0] - offset[0])
                variances.append(one.std_m**2)

    for earlier, later in itertools.pairwise(times):
        observe(earlier)
        step = expm(drag_lag_generator(0.3, 0.25) * (later - earlier) * 1e-9)
        u = next((value for when, value in reversed(inputs) if when <= earlier), 0.0)
        draw = np.zeros(3 + draws)
        draw[3 + (earlier - START_NS) // DT_NS - first_interval] = 1.0
        linear = step[:3, :3] @ linear + np.outer(step[:3, 3], draw)
        offset = step[:3, :3] @ offset + step[:3, 4] * u
    observe(times[-1])
    h = np.array(rows)
    gain = prior @ h.T @ np.linalg.inv(h @ prior @ h.T + np.diag(variances))
    posterior = prior - gain @ h @ prior
    return offset + linear @ gain @ np.array(values), linear @ posterior @ linear.T


def test_equals_conditioning_the_joint_gaussian_at_once() -> None:
    captured = [30, 61, 200, 255, 390, 401, 555, 600, 715]  # within steps, twice in one, and on boundaries [ms]
    positions = [0.10, 0.14, 0.11, 0.19, 0.22, 0.20, 0.28, 0.33, 0.30]
    samples = [
        sample(START_NS + t * MS, position_m=(p, 9.0, 9.0), std_m=0.02 if t == 390 else 0.005)
        for t, p in zip(captured, positions, strict=True)
    ]
    ticks = 17
    values = [0.0, 0.5, 0.5, -0.3, *[1.0] * 6, *[0.2] * 7]
    changes = [(START_NS + tick * TICK_NS, values[tick]) for tick in range(ticks)]
    kalman, _ = make()
    flown = fly(kalman, samples, values, ticks)[-1]
    assert flown is not None
    mean, cov = brute_force(samples, changes, START_NS + (ticks - 1) * TICK_NS, wind_std=0.15)
    np.testing.assert_allclose(flown.mean, mean, rtol=0, atol=1e-10)
    np.testing.assert_allclose(flown.cov, cov, rtol=1e-8, atol=1e-13)


def test_reaches_the_steady_state_of_the_riccati_equation() -> None:
    plant = small_plant()
    kalman, history = make()
    for number in range(200):
        at_ns = boundary_ns(number)
        history, _, _ = absorb_samples(kalman, history, at_ns, [sample(at_ns)])
    h = np.array([[1.0, 0.0, 0.0]])
    predicted = solve_discrete_are(plant.a.T, h.T, plant.e @ plant.w @ plant.e.T, np.array([[0.005**2]]))
    gain = predicted @ h.T / (predicted[0, 0] + 0.005**2)
    steady = estimate_at(kalman, history, boundary_ns(199))
    assert steady is not None
    np.testing.assert_allclose(steady.cov, predicted - gain @ h @ predicted, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_late_samples_give_the_same_bits_as_samples_in_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ticks = 60
    captured = np.sort(rng.choice(np.arange(-100, 50 * (ticks - 30)), size=40, replace=False))
    boundaries = rng.choice(np.arange(1, 7), size=2, replace=False) * (DT_NS // MS)  # some exactly on the grid
    stamps = sorted({*map(int, captured), *map(int, boundaries)})
    positions = rng.normal(size=(len(stamps), 3))
    delays = rng.integers(0, 1400, size=len(stamps))
    inputs = rng.normal(size=ticks)
    kalman, _ = make(("north", "east", "down"))

    def arriving(delayed: bool) -> list[Estimate | None]:
        samples = [
            sample(
                START_NS + t * MS,
                START_NS + (t + int(delay) * delayed) * MS,
                (p[0], p[1], p[2]),
                velocity_mps=(p[1], p[2], p[0]) if t % 3 == 0 else None,
                source="left" if t % 2 else "right",
            )
            for t, p, delay in zip(stamps, positions, delays, strict=True)
            if t >= 0
        ]
        return fly(kalman, samples, list(inputs), ticks)

    in_order, late = arriving(False), arriving(True)
    assert in_order[-1] is not None
    assert in_order[-1] == late[-1]
    assert in_order[10] != late[10]  # the delays did matter on the way


def test_a_late_sample_may_turn_out_to_be_the_first() -> None:
    kalman, history = make()
    early, later = sample(START_NS + 10 * MS, position_m=(1.0, 0, 0)), sample(START_NS + 90 * MS)
    at_ns = START_NS + 100 * MS
    one, _, _ = absorb_samples(kalman, history, at_ns, [later])
    one, taken, _ = absorb_samples(kalman, one, at_ns, [early])
    both, _, _ = absorb_samples(kalman, history, at_ns, [early, later])
    assert taken == (early,)
    assert estimate_at(kalman, one, at_ns) == estimate_at(kalman, both, at_ns)


def test_duplicates_and_samples_beyond_the_window_are_refused_with_the_reason() -> None:
    kalman, history = make()
    at_ns = START_NS + 3 * S
    good = sample(at_ns - 10 * MS)
    same_time_elsewhere = sample(at_ns - 10 * MS, source="second")
    old = sample(at_ns - 2 * S)
    just_young_enough = sample(at_ns - 2 * S + 1)
    history, taken, refused = absorb_samples(
        kalman, history, at_ns, [good, good, same_time_elsewhere, old, just_young_enough]
    )
    assert taken == (good, same_time_elsewhere, just_young_enough)
    assert refused == (EventCode.SAMPLE_DUPLICATE, EventCode.SAMPLE_TOO_OLD)
    before = estimate_at(kalman, history, at_ns)
    history, taken, refused = absorb_samples(kalman, history, at_ns, [good])
    assert (taken, refused) == ((), (EventCode.SAMPLE_DUPLICATE,))
    assert estimate_at(kalman, history, at_ns) == before


def test_nothing_is_known_before_the_first_sample() -> None:
    kalman, history = make()
    history, _, _ = absorb_samples(kalman, history, START_NS, [])
    history = note_input(history, START_NS, np.array([1.0]))
    assert estimate_at(kalman, history, START_NS) is None
    assert history.captured_ns is None


def test_first_sample_sets_what_it_shows_and_leaves_the_rest_at_zero() -> None:
    kalman, history = make(("east", "down"))
    history, _, _ = absorb_samples(kalman, history, START_NS, [sample(START_NS, position_m=(7.0, 1.5, -0.5))])
    first = estimate_at(kalman, history, START_NS)
    assert first is not None
    assert first.mean == (1.5, 0.0, 0.0, -0.5, 0.0, 0.0)
    np.testing.assert_allclose(np.diag(first.cov), [0.005**2, 0.09, 0.09] * 2, rtol=1e-12)


def test_exact_samples_with_velocity_give_the_measured_state_back() -> None:
    dt_ns = S
    plant = Plant(
        a=np.array([[1.0, 0.79], [0.0, 0.61]]),
        b=np.array([[0.21], [0.39]]),
        e=np.array([[0.5], [1.0]]),
        w=np.array([[0.6]]),
        dt_s=1.0,
        axes=("north",),
        position_index=(0,),
        velocity_index=(1,),
        accel_per_input=np.array([0.49429632181478]),
    )
    kalman = make_kalman(plant, estimator_parameters(position_std_m=1e-5, velocity_std_mps=1e-5), dt_ns)
    history = begin_history(kalman, START_NS, START_NS)
    rng = np.random.default_rng(3)
    x = np.array([35.0, -2.0])
    for number in range(20):
        at_ns = START_NS + number * dt_ns
        one = sample(at_ns, position_m=(x[0], 0.0, 0.0), velocity_mps=(x[1], 0.0, 0.0), std_m=1e-5)
        history, _, _ = absorb_samples(kalman, history, at_ns, [one])
        measured = estimate_at(kalman, history, at_ns)
        assert measured is not None
        np.testing.assert_allclose(measured.mean, x, rtol=0, atol=1e-5)
        u = rng.uniform(-7.5, 7.5, size=1)
        history = note_input(history, at_ns, u)
        x = plant.a @ x + plant.b @ u + plant.e @ rng.normal(scale=0.6**0.5, size=1)


def test_a_sample_may_claim_to_be_worse_than_configured_but_not_better() -> None:
    kalman, history = make()
    variances = []
    for std in (1e-12, 0.005, 0.5):
        one, _, _ = absorb_samples(kalman, history, START_NS, [sample(START_NS, std_m=std)])
        result = estimate_at(kalman, one, START_NS)
        assert result is not None
        variances.append(result.cov[0][0])
    np.testing.assert_allclose(variances, [0.005**2, 0.005**2, 0.25])


def test_covariance_stays_symmetric_and_positive_semidefinite() -> None:
    rng = np.random.default_rng(11)
    kalman, history = make(("north", "east", "down"), position_std_m=1e-6, velocity_std_mps=1e-6)
    for tick in range(400):
        at_ns = START_NS + tick * TICK_NS
        due = [sample(at_ns - int(rng.integers(0, 40)) * MS, at_ns, velocity_mps=(0, 0, 0), std_m=1e-6)]
        history, _, _ = absorb_samples(kalman, history, at_ns, due if rng.random() < 0.4 else [])
        result = estimate_at(kalman, history, at_ns)
        if result is not None:
            cov = np.array(result.cov)
            assert (cov == cov.T).all()
            assert np.linalg.eigvalsh(cov).min() > -1e-12 * np.abs(cov).max()


def test_silence_is_prediction_and_the_history_stays_within_the_window() -> None:
    kalman, history = make()
    history, _, _ = absorb_samples(kalman, history, START_NS, [sample(START_NS, velocity_mps=(1.0, 0, 0))])
    for tick in range(1, 400):
        history, _, _ = absorb_samples(kalman, history, START_NS + tick * TICK_NS, [])
    assert len(history.entries) <= 2 * S // DT_NS
    result = estimate_at(kalman, history, START_NS + 399 * TICK_NS)
    assert result is not None
    want = expm(drag_lag_generator(0.3, 0.25) * 399 * TICK_NS * 1e-9)[:3, 1]
    np.testing.assert_allclose(result.mean, want, rtol=1e-8, atol=1e-9)
    assert result.captured_ns == START_NS


def test_an_estimate_of_an_earlier_time_leaves_out_what_came_after() -> None:
    kalman, history = make()
    history, _, _ = absorb_samples(kalman, history, START_NS, [sample(START_NS)])
    at_ns = boundary_ns(1) + TICK_NS
    alone, _, _ = absorb_samples(kalman, history, at_ns, [])
    more, _, _ = absorb_samples(kalman, history, at_ns, [sample(boundary_ns(1) + 1, position_m=(1.0, 0.0, 0.0))])
    assert estimate_at(kalman, more, boundary_ns(1)) == estimate_at(kalman, alone, boundary_ns(1))
    assert estimate_at(kalman, more, at_ns) != estimate_at(kalman, alone, at_ns)
    assert estimate_at(kalman, more, START_NS - 1) is None


def test_a_stamp_after_the_arrival_counts_from_the_arrival() -> None:
    kalman, history = make()
    at_ns = START_NS + TICKS * TICK_NS
    history, _, _ = absorb_samples(kalman, history, at_ns, [sample(at_ns + 5 * MS, at_ns - 3 * MS)])
    assert history.captured_ns == at_ns - 3 * MS


def told(kalman: Kalman, history: FilterHistory) -> list[str]:
    """All that is known, to the last bit."""
    states = [predict_belief(kalman, history, entry.key[0]) for entry in history.entries]
    return [repr((history.origin_ns, history.window_begin_ns, history.anchor)), repr(history.entries), repr(states)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("bias_drift", [0.0, 0.03])
def test_what_is_taken_back_is_as_if_it_had_never_come(seed: int, bias_drift: float) -> None:
    """Samples late, in bursts, from two sources; some of what came after the window's begin was poisoned."""
    rng = np.random.default_rng(seed)
    kalman, history = make(bias_drift=bias_drift, bias_max=0.4)
    never, ticks = history, 70
    window_ns = 2 * S
    poisoned_from_ns = START_NS + (ticks - 1) * TICK_NS - window_ns + int(rng.integers(1, S))

    def poisoned(one: PositionSample) -> bool:
        return one.source == "bad" and one.captured_ns > poisoned_from_ns

    taken_back = 0
    for tick in range(ticks):
        at_ns = START_NS + tick * TICK_NS
        due = [
            sample(
                at_ns - int(rng.integers(0, 4 * TICK_NS)),
                at_ns,
                position_m=(float(rng.normal()), 0.0, 0.0),
                source="bad" if rng.random() < 0.5 else "good",
            )
            for _ in range(rng.integers(0, 3))
        ]
        taken_back += sum(map(poisoned, due))
        history, _, _ = absorb_samples(kalman, history, at_ns, due)
        never, _, _ = absorb_samples(kalman, never, at_ns, [one for one in due if not poisoned(one)])
        u = None if tick % 17 == 0 else rng.normal(size=1)
        if rng.random() < 0.6:
            history, never = (note_input(known, at_ns, u) for known in (history, never))
    assert taken_back > 3 and told(kalman, history) != told(kalman, never)
    assert told(kalman, drop_samples(history, poisoned)) == told(kalman, never)
    assert told(kalman, drop_samples(never, poisoned)) == told(kalman, never)


def test_what_the_anchor_holds_is_not_taken_back() -> None:
    kalman, history = make()
    history, _, _ = absorb_samples(kalman, history, START_NS, [sample(START_NS)])
    history, _, _ = absorb_samples(kalman, history, START_NS + 3 * S, [sample(START_NS + 3 * S)])
    history = drop_samples(history, lambda one: True)
    assert history.captured_ns == START_NS
    assert all(one.sample is None for one in history.entries)


def test_weakened_samples_count_as_if_they_had_come_with_that_noise() -> None:
    kalman, begun = make()
    samples = [sample(START_NS + n * S // 20, std_m=std_m) for n, std_m in enumerate((0.005, 0.08, 0.01))]
    weak = [changed(one, std_m=max(one.std_m, 0.04)) for one in samples]
    (sharp, _, _), (blunt, _, _) = (absorb_samples(kalman, begun, START_NS + S, every) for every in (samples, weak))
    assert told(kalman, sharp) != told(kalman, blunt)
    assert told(kalman, weaken_samples(sharp, 0.04)) == told(kalman, blunt)
    assert weaken_samples(sharp, 0.005).entries == sharp.entries

"""Monitor: do the vehicle's own velocity and its inertial data change alike? If not, which of them is wrong?

1. Over the last second, or since they last were compared, three changes of the velocity are known: of the vehicle's own
   velocity (Δv), the integral of its inertial data (Δi), and what the setpoints give (Δm). None needs a position.
2. Δv and Δi that are near each other are both right: then positions that contradict them are wrong. Without inertial
   data, or where these are wrong, so is a Δv that is as near to Δm as gusts explain. Changes no larger than a
   disagreement show nothing: a velocity that is mirrored or late makes none, either.
3. Else the one that is further from Δm is wrong, with or without the acceleration d that positions showed last beside
   the setpoints; both are, if both are further than gusts explain. Where Δv is known to be wrong, only Δi is compared.
4. An own velocity that repeats to the last bit while Δm grows is wrong, too. So is one that leaps from one message to
   the next by more than Δm and gusts explain. Once inertial data are known to be wrong, half as much is a proof.
5. Where the own velocity has stopped, or has repeated for a second, Δi that is further from Δm than gusts explain is
   wrong.

A wrong velocity is not braked on, and wrong inertial data do not carry the estimate on. The own velocity that was right
before is kept: with Δm it is the best that is known without a position. Where no position comes, the vehicle brakes
(`uavctl.flight.supervise`). Wrong inertial data are compared again after three seconds, a wrong velocity once positions
have agreed with it and it does not repeat. While positions that come back correct the vehicle's own velocity, nothing
is compared.

False alarms: none in flights without a lie in blackouts and wind (tests/e2e/test_wind_truth.py).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from operator import itemgetter

import msgspec
from msgspec.structs import replace

from uavctl.flight.monitors.motion import TickObservation, bound_gusts_mps
from uavctl.flight.monitors.observation import EnvelopeParameters, read_vehicle_velocity
from uavctl.flight.monitors.velocity import CORRECTS_NS, VelocityState
from uavctl.records import Vector

WINDOW_NS = 1_000_000_000  # longer integrals of inertial data drift, over shorter ones a change is small
PERSISTS_NS = 50_000_000  # time for which a disagreement has to last: one message may be late
INERTIAL_DRIFT_MPS2 = 0.3  # of a velocity by inertial data: a tilt of two degrees
# Bounds of gusts, for inertial data that nothing but setpoints checks: with 1.0, 1 of 40 flights without a lie braked.
LONE_GUSTS = 1.2
NEARER = 3.0  # times as near to the setpoints as the own velocity: inertial data do not come so near by chance
INERTIAL_DISTRUST_NS = 3_000_000_000  # then inertial data are compared again
STOPPED_NS = 1_500_000_000  # then the own velocity has stopped: a vehicle may send it once a second
LEAST_S = 0.5  # over less, setpoints alone say nothing of an own velocity
RECENT_NS = 300_000_000  # an agreement counts for so long
REPEATS_NS = 1_000_000_000  # even a velocity that comes twice a second has changed in this time
# Leap from one message to the next: a disagreement, and what a turned response makes of usual setpoints. Where
# inertial data were found wrong, nothing else checks the own velocity. Flights without a lie, recorded ones of real
# autopilots included, stayed 0.2 m/s below the second bound.
LEAP_MPS2, LONE_LEAP_MPS2 = 6.0, 3.0
_TIME = itemgetter(0)  # of samples, oldest first

# Time [ns]; own velocity, integral of inertial data (None without any), model's [m/s]
Sample = tuple[int, Vector, Vector | None, Vector]


class VelocityChangeState(msgspec.Struct, frozen=True):
    """State of the monitor."""

    samples: tuple[Sample, ...] = ()  # of the window, oldest first
    # Time [ns], integral of inertial data, model's [m/s], of the window, where no own velocity comes; oldest first
    lone: tuple[tuple[int, Vector, Vector], ...] = ()
    agreed_ns: int | None = None  # when both changes last agreed [ns]; None before
    supported_ns: int | None = None  # when they last agreed on one that is larger than a disagreement [ns]; None before
    confirmed_ns: int | None = None  # when both last agreed on a change that a wrong velocity would not have [ns]
    disagrees_ns: int | None = None  # time since which they do not [ns]; None while they do
    repeated: tuple[Vector, Vector, int] | None = None  # the own velocity, the model's when it first came, that time
    velocity_wrong_ns: int | None = None  # when the own velocity was found wrong [ns]; None while it is not
    inertial_wrong_ns: int | None = None  # when inertial data were found wrong [ns]; None while they are not
    # The last own velocity that was right, less the model's then [m/s]; None while a right one comes
    right_beside_model_mps: Vector | None = None
    right_ns: int | None = None  # its time [ns]

    @property
    def has_found_wrong(self) -> bool:
        """Whether the own velocity or inertial data were found wrong."""
        return self.velocity_wrong_ns is not None or self.inertial_wrong_ns is not None

    def is_missing(self, at_ns: int) -> bool:
        """Whether the own velocity came before, and was found wrong or has stopped."""
        has_stopped = self.right_ns is not None and at_ns - self.right_ns > STOPPED_NS
        return has_stopped or self.velocity_wrong_ns is not None

    @property
    def contradicts(self) -> bool:
        """Whether both changes contradict each other, or one of them was found wrong."""
        return self.has_found_wrong or self.disagrees_ns is not None

    def repeats(self, at_ns: int) -> bool:
        """Whether the own velocity has repeated to the last bit for longer than any message takes."""
        return self.repeated is not None and at_ns - self.repeated[2] > REPEATS_NS

    def agrees(self, at_ns: int) -> bool:
        """Whether inertial data, or setpoints without right ones, have changed as the own velocity has, just now."""
        return self.velocity_wrong_ns is None and self.agreed_ns is not None and at_ns - self.agreed_ns <= RECENT_NS

    def supports_velocity(self, at_ns: int) -> bool:
        """Whether they have so, and changed at all."""
        return self.agrees(at_ns) and self.supported_ns is not None and at_ns - self.supported_ns <= RECENT_NS

    def confirms_velocity(self, at_ns: int) -> bool:
        """Whether inertial data have changed as the own velocity has within the last second, and by much."""
        return not self.contradicts and self.confirmed_ns is not None and at_ns - self.confirmed_ns <= WINDOW_NS


def update(state: VelocityChangeState, observation: TickObservation, velocity: VelocityState) -> VelocityChangeState:
    """Take a tick, after its positions."""
    tick, motion, parameters = observation.tick, observation.motion, observation.parameters
    state = _believe_again(state, tick.at_ns, velocity, parameters)
    own = read_vehicle_velocity(tick.motion, tick.at_ns)
    own_ns = None if tick.motion is None else tick.motion.velocity_ns
    repeated = state.repeated if state.repeats(tick.at_ns) else None
    if repeated is not None and own_ns is not None and own == repeated[0]:
        # A velocity that repeats is as good as none.
        state = _judge_alone(state, (own, motion.model_mps, own_ns), tick.at_ns, parameters)
        own = None
    is_corrected = motion.resumed_ns is not None and tick.at_ns < motion.resumed_ns + CORRECTS_NS
    unexplained = (0.0, 0.0, 0.0) if motion.observer is None else tuple(motion.observer.mean[2].tolist())
    if is_corrected and state.disagrees_ns is not None and state.samples:
        # What was found before positions came back counts: both changes are not compared while they correct one.
        last_ns = state.disagrees_ns + PERSISTS_NS
        state = _compare(state, state.samples[0], state.samples[-1], unexplained, last_ns, parameters)
    if state.velocity_wrong_ns is None:
        state = _remember_right(state, is_silent=own is None)
    gained: Vector | None = None
    if motion.inertial_path and tick.inertial_mps2 is not None:
        gained = tuple(motion.inertial_path[-1].integrate(tick.at_ns if own is None or own_ns is None else own_ns)[0])
    if own is None or own_ns is None or is_corrected:
        state = replace(state, samples=(), disagrees_ns=None, repeated=repeated if own is None else None)
        if own is not None or gained is None or is_corrected:
            return state
        return _judge_lone_inertial(state, (tick.at_ns, gained, motion.model_mps), unexplained, parameters)
    state = _judge_alone(state, (own, motion.model_mps, own_ns), tick.at_ns, parameters)
    if state.samples and (state.samples[-1][2] is None) != (gained is None):
        state = replace(state, samples=(), disagrees_ns=None)
    if state.samples and state.samples[-1][0] >= own_ns:
        return state
    kept = state.samples[bisect_left(state.samples, own_ns - WINDOW_NS, key=_TIME) :]
    sample = (own_ns, own, gained, motion.model_mps)
    state = replace(state, samples=(*kept, sample))
    return _compare(state, kept[0] if kept else sample, sample, unexplained, tick.at_ns, parameters)


def _compare(
    state: VelocityChangeState,
    first: Sample,
    last: Sample,
    unexplained_mps2: Vector,
    at_ns: int,
    parameters: EnvelopeParameters,
) -> VelocityChangeState:
    """Compare both changes since the first sample of the window; where they differ, find the wrong one.

    Args:
        unexplained_mps2: Acceleration that positions showed last beside the setpoints: wind and drag.
    """
    s = (last[0] - first[0]) * 1e-9
    own, model = _subtract(last[1], first[1]), _subtract(last[3], first[3])
    pushed = tuple(change + accel * s for change, accel in zip(model, unexplained_mps2, strict=True))
    # e_v = min(|Δv - Δm|, |Δv - Δm - d t|): positions that were wrong have given a wrong d
    own_mps = min(math.dist(own, model), math.dist(own, pushed))
    # e > v_max + gusts(t), or twice that
    gusts_mps = parameters.disagreement_mps + bound_gusts_mps(s, parameters)
    explained_mps = 2.0 * gusts_mps
    is_right = own_mps <= gusts_mps and state.velocity_wrong_ns is None
    supported = replace(state, disagrees_ns=None)
    if is_right and s >= LEAST_S:
        supported = _note_agreement(supported, model, at_ns, parameters)
    if first[2] is None or last[2] is None:
        return supported
    gained = _subtract(last[2], first[2])
    gained_mps = min(math.dist(gained, model), math.dist(gained, pushed))
    # |Δv - Δi| ≤ v_max + 0.3 m/s² t; inertial data that are right by the setpoints do not drift
    drift_mps = INERTIAL_DRIFT_MPS2 * s if own_mps < NEARER * gained_mps else 0.0
    if not state.has_found_wrong and math.dist(own, gained) <= parameters.disagreement_mps + drift_mps:
        is_plain = math.hypot(*gained) > 2.0 * parameters.disagreement_mps
        agreed = replace(
            state, confirmed_ns=at_ns if s >= LEAST_S and is_plain else state.confirmed_ns, disagrees_ns=None
        )
        return _note_agreement(agreed, gained, at_ns, parameters) if s >= LEAST_S else agreed
    right_mps = _subtract(first[1], first[3])
    if state.inertial_wrong_ns is not None:
        if is_right:
            return supported
        if state.velocity_wrong_ns is not None:
            return state
        return replace(state, velocity_wrong_ns=at_ns, right_beside_model_mps=right_mps, right_ns=first[0])
    disagrees_ns = at_ns if state.disagrees_ns is None else state.disagrees_ns
    if at_ns - disagrees_ns < PERSISTS_NS:
        return replace(state, disagrees_ns=disagrees_ns)
    if state.velocity_wrong_ns is not None:
        return replace(state, inertial_wrong_ns=at_ns if gained_mps > explained_mps else None)
    are_both_wrong = min(own_mps, gained_mps) > explained_mps
    is_velocity_wrong = are_both_wrong or own_mps >= gained_mps
    return replace(
        state,
        disagrees_ns=disagrees_ns,
        velocity_wrong_ns=at_ns if is_velocity_wrong else None,
        inertial_wrong_ns=at_ns if are_both_wrong or own_mps < gained_mps else None,
        right_beside_model_mps=right_mps if is_velocity_wrong else None,
        right_ns=first[0] if is_velocity_wrong else None,
    )


def _note_agreement(
    state: VelocityChangeState, change: Vector, at_ns: int, parameters: EnvelopeParameters
) -> VelocityChangeState:
    """Note that both changes agree, and whether on one (3,) [m/s] that shows something."""
    is_shown = math.hypot(*change) > parameters.disagreement_mps
    return replace(state, agreed_ns=at_ns, supported_ns=at_ns if is_shown else state.supported_ns)


def _judge_alone(
    state: VelocityChangeState, shown: tuple[Vector, Vector, int], at_ns: int, parameters: EnvelopeParameters
) -> VelocityChangeState:
    """Find an own velocity that repeats to the last bit while that by the setpoints changes, or that leaps.

    Args:
        shown: The own velocity, the model's, and its time [ns].
    """
    if state.repeated is None:
        return replace(state, repeated=shown)
    (own, model, own_ns), (before, model_before, before_ns) = shown, state.repeated
    # It repeats: |Δm| > v_max; it leaps: |Δv - Δm| > v_max + max(6 m/s² Δt, 2 |Δm|), or v_max + 3 m/s² Δt
    if own == before:
        # A message does not repeat itself: PX4 sends ten a second on some links, and brakes by 0.3 m/s in between.
        is_wrong = own_ns > before_ns and math.dist(model, model_before) > parameters.disagreement_mps
    else:
        off_mps = math.dist(_subtract(own, before), _subtract(model, model_before))
        s = (own_ns - before_ns) * 1e-9
        # A response that is turned makes up to 2 |Δm|.
        turned_mps = max(LEAP_MPS2 * s, 2.0 * math.dist(model, model_before))
        leap_mps = turned_mps if state.inertial_wrong_ns is None else LONE_LEAP_MPS2 * s
        is_wrong = off_mps > parameters.disagreement_mps + leap_mps
        state = replace(state, repeated=shown)
    if not is_wrong or state.velocity_wrong_ns is not None:
        return state
    right_mps = _subtract(before, model_before)
    return replace(state, velocity_wrong_ns=at_ns, right_beside_model_mps=right_mps, right_ns=before_ns)


def _judge_lone_inertial(
    state: VelocityChangeState,
    sample: tuple[int, Vector, Vector],
    unexplained_mps2: Vector,
    parameters: EnvelopeParameters,
) -> VelocityChangeState:
    """Find inertial data wrong that change otherwise than setpoints and gusts explain, where no own velocity comes."""
    lone = (*(one for one in state.lone if sample[0] - one[0] <= WINDOW_NS), sample)
    state = replace(state, lone=lone)
    (first_ns, first_gained, first_model), (at_ns, gained, model) = lone[0], sample
    s = (at_ns - first_ns) * 1e-9
    model_change, change = _subtract(model, first_model), _subtract(gained, first_gained)
    pushed = [m + accel * s for m, accel in zip(model_change, unexplained_mps2, strict=True)]
    # |Δi - Δm| > 1.2 (v_max + gusts(t))
    gusts_mps = LONE_GUSTS * (parameters.disagreement_mps + bound_gusts_mps(s, parameters))
    if state.right_ns is None or min(math.dist(change, model_change), math.dist(change, pushed)) <= gusts_mps:
        return state
    return replace(state, inertial_wrong_ns=at_ns, lone=())


def _remember_right(state: VelocityChangeState, *, is_silent: bool) -> VelocityChangeState:
    """Remember the last own velocity once it is silent, and forget it once it comes again."""
    if is_silent and state.samples:
        at_ns, own, _, model = state.samples[-1]
        return replace(state, right_beside_model_mps=_subtract(own, model), right_ns=at_ns)
    return state if is_silent else replace(state, lone=(), right_beside_model_mps=None, right_ns=None)


def _believe_again(
    state: VelocityChangeState, at_ns: int, velocity: VelocityState, parameters: EnvelopeParameters
) -> VelocityChangeState:
    """Believe inertial data again after a time, and an own velocity that changes once positions have agreed with it."""
    velocity_ns, inertial_ns = state.velocity_wrong_ns, state.inertial_wrong_ns
    if inertial_ns is not None and at_ns - inertial_ns > INERTIAL_DISTRUST_NS:
        state = replace(state, inertial_wrong_ns=None, samples=())
    if velocity_ns is None or velocity.apart_mps is None:
        return state
    if not velocity.offsets or velocity.offsets[0][0] <= velocity_ns:
        return state
    if velocity.apart_mps <= parameters.disagreement_mps and not state.repeats(at_ns):
        state = replace(state, velocity_wrong_ns=None, samples=(), right_beside_model_mps=None, right_ns=None)
    return state


def _subtract(a: Sequence[float], b: Sequence[float]) -> Vector:
    return tuple([x - y for x, y in zip(a, b, strict=True)])

"""Take-offs by relayed positions over a bursty link, with checks that flicker and failsafes, judged on the truth."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import Client
from take_off_rig import RELAYED, TakeOffRig

from uavctl.mavlink.handover_states import HandoverState

AUTOPILOTS = ("px4", "ardupilot")
LIMIT_S = 60.0  # in which a vehicle is flown, or on the ground again with a reason told
SETTLED_S = 5.0  # engaged for so long, past all that was to come
LANDING_S = 90.0  # more for one that lands at the limit
HEIGHT_M = 1.2
PLACE = (473977420, 85455940, 488000)  # latitude and longitude [1e-7 deg], altitude [mm]
LOW_M = 0.3  # a vehicle that is engaged is higher
# Where a vehicle in the air is somebody's: ours, the pilot's, or on its way down by what was asked for.
ATTENDED = frozenset(HandoverState) - {
    HandoverState.WAITING,
    HandoverState.READY,
    HandoverState.MODE,
    HandoverState.DONE,
    HandoverState.FAILED,
}


@dataclass(frozen=True)
class TakeOff:
    """One take-off, as the truth has it.

    Attributes:
        autopilot: Whose behaviour the simulated vehicle shows.
        seed: Of the flight.
        what: What had become of the true vehicle: engaged, refused, landed; or what must not be.
        reached: Whether it had been engaged at any time.
        seconds: When that was so.
        told: Texts on the console.
        sentence: How it ended.
        wrong: What it did and should not have.
    """

    autopilot: str
    seed: int
    what: str
    reached: bool
    seconds: float
    told: tuple[str, ...]  # key of the report in JSON
    sentence: str
    wrong: tuple[str, ...]


def make_troubled_rig(autopilot: str, seed: int) -> TakeOffRig:
    """A take-off with checks that flicker, and a position that is not valid for a while after arming.

    PX4 says all that it says unasked, and climbs to the height of the order by itself, as the guide has it set. With
    an even seed it has no place on the globe, so it hovers in AUTO.TAKEOFF there; with an odd one, in AUTO.LOITER.
    """
    rng = random.Random(seed)
    begin_s, length_s = (
        rng.uniform(0.0, rng.choice([1.5, 6.0])),
        rng.choice([0.3, 1.2, 2.5, 8.0]) * rng.uniform(0.7, 1.3),
    )
    flight = TakeOffRig(
        autopilot,
        *RELAYED,
        "sim.streams=onboard",
        f"sim.seed={seed}",
        f"sim.checks.flicker_s={rng.choice([0.0, 0.7, 2.0])}",
        f"sim.checks.invalid=[[{begin_s:.2f}, {begin_s + length_s:.2f}]]",
        f"sim.checks.clears={'true' if autopilot == 'px4' else 'false'}",
    ).relayed()
    if autopilot == "px4":
        flight.peers.autopilot.parameters.set("MIS_TAKEOFF_ALT", HEIGHT_M)
        if seed % 2:
            flight.peers.receive("vehicle", Client().pack(mavlink.MAVLink_set_gps_global_origin_message(1, *PLACE)), 0)
    return flight


def judge_outcome(flight: TakeOffRig) -> str:
    """What has become of the true vehicle; `hovers` is what must not be."""
    up_m, pilot = -flight.peers.vehicle.position_m[2], flight.peers.autopilot.pilot
    if not pilot.is_armed and flight.peers.autopilot.vehicle.landed:
        return "landed" if "climbing" in flight.states else "refused"
    obeys = pilot.is_external and pilot.dispatch.active_setpoint is not None  # whatever the hand-over takes it for
    return "engaged" if flight.is_in(HandoverState.ENGAGED) and obeys and up_m > LOW_M else "hovers"


def judge_at_limit(flight: TakeOffRig) -> str:
    """The outcome by the limit; a flight that has ended is over."""
    flight.take_off(HEIGHT_M)
    to_come_s = max((end_s for _, end_s in flight.config.sim.checks.invalid), default=0.0)  # from arming on
    armed_s = engaged_s = 0.0
    for _ in range(round(LIMIT_S)):
        if flight.loop.finished or (engaged_s > SETTLED_S and armed_s > to_come_s + SETTLED_S):
            break
        flight.run(1.0)
        armed_s += flight.peers.autopilot.pilot.is_armed
        engaged_s = engaged_s + 1.0 if flight.is_in(HandoverState.ENGAGED) else 0.0
    return judge_outcome(flight)


def fly_take_off(autopilot: str, seed: int) -> TakeOff:
    """Fly one and judge it; what is still on its way down at the limit is looked at until it is there."""
    flight = make_troubled_rig(autopilot, seed)
    what = judge_at_limit(flight)
    seconds, wrong = flight.now_ns * 1e-9, []
    texts = tuple(event.text for event in flight.notices)
    if what == "hovers":
        while not flight.loop.finished and flight.now_ns * 1e-9 < seconds + LANDING_S and what == "hovers":
            flight.run(1.0)
            what = judge_outcome(flight)
        wrong.append(f"it was in the air and not flown at {seconds:.0f} s; then: {what}")
    if what == "hovers":
        wrong.append(f"nobody has it in the air ({flight.state})")
    if what != "engaged" and not (texts and flight.loop.account.end_sentence):
        wrong.append("nobody was told why")
    if flight.state not in ATTENDED and flight.peers.autopilot.pilot.is_armed:
        wrong.append(f"it was left armed ({flight.state})")
    reached = flight.loop.account.was_engaged
    return TakeOff(autopilot, seed, what, reached, round(seconds, 1), texts, flight.loop.ending.sentence, tuple(wrong))


def tally_take_offs(flights: Sequence[TakeOff]) -> dict[str, object]:
    """The figures of one autopilot's take-offs."""
    result = Counter(flight.what for flight in flights)
    latest_flight = max(flights, key=lambda flight: flight.seconds)
    over = [flight.sentence for flight in flights if flight.what != "engaged"]
    causes = Counter(sentence.partition(":")[0].partition(";")[0] for sentence in over)
    return {
        "take_offs": len(flights),
        "engaged": sum(flight.reached for flight in flights),
        "landed_again": sum(flight.reached and flight.what == "landed" for flight in flights),
        "landed": sum(not flight.reached and flight.what == "landed" for flight in flights),
        "refused": result["refused"],
        "hovers": result["hovers"],
        "latest_s": latest_flight.seconds,
        "latest_seed": latest_flight.seed,
        "ended": dict(causes.most_common()),
        "wrong": {str(flight.seed): [*flight.wrong, flight.sentence] for flight in flights if flight.wrong},
    }

"""Causes of how a flight went and ended: the one table from a cause to its words.

Console, health line, page, JSON and exit code take their words from here. The code of a cause is for programs.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

GOOD, CAUTION, BAD = "good", "mind", "bad"  # colours of a headline


class Cause(StrEnum):
    """Cause of how a flight went, or ended; the value is its code in recordings and in `--json`."""

    BATTERY_EMPTY = "battery-empty"
    LEFT_LIMITS = "left-limits"
    VEHICLE_SILENT = "vehicle-silent"
    VEHICLE_RESTARTED = "vehicle-restarted"
    VEHICLE_DISARMED = "vehicle-disarmed"
    CONTROL_FAILED = "control-failed"
    RECORDING_CUT = "recording-cut"
    FLOWN_BLIND = "flown-blind"
    STOOD_STILL = "stood-still"
    VEHICLE_FENCE = "vehicle-fence"
    BATTERY_LOW = "battery-low"
    VEHICLE_POSITION_LOST = "vehicle-position-lost"
    VEHICLE_FAILSAFE = "vehicle-failsafe"
    VEHICLE_ALARM = "vehicle-alarm"
    PILOT = "pilot"
    GROUND_STATION = "ground-station"
    MODE_LEFT = "mode-left"
    POSITIONS_FROZEN = "positions-frozen"
    POSITIONS_JUMPED = "positions-jumped"
    POSITIONS_DRIFTED = "positions-drifted"
    POSITIONS_INVALID = "positions-invalid"
    POSITIONS_ABSENT = "positions-absent"
    POSITIONS_APART = "positions-apart"
    STAMPS_UNUSABLE = "stamps-unusable"
    RELAY_ATTITUDE = "relay-attitude"
    RELAY_SILENT = "relay-silent"
    SILENCE = "silence"
    SETPOINTS_SILENT = "setpoints-silent"
    ENVELOPE = "let-go"
    NOT_AS_ORDERED = "not-as-ordered"
    BEGIN_REFUSED = "begin-refused"
    NOT_RISEN = "not-risen"
    NOT_FLOWN = "not-flown"
    TAKE_OFF_NOT_BEGUN = "take-off-not-begun"
    MODE_REFUSED = "mode-refused"
    ARMING_REFUSED = "arming-refused"
    TAKE_OFF_REFUSED = "take-off-refused"
    CLIMB_TOO_LONG = "climb-too-long"
    CLIMB_ABORTED = "climb-aborted"
    SETPOINTS_REFUSED = "setpoints-refused"
    NOT_ENGAGED = "not-engaged"
    LEFT_IN_FLIGHT = "left-in-flight"
    FALLBACK_LANDED = "fallback-landed"
    FALLBACK_STOPPED = "fallback-stopped"
    FAILSAFE_LANDED = "failsafe-landed"
    FENCE_LANDED = "fence-landed"
    LANDING_FAILED = "landing-failed"
    ENDED_IN_AIR = "ended-in-air"
    CONNECTION_CLOSED = "connection-closed"
    SIGNALLED = "signalled"
    WAITING = "waiting"  # in a recording that does not say for what
    TOUCHED_LIMIT = "touched-limit"
    BEYOND_LIMIT = "beyond-limit"
    FELL_BACK = "fell-back"
    NOT_REACHED = "not-reached"
    OFF_TRACK = "off-track"
    WIND = "wind"
    COMPUTER_SLOW = "computer-slow"
    VEHICLE_WARNED = "vehicle-warned"
    SECOND_VEHICLE = "second-vehicle"
    PLANS_RELAXED = "plans-relaxed"
    LINK_WORSE = "link-worse"
    NO_VEHICLE = "no-vehicle"
    NOT_ARMED = "not-armed"
    ARMING_UNKNOWN = "arming-unknown"
    ALL_WELL = "all-well"
    NOTHING_FOUND = "nothing-found"  # as far as the recording tells, which is not all
    LANDED_AFTER_MISSION = "landed-after-mission"
    LANDED_AS_ORDERED = "landed-as-ordered"
    ENDED_BY_OPERATOR = "ended-by-operator"
    TIME_OVER = "time-over"
    IN_FLIGHT = "in-flight"  # a simulated flight that was to end in the air, or a recording that says no more
    PILOT_LANDED = "pilot-landed"


class CauseRank(StrEnum):
    """Ranks of causes in the order that a pilot needs; within a rank the earliest cause counts."""

    POWER = "power"  # it explains all that comes after
    LOST = "lost"  # the vehicle, or the room
    BLIND = "blind"  # and what ended without us
    FAILSAFE = "failsafe"  # the vehicle's own
    TAKEN_OVER = "taken over"
    POSITIONS = "positions"
    ENDING = "ending"  # an end that was not ordered, where nothing above explains it
    QUALITY = "quality"  # of the flight
    DETAIL = "detail"
    NONE = "none"


@dataclass(frozen=True)
class CauseText:
    """Words of a cause."""

    rank: CauseRank
    tone: str  # colour of a headline
    title: str  # begin of a headline
    phrase: str = ""  # of a flight's end, for a table or a sentence; empty for causes that end no flight


def _describe_bad_end(phrase: str) -> CauseText:
    return CauseText(CauseRank.ENDING, BAD, "Not as ordered", phrase)


def _describe_wanted_end(phrase: str) -> CauseText:
    return CauseText(CauseRank.NONE, GOOD, "As ordered", phrase)


_C, _R = Cause, CauseRank
CAUSES: dict[Cause, CauseText] = {
    _C.BATTERY_EMPTY: CauseText(_R.POWER, BAD, "Battery empty"),
    _C.LEFT_LIMITS: CauseText(_R.LOST, BAD, "Left its limits"),
    _C.VEHICLE_SILENT: CauseText(_R.LOST, BAD, "Vehicle lost", "the vehicle stopped sending"),
    _C.VEHICLE_RESTARTED: CauseText(_R.LOST, BAD, "Vehicle restarted", "the vehicle restarted"),
    _C.VEHICLE_DISARMED: CauseText(_R.LOST, BAD, "Disarmed in flight", "the vehicle disarmed in flight"),
    _C.CONTROL_FAILED: CauseText(_R.LOST, BAD, "Controller failed", "the controller has failed"),
    _C.RECORDING_CUT: CauseText(_R.BLIND, BAD, "Recording cut"),
    _C.FLOWN_BLIND: CauseText(_R.BLIND, BAD, "Flown without positions"),
    _C.STOOD_STILL: CauseText(_R.BLIND, BAD, "Control loop stopped"),
    _C.VEHICLE_FENCE: CauseText(_R.FAILSAFE, BAD, "The vehicle's own fence", "the vehicle's own fence took over"),
    _C.BATTERY_LOW: CauseText(_R.FAILSAFE, BAD, "Battery low"),
    _C.VEHICLE_POSITION_LOST: CauseText(_R.FAILSAFE, BAD, "The vehicle lost its position"),
    _C.VEHICLE_FAILSAFE: CauseText(_R.FAILSAFE, BAD, "Failsafe of the vehicle", "the vehicle's own failsafe took over"),
    _C.VEHICLE_ALARM: CauseText(_R.FAILSAFE, BAD, "Alarm of the vehicle"),
    _C.PILOT: CauseText(_R.TAKEN_OVER, CAUTION, "The pilot took over", "the pilot has taken over"),
    _C.GROUND_STATION: CauseText(
        _R.TAKEN_OVER, CAUTION, "A ground station took over", "a ground station has taken over"
    ),
    _C.MODE_LEFT: CauseText(_R.TAKEN_OVER, CAUTION, "Mode changed", "the mode changed for an unknown reason"),
    _C.POSITIONS_FROZEN: CauseText(_R.POSITIONS, BAD, "Positions frozen"),
    _C.POSITIONS_JUMPED: CauseText(_R.POSITIONS, BAD, "Positions jumped"),
    _C.POSITIONS_DRIFTED: CauseText(_R.POSITIONS, BAD, "Positions drifted"),
    _C.POSITIONS_INVALID: CauseText(_R.POSITIONS, BAD, "Positions unusable"),
    _C.POSITIONS_ABSENT: CauseText(_R.POSITIONS, BAD, "No positions", "no positions arrived"),
    _C.POSITIONS_APART: CauseText(_R.POSITIONS, CAUTION, "Positions disagree"),
    _C.STAMPS_UNUSABLE: CauseText(_R.POSITIONS, BAD, "Time stamps unusable"),
    _C.RELAY_ATTITUDE: CauseText(_R.POSITIONS, BAD, "Attitude of poses wrong"),
    _C.RELAY_SILENT: CauseText(_R.POSITIONS, BAD, "Relay silent"),
    _C.SILENCE: CauseText(_R.POSITIONS, CAUTION, "No positions for a while"),
    _C.SETPOINTS_SILENT: CauseText(_R.POSITIONS, CAUTION, "No setpoints for a while"),
    _C.ENVELOPE: CauseText(_R.ENDING, BAD, "Let go", "let go by a monitor"),
    _C.NOT_AS_ORDERED: CauseText(_R.ENDING, BAD, "Not as ordered"),
    _C.BEGIN_REFUSED: CauseText(_R.ENDING, BAD, "Refused by the vehicle"),
    _C.NOT_RISEN: CauseText(
        _R.ENDING, BAD, "Did not leave the ground", "the vehicle disarmed before it left the ground"
    ),
    _C.NOT_FLOWN: CauseText(_R.ENDING, CAUTION, "No controlled flight", "the controller flew nothing"),
    _C.TAKE_OFF_NOT_BEGUN: _describe_bad_end("the take-off was not begun"),
    _C.MODE_REFUSED: _describe_bad_end("the mode to take off in was refused"),
    _C.ARMING_REFUSED: _describe_bad_end("arming was refused"),
    _C.TAKE_OFF_REFUSED: _describe_bad_end("the take-off was refused"),
    _C.CLIMB_TOO_LONG: _describe_bad_end("the climb took too long"),
    _C.CLIMB_ABORTED: _describe_bad_end("the climb was aborted"),
    _C.SETPOINTS_REFUSED: _describe_bad_end("the mode that takes setpoints was refused"),
    _C.NOT_ENGAGED: _describe_bad_end("ended before the controller was in charge"),
    _C.LEFT_IN_FLIGHT: _describe_bad_end("left alone: an earlier daemon had left the vehicle in flight"),
    _C.FALLBACK_LANDED: _describe_bad_end("landed by the fallback"),
    _C.FALLBACK_STOPPED: _describe_bad_end("let go by the fallback"),
    _C.FAILSAFE_LANDED: _describe_bad_end("landed by the vehicle's own failsafe"),
    _C.FENCE_LANDED: _describe_bad_end("landed by the vehicle's own fence"),
    _C.LANDING_FAILED: _describe_bad_end("landing has failed"),
    _C.ENDED_IN_AIR: _describe_bad_end("ended before the vehicle had landed"),
    _C.CONNECTION_CLOSED: _describe_bad_end("the other side closed the vehicle's connection"),
    _C.SIGNALLED: _describe_bad_end("ended at once by a second signal"),
    _C.WAITING: _describe_bad_end("waiting"),
    _C.TOUCHED_LIMIT: CauseText(_R.QUALITY, CAUTION, "Touched a limit"),
    _C.BEYOND_LIMIT: CauseText(_R.QUALITY, CAUTION, "Beyond a limit"),
    _C.FELL_BACK: CauseText(_R.QUALITY, CAUTION, "Fallback used"),
    _C.NOT_REACHED: CauseText(_R.QUALITY, CAUTION, "Place not reached", "the place was not reached"),
    _C.OFF_TRACK: CauseText(_R.QUALITY, CAUTION, "Far from the target"),
    _C.WIND: CauseText(_R.QUALITY, CAUTION, "Strong push"),
    _C.COMPUTER_SLOW: CauseText(_R.QUALITY, CAUTION, "Computer too slow"),
    _C.VEHICLE_WARNED: CauseText(_R.QUALITY, CAUTION, "The vehicle warned"),
    _C.SECOND_VEHICLE: CauseText(_R.QUALITY, CAUTION, "Second vehicle", "another vehicle was heard"),
    _C.PLANS_RELAXED: CauseText(_R.DETAIL, CAUTION, "Plans relaxed"),
    _C.LINK_WORSE: CauseText(_R.DETAIL, CAUTION, "Link worse than designed"),
    _C.NO_VEHICLE: CauseText(_R.DETAIL, CAUTION, "No vehicle", "no vehicle was heard"),
    _C.NOT_ARMED: CauseText(_R.DETAIL, CAUTION, "Not armed"),
    _C.ARMING_UNKNOWN: CauseText(_R.DETAIL, CAUTION, "Arming unknown"),
    _C.ALL_WELL: CauseText(_R.NONE, GOOD, "All well"),
    _C.NOTHING_FOUND: CauseText(_R.NONE, GOOD, "Nothing found"),
    _C.LANDED_AFTER_MISSION: _describe_wanted_end("landed at the end of the mission"),
    _C.LANDED_AS_ORDERED: _describe_wanted_end("landed as ordered"),
    _C.ENDED_BY_OPERATOR: _describe_wanted_end("ended by the operator"),
    _C.TIME_OVER: _describe_wanted_end("ended after its duration"),
    _C.IN_FLIGHT: _describe_wanted_end("still flying"),
    _C.PILOT_LANDED: _describe_wanted_end("landed by the pilot"),
}

# Ends by which a person has the vehicle.
TAKEN = frozenset({_C.PILOT, _C.PILOT_LANDED, _C.GROUND_STATION})
# Ends that somebody wanted: the operator, the mission, or a person who has taken over.
WANTED = TAKEN | {cause for cause, text in CAUSES.items() if text.rank is _R.NONE and text.phrase}


def find_ending_code(phrase: str) -> str:
    """Return the code of the end that has this phrase; empty if none has."""
    return next((cause.value for cause, text in CAUSES.items() if text.phrase and text.phrase == phrase), "")

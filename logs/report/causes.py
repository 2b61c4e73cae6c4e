"""Causes that a headline names, the gravest first, and the line that they make: one table for every recording."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from logs.recording.design_view import Floats

GOOD, MIND, BAD = "good", "mind", "bad"  # of a headline: its colour


class HeadlineCause(StrEnum):
    """Cause that a headline names; the value is its code in `--json`."""

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
    RELAY_SILENT = "relay-silent"
    SILENCE = "silence"
    LET_GO = "let-go"
    NOT_AS_ORDERED = "not-as-ordered"
    BEGIN_REFUSED = "begin-refused"
    NOT_RISEN = "not-risen"
    NOT_FLOWN = "not-flown"
    TOUCHED_LIMIT = "touched-limit"
    BEYOND_LIMIT = "beyond-limit"
    FELL_BACK = "fell-back"
    NOT_REACHED = "not-reached"
    OFF_TRACK = "off-track"
    WIND = "wind"
    PLANS_RELAXED = "plans-relaxed"
    LINK_WORSE = "link-worse"
    VEHICLE_WARNED = "vehicle-warned"
    SECOND_VEHICLE = "second-vehicle"
    NO_VEHICLE = "no-vehicle"
    NOT_ARMED = "not-armed"
    ARMING_UNKNOWN = "arming-unknown"
    ALL_WELL = "all-well"
    NOTHING_FOUND = "nothing-found"  # as far as the recording tells, which is not all


class CauseRank(StrEnum):
    """Ranks of causes by what a pilot needs first, in this order; within a rank the earliest cause counts."""

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


_C, _R = HeadlineCause, CauseRank
# cause -> rank, colour, and what it comes to in a few words
_TABLE: dict[HeadlineCause, tuple[CauseRank, str, str]] = {
    _C.BATTERY_EMPTY: (_R.POWER, BAD, "Battery empty"),
    _C.LEFT_LIMITS: (_R.LOST, BAD, "Left its limits"),
    _C.VEHICLE_SILENT: (_R.LOST, BAD, "Vehicle lost"),
    _C.VEHICLE_RESTARTED: (_R.LOST, BAD, "Vehicle restarted"),
    _C.VEHICLE_DISARMED: (_R.LOST, BAD, "Disarmed in flight"),
    _C.CONTROL_FAILED: (_R.LOST, BAD, "Controller failed"),
    _C.RECORDING_CUT: (_R.BLIND, BAD, "Recording breaks off"),
    _C.FLOWN_BLIND: (_R.BLIND, BAD, "Flown blind"),
    _C.STOOD_STILL: (_R.BLIND, BAD, "Controller stood still"),
    _C.VEHICLE_FENCE: (_R.FAILSAFE, BAD, "The vehicle's own fence"),
    _C.BATTERY_LOW: (_R.FAILSAFE, BAD, "Battery low"),
    _C.VEHICLE_POSITION_LOST: (_R.FAILSAFE, BAD, "The vehicle lost its position"),
    _C.VEHICLE_FAILSAFE: (_R.FAILSAFE, BAD, "Failsafe of the vehicle"),
    _C.VEHICLE_ALARM: (_R.FAILSAFE, BAD, "The vehicle alarmed"),
    _C.PILOT: (_R.TAKEN_OVER, MIND, "The pilot took over"),
    _C.GROUND_STATION: (_R.TAKEN_OVER, MIND, "A ground station took over"),
    _C.MODE_LEFT: (_R.TAKEN_OVER, MIND, "Mode changed"),
    _C.POSITIONS_FROZEN: (_R.POSITIONS, BAD, "Positions frozen"),
    _C.POSITIONS_JUMPED: (_R.POSITIONS, BAD, "Positions jumped"),
    _C.POSITIONS_DRIFTED: (_R.POSITIONS, BAD, "Positions drifted"),
    _C.POSITIONS_INVALID: (_R.POSITIONS, BAD, "Positions unusable"),
    _C.POSITIONS_ABSENT: (_R.POSITIONS, BAD, "No positions"),
    _C.POSITIONS_APART: (_R.POSITIONS, MIND, "Positions disagree"),
    _C.STAMPS_UNUSABLE: (_R.POSITIONS, BAD, "Time stamps unusable"),
    _C.RELAY_SILENT: (_R.POSITIONS, BAD, "Relay silent"),
    _C.SILENCE: (_R.POSITIONS, MIND, "No positions for a while"),
    _C.LET_GO: (_R.ENDING, BAD, "Let go"),
    _C.NOT_AS_ORDERED: (_R.ENDING, BAD, "Not as ordered"),
    _C.BEGIN_REFUSED: (_R.ENDING, BAD, "Refused by the vehicle"),
    _C.NOT_RISEN: (_R.ENDING, BAD, "Never left the ground"),
    _C.NOT_FLOWN: (_R.ENDING, MIND, "Nothing was flown"),
    _C.TOUCHED_LIMIT: (_R.QUALITY, MIND, "Touched a limit"),
    _C.BEYOND_LIMIT: (_R.QUALITY, MIND, "Beyond a limit"),
    _C.FELL_BACK: (_R.QUALITY, MIND, "Fell back"),
    _C.NOT_REACHED: (_R.QUALITY, MIND, "Not there yet"),
    _C.OFF_TRACK: (_R.QUALITY, MIND, "Off its track"),
    _C.WIND: (_R.QUALITY, MIND, "Pushed off"),
    _C.PLANS_RELAXED: (_R.DETAIL, MIND, "Plans relaxed"),
    _C.LINK_WORSE: (_R.DETAIL, MIND, "Link worse than designed"),
    _C.VEHICLE_WARNED: (_R.QUALITY, MIND, "The vehicle warned"),
    _C.SECOND_VEHICLE: (_R.QUALITY, MIND, "Another vehicle"),
    _C.NO_VEHICLE: (_R.DETAIL, MIND, "No vehicle"),
    _C.NOT_ARMED: (_R.DETAIL, MIND, "Not armed"),
    _C.ARMING_UNKNOWN: (_R.DETAIL, MIND, "Arming not known"),
    _C.ALL_WELL: (_R.NONE, GOOD, "All well"),
    _C.NOTHING_FOUND: (_R.NONE, GOOD, "Nothing found"),
}
_RANKS = tuple(CauseRank)
# Of what went wrong with the vehicle, what may have brought it about; the likeliest comes first.
_ROOTS = (
    _C.BATTERY_EMPTY,
    _C.BATTERY_LOW,
    _C.STOOD_STILL,
    _C.RELAY_SILENT,
    _C.POSITIONS_FROZEN,
    _C.POSITIONS_JUMPED,
    _C.POSITIONS_DRIFTED,
    _C.STAMPS_UNUSABLE,
    _C.POSITIONS_INVALID,
    _C.POSITIONS_ABSENT,
    _C.FLOWN_BLIND,
    _C.SILENCE,
    _C.POSITIONS_APART,
    _C.WIND,
)
_EFFECTS = frozenset({_R.LOST, _R.FAILSAFE, _R.TAKEN_OVER, _R.ENDING})


@dataclass(frozen=True)
class Finding:
    """One cause that a recording shows, told from the moment on at which it began."""

    cause: HeadlineCause
    at_s: float
    text: str  # a clause, without the words of the cause and without a full stop
    look_s: float | None = None  # moment to look at first; else its begin
    tone: str = ""  # another colour than the table's

    @property
    def sentence(self) -> str:
        """The finding as a sentence of its own."""
        return f"{_TABLE[self.cause][2]}: {self.text}."


@dataclass(frozen=True)
class Headline:
    """One line on what matters most in a recording, in colour and words, and the sentences below it."""

    tone: str  # GOOD, MIND or BAD
    word: str  # what it comes to, in a few words
    text: str  # the rest of the line
    why: tuple[str, ...]
    at_s: float = 0.0  # moment to look at first
    cause: HeadlineCause = HeadlineCause.NOTHING_FOUND
    causes: tuple[HeadlineCause, ...] = ()  # all that were found, the gravest first

    @property
    def line(self) -> str:
        """The line."""
        return f"{self.word}: {self.text}"

    def document(self) -> dict[str, object]:
        """Return the headline as `--json` has it."""
        return {"tone": self.tone, "cause": self.cause, "causes": self.causes, "text": self.line, "why": self.why}


def ranked(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings with the gravest first: by rank, then by time."""
    return sorted(findings, key=lambda one: (_RANKS.index(_TABLE[one.cause][0]), one.at_s))


def make_headline(findings: Iterable[Finding], outcome: str = "", why: Iterable[str] = ()) -> Headline:
    """Make the headline of findings, at least one: the gravest, what brought it about, and what came of it.

    Args:
        outcome: A clause on how the flight ended and where it stayed.
        why: Further sentences, below those on the other findings.
    """
    main, *others = ranked(findings)
    rank, tone, word = _TABLE[main.cause]
    root = None
    if rank in _EFFECTS:
        before = [
            one for one in others if one.cause in _ROOTS and one.at_s <= (main.look_s or main.at_s) + _MEANWHILE_S
        ]
        root = min(before, key=lambda one: _ROOTS.index(one.cause), default=None)
    told = [
        main.text,
        *((f"{_TABLE[root.cause][2].lower()}: {root.text}",) if root else ()),
        *((outcome,) if outcome else ()),
    ]
    return Headline(
        tone=main.tone or tone,
        word=word,
        text=f"{'; '.join(told)}.",
        why=(*(one.sentence for one in others if one is not root and not _in_outcome(one, outcome)), *why),
        at_s=main.at_s if main.look_s is None else main.look_s,
        cause=main.cause,
        causes=tuple(dict.fromkeys(one.cause for one in (main, *others))),
    )


def _in_outcome(one: Finding, outcome: str) -> bool:
    """Return whether the line itself says how the flight ended."""
    return bool(outcome) and one.cause is _C.NOT_AS_ORDERED


_MEANWHILE_S = 1.0  # a heartbeat: causes are known that much later than what they bring about


def metres(value: float) -> str:
    """Return a length for a person: "1.6 m", "0.12 m", "4 mm"."""
    if value >= 0.995:
        return f"{value:.1f} m"
    return f"{value:.2f} m" if value >= 0.0095 else f"{1e3 * value:.0f} mm" if value >= 5e-4 else "less than 1 mm"


def seconds(value: float) -> str:
    """Return a time or a length of time for a person, to a tenth of a second: "19.8 s"."""
    return f"{value:.1f} s"


# The battery, as any recording tells it.


_EMPTY = 0.5  # of the voltage at the beginning: no battery under load shows that before it is cut off
_CELL_V, _FULL_V = 3.3, 4.35  # of a lithium cell: under load below this it is low; none is charged higher


def battery_findings(at_s: Floats, volts: Floats) -> Iterator[Finding]:
    """Find a battery that fell to nothing, or below what its cells may have under load.

    Args:
        at_s: Times in the air (n,) [s].
        volts: Its voltage then (n,) [V].
    """
    known = np.flatnonzero(volts > 1.0)
    if not len(known):
        return
    at_s, volts = at_s[known[0] :], volts[known[0] :]
    begun_v = float(volts[0])
    cells = int(np.ceil(begun_v / _FULL_V))
    for cause, limit_v in ((_C.BATTERY_EMPTY, _EMPTY * begun_v), (_C.BATTERY_LOW, _CELL_V * cells)):
        low = volts < limit_v
        lasting = np.flatnonzero(low & np.append(low[1:], True))  # one reading is a glitch, unless it is the last
        if len(lasting):
            first_s = float(at_s[lasting[0]])
            text = (
                f"its voltage fell from {begun_v:.1f} V to {float(volts[lasting].min()):.1f} V, at {seconds(first_s)}"
            )
            yield Finding(cause, first_s, text)
            return


# Texts of a vehicle. Autopilots give the same matter different severities: ArduPilot announces a breached fence as a
# notice and a failsafe of the radio as a warning. So these words count at every severity, others from a warning on.


_OVER = re.compile(r"\b(cleared?|enabled?|disabled?|deactivated|recovered|indexed|loaded)\b", re.IGNORECASE)
_BEFORE_ARMING = re.compile(r"^(pre-?arm|arm|arming denied|preflight fail)\b", re.IGNORECASE)
_WORDS = (
    (re.compile(r"\b(geo)?fence\b", re.IGNORECASE), HeadlineCause.VEHICLE_FENCE),
    (re.compile(r"\bbattery\b.*\b(fail-?safe|low|critical|empty)|\b(low|critical|dangerous\w*|empty)\b.*\bbattery",
                re.IGNORECASE), HeadlineCause.BATTERY_LOW),
    (re.compile(r"\bekf\d*\b.*\b(fail-?safe|variance)|stopped aiding|vis(ual)? ?odom.*not healthy"
                r"|position (estimate )?(lost|invalid|not)|no (valid )?(local |global )?position", re.IGNORECASE),
     HeadlineCause.VEHICLE_POSITION_LOST),
    (re.compile(r"fail-?safe", re.IGNORECASE), HeadlineCause.VEHICLE_FAILSAFE),
)  # fmt: skip
# Modes that no person chooses, but a failsafe. 20 is the number of PX4's descent without a position.
FAILSAFE_MODES = frozenset({"AUTO.20", "AUTO.DESCEND", "DESCEND", "TERMINATION", "AVOID_ADSB"})
_AT_ANY_SEVERITY = frozenset({HeadlineCause.VEHICLE_FENCE, HeadlineCause.VEHICLE_FAILSAFE})


def cause_of_text(text: str, *, grave: bool, warns: bool) -> HeadlineCause | None:
    """Return the cause that a text of an armed vehicle tells of; None if it tells of none.

    Args:
        grave: Whether its severity is critical or worse.
        warns: Whether it is at least that of a warning.
    """
    if _BEFORE_ARMING.search(text):
        return None
    found = next((cause for words, cause in _WORDS if words.search(text)), None)
    if found is not None and (warns or found in _AT_ANY_SEVERITY):
        return None if _OVER.search(text) else found
    return HeadlineCause.VEHICLE_ALARM if grave else HeadlineCause.VEHICLE_WARNED if warns else None

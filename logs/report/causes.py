"""Causes that a headline names, the gravest first, and the line that they make: one table for every recording."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

GOOD, CAUTION, BAD = "good", "mind", "bad"  # of a headline: its colour


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
    _C.PILOT: (_R.TAKEN_OVER, CAUTION, "The pilot took over"),
    _C.GROUND_STATION: (_R.TAKEN_OVER, CAUTION, "A ground station took over"),
    _C.MODE_LEFT: (_R.TAKEN_OVER, CAUTION, "Mode changed"),
    _C.POSITIONS_FROZEN: (_R.POSITIONS, BAD, "Positions frozen"),
    _C.POSITIONS_JUMPED: (_R.POSITIONS, BAD, "Positions jumped"),
    _C.POSITIONS_DRIFTED: (_R.POSITIONS, BAD, "Positions drifted"),
    _C.POSITIONS_INVALID: (_R.POSITIONS, BAD, "Positions unusable"),
    _C.POSITIONS_ABSENT: (_R.POSITIONS, BAD, "No positions"),
    _C.POSITIONS_APART: (_R.POSITIONS, CAUTION, "Positions disagree"),
    _C.STAMPS_UNUSABLE: (_R.POSITIONS, BAD, "Time stamps unusable"),
    _C.RELAY_SILENT: (_R.POSITIONS, BAD, "Relay silent"),
    _C.SILENCE: (_R.POSITIONS, CAUTION, "No positions for a while"),
    _C.LET_GO: (_R.ENDING, BAD, "Let go"),
    _C.NOT_AS_ORDERED: (_R.ENDING, BAD, "Not as ordered"),
    _C.BEGIN_REFUSED: (_R.ENDING, BAD, "Refused by the vehicle"),
    _C.NOT_RISEN: (_R.ENDING, BAD, "Never left the ground"),
    _C.NOT_FLOWN: (_R.ENDING, CAUTION, "Nothing was flown"),
    _C.TOUCHED_LIMIT: (_R.QUALITY, CAUTION, "Touched a limit"),
    _C.BEYOND_LIMIT: (_R.QUALITY, CAUTION, "Beyond a limit"),
    _C.FELL_BACK: (_R.QUALITY, CAUTION, "Fell back"),
    _C.NOT_REACHED: (_R.QUALITY, CAUTION, "Not there yet"),
    _C.OFF_TRACK: (_R.QUALITY, CAUTION, "Off its track"),
    _C.WIND: (_R.QUALITY, CAUTION, "Pushed off"),
    _C.PLANS_RELAXED: (_R.DETAIL, CAUTION, "Plans relaxed"),
    _C.LINK_WORSE: (_R.DETAIL, CAUTION, "Link worse than designed"),
    _C.VEHICLE_WARNED: (_R.QUALITY, CAUTION, "The vehicle warned"),
    _C.SECOND_VEHICLE: (_R.QUALITY, CAUTION, "Another vehicle"),
    _C.NO_VEHICLE: (_R.DETAIL, CAUTION, "No vehicle"),
    _C.NOT_ARMED: (_R.DETAIL, CAUTION, "Not armed"),
    _C.ARMING_UNKNOWN: (_R.DETAIL, CAUTION, "Arming not known"),
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
    view_s: float | None = None  # moment to look at first; else its begin
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
    reasons: tuple[str, ...]
    at_s: float = 0.0  # moment to look at first
    cause: HeadlineCause = HeadlineCause.NOTHING_FOUND
    causes: tuple[HeadlineCause, ...] = ()  # all that were found, the gravest first

    @property
    def line(self) -> str:
        """The line."""
        return f"{self.word}: {self.text}"

    def document(self) -> dict[str, object]:
        """Return the headline as `--json` has it."""
        return {"tone": self.tone, "cause": self.cause, "causes": self.causes, "text": self.line, "why": self.reasons}


def sort_findings(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings with the gravest first: by rank, then by time."""
    return sorted(findings, key=lambda finding: (_RANKS.index(_TABLE[finding.cause][0]), finding.at_s))


def make_headline(findings: Iterable[Finding], outcome: str = "", reasons: Iterable[str] = ()) -> Headline:
    """Make the headline of findings, at least one: the gravest, what brought it about, and what came of it.

    Args:
        outcome: A clause on how the flight ended and where it stayed.
        why: Further sentences, below those on the other findings.
    """
    main_finding, *others = sort_findings(findings)
    rank, tone, title = _TABLE[main_finding.cause]
    root = None
    if rank in _EFFECTS:
        candidates = [
            finding
            for finding in others
            if finding.cause in _ROOTS
            and finding.at_s <= (main_finding.view_s or main_finding.at_s) + _MAX_CAUSE_DELAY_S
        ]
        root = min(candidates, key=lambda finding: _ROOTS.index(finding.cause), default=None)
    clauses = [
        main_finding.text,
        *((f"{_TABLE[root.cause][2].lower()}: {root.text}",) if root else ()),
        *((outcome,) if outcome else ()),
    ]
    return Headline(
        tone=main_finding.tone or tone,
        word=title,
        text=f"{'; '.join(clauses)}.",
        reasons=(
            *(finding.sentence for finding in others if finding is not root and not _is_in_outcome(finding, outcome)),
            *reasons,
        ),
        at_s=main_finding.at_s if main_finding.view_s is None else main_finding.view_s,
        cause=main_finding.cause,
        causes=tuple(dict.fromkeys(finding.cause for finding in (main_finding, *others))),
    )


def _is_in_outcome(finding: Finding, outcome: str) -> bool:
    """Return whether the line itself says how the flight ended."""
    return bool(outcome) and finding.cause is _C.NOT_AS_ORDERED


_MAX_CAUSE_DELAY_S = 1.0  # a heartbeat: causes are known that much later than what they bring about


def metres(value: float) -> str:
    """Return a length for a person: "1.6 m", "0.12 m", "4 mm"."""
    if value >= 0.995:
        return f"{value:.1f} m"
    return f"{value:.2f} m" if value >= 0.0095 else f"{1e3 * value:.0f} mm" if value >= 5e-4 else "less than 1 mm"


def seconds(value: float) -> str:
    """Return a time or a length of time for a person, to a tenth of a second: "19.8 s"."""
    return f"{value:.1f} s"

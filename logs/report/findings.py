"""Findings in a recording, the gravest first, and the headline that they make."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from uavctl.cause import CAUSES, Cause, CauseRank

_RANKS = tuple(CauseRank)
# Possible causes of trouble with the vehicle; the likeliest comes first.
_ROOTS = (
    Cause.BATTERY_EMPTY,
    Cause.BATTERY_LOW,
    Cause.STOOD_STILL,
    Cause.RELAY_ATTITUDE,
    Cause.RELAY_SILENT,
    Cause.POSITIONS_FROZEN,
    Cause.POSITIONS_JUMPED,
    Cause.POSITIONS_DRIFTED,
    Cause.STAMPS_UNUSABLE,
    Cause.POSITIONS_INVALID,
    Cause.POSITIONS_ABSENT,
    Cause.FLOWN_BLIND,
    Cause.SILENCE,
    Cause.SETPOINTS_SILENT,
    Cause.POSITIONS_APART,
    Cause.WIND,
)
# Effects that a cause explains. A fence or an empty battery comes of itself.
_EXPLAINED = frozenset({Cause.VEHICLE_FAILSAFE, Cause.VEHICLE_POSITION_LOST})
_EFFECTS = frozenset({CauseRank.LOST, CauseRank.FAILSAFE, CauseRank.TAKEN_OVER, CauseRank.ENDING})


@dataclass(frozen=True)
class Finding:
    """One cause that a recording shows, with the time at which it began."""

    cause: Cause
    at_s: float
    text: str  # a clause, without the words of the cause and without a full stop
    view_s: float | None = None  # moment to look at first; else its begin
    tone: str = ""  # another colour than the table's

    @property
    def sentence(self) -> str:
        """The finding as a sentence of its own."""
        return f"{CAUSES[self.cause].title}: {self.text}."


@dataclass(frozen=True)
class Banner:
    """First line of a page: the main result in colour and words, and the sentences below it."""

    tone: str  # GOOD, CAUTION or BAD
    word: str  # result in a few words, so that it is readable without colour
    text: str  # the rest of the line
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class Headline(Banner):
    """First line of the page of a recording, with the causes behind it."""

    at_s: float = 0.0  # moment to look at first
    cause: Cause = Cause.NOTHING_FOUND
    causes: tuple[Cause, ...] = ()  # all that were found, the gravest first

    @property
    def line(self) -> str:
        """The line."""
        return f"{self.word}: {self.text}"

    def document(self) -> dict[str, object]:
        """Return the headline as `--json` has it."""
        return {"tone": self.tone, "cause": self.cause, "causes": self.causes, "text": self.line, "why": self.reasons}


def sort_findings(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings with the gravest first: by rank, then by time."""
    return sorted(findings, key=lambda finding: (_RANKS.index(CAUSES[finding.cause].rank), finding.at_s))


def make_headline(
    findings: Iterable[Finding], outcome: str = "", reasons: Iterable[str] = (), *, root_first: bool = False
) -> Headline:
    """Make the headline of findings, at least one: the gravest, its causes, and its effects.

    Args:
        outcome: A clause on how the flight ended and where it stayed.
        reasons: Further sentences, below those on the other findings.
        root_first: Whether the line begins with the cause of a failsafe, if that cause was there before.
    """
    main_finding, *others = sort_findings(findings)
    words = CAUSES[main_finding.cause]
    root = None
    if words.rank in _EFFECTS:
        candidates = [
            finding
            for finding in others
            if finding.cause in _ROOTS
            and finding.at_s <= (main_finding.view_s or main_finding.at_s) + _MAX_CAUSE_DELAY_S
        ]
        root = min(candidates, key=lambda finding: _ROOTS.index(finding.cause), default=None)
    shown = [main_finding, *((root,) if root else ())]
    if root_first and main_finding.cause in _EXPLAINED and root and root.at_s < main_finding.at_s:
        shown.reverse()
    first, *rest = shown
    clauses = [
        first.text,
        *(f"{CAUSES[finding.cause].title.lower()}: {finding.text}" for finding in rest),
        *((outcome,) if outcome else ()),
    ]
    return Headline(
        tone=main_finding.tone or words.tone,
        word=CAUSES[first.cause].title,
        text=f"{'; '.join(clauses)}.",
        reasons=(
            *(finding.sentence for finding in others if finding is not root and not _is_in_outcome(finding, outcome)),
            *reasons,
        ),
        at_s=first.at_s if first.view_s is None else first.view_s,
        cause=main_finding.cause,
        causes=tuple(dict.fromkeys(finding.cause for finding in (main_finding, *others))),
    )


def _is_in_outcome(finding: Finding, outcome: str) -> bool:
    """Return whether the headline contains how the flight ended."""
    return bool(outcome) and finding.cause is Cause.NOT_AS_ORDERED


_MAX_CAUSE_DELAY_S = 1.0  # a heartbeat: causes are known that much later than their effects


def metres(value: float) -> str:
    """Return a length for a person: "1.6 m", "0.12 m", "4 mm"."""
    if value >= 0.995:
        return f"{value:.1f} m"
    return f"{value:.2f} m" if value >= 0.0095 else f"{1e3 * value:.0f} mm" if value >= 5e-4 else "less than 1 mm"


def seconds(value: float) -> str:
    """Return a time or a length of time for a person, to a tenth of a second: "19.8 s"."""
    return f"{value:.1f} s"

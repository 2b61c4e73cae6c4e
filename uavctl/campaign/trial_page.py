"""The page of a campaign in the world of the quadrotor: one HTML file, complete in itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from logs import page
from logs.page import Section
from logs.summary import count
from uavctl.campaign.store import SPECIFICATION
from uavctl.campaign.trial_results import ToldTrial, TrialSummary, summarise_trial
from uavctl.errors import UavctlError
from uavctl.trial.figures import MEANING, SHOWN

PAGE = "report.html"
_TITLES = {
    "hold": "Flying to a place and holding it",
    "eight": "Following a figure of eight",
    "blackout": "Four seconds without any position",
}
_OWN = (
    "`own-loop` is the vehicle's own position loop: its estimator gets the very positions that the others get on the "
    "same flight, and nothing else, and it is told where to be, or along a motion position, velocity and acceleration. "
    "The simulated vehicle's inertial sensors are nearly perfect (a constant bias, no noise, attitude without error), "
    "so what it does without positions is better than a real one's."
)


def write_trial_report(folder: Path) -> Path:
    """Write the page of a campaign into its folder.

    Returns:
        Its path.

    Raises:
        UavctlError: The results cannot be read, or the page not be written.
    """
    path = folder / PAGE
    told, cells = summarise_trial(folder)
    try:
        specification = (folder / SPECIFICATION).read_text(encoding="utf-8")
        path.write_text(trial_html(told, cells, specification), encoding="utf-8")
    except OSError as error:
        raise UavctlError(f"{path}: cannot be written ({error.strerror}); make room or choose another place") from error
    return path


def trial_html(told: ToldTrial, cells: Sequence[TrialSummary], specification: str = "") -> str:
    """The page as text."""
    subtitle = f"{count(len(cells), 'cell')} · seed {told.master} · uavctl {told.uavctl_version}"
    return page.page(f"Campaign “{told.name}”", subtitle, _story(cells), _sections(told, cells, specification))


def _story(cells: Sequence[TrialSummary]) -> Iterator[str]:
    flown = [cell for cell in cells if not cell.place.refused]
    yield f"{count(sum(cell.runs for cell in flown), 'flight')} of the true quadrotor, judged on the truth."
    for scenario, shown in SHOWN.items():
        mine = [cell for cell in flown if cell.place.scenario == scenario]
        best = _best(mine, shown[0].key)
        if best:
            places = len({_where(cell) for cell in mine})
            wins = ", ".join(f"{name} in {number}" for name, number in best.items())
            yield f"{_TITLES[scenario]}, {shown[0].heading}: of {places} places the least (median) was that of {wins}."
    if any(cell.failed for cell in flown):
        yield f"{count(sum(cell.failed for cell in flown), 'flight')} failed, and are in no figure."


def _best(cells: Sequence[TrialSummary], key: str) -> dict[str, int]:
    """How often who had the least median of a figure."""
    wins: dict[str, int] = {}
    for where in dict.fromkeys(map(_where, cells)):
        found = {c.place.controller: c.median[key] for c in cells if _where(c) == where}
        known = {name: value for name, value in found.items() if value is not None}
        if known:
            name = min(known, key=lambda one: known[one])
            wins[name] = wins.get(name, 0) + 1
    return wins


def _where(cell: TrialSummary) -> tuple[str, ...]:
    place = cell.place
    return place.autopilot, f"{place.rate_hz:g} Hz", place.link, place.air


def _sections(told: ToldTrial, cells: Sequence[TrialSummary], specification: str) -> Iterator[Section]:
    rows = [
        ("Flights of a cell", str(told.runs)),
        ("Seed", f"{told.master}; flight i of every cell has the draws of (seed, i)"),
    ]
    rooms = {c.place.controller: c.place.usable_room for c in cells if c.place.usable_room is not None}
    rows += [
        (f"Usable room, {name}", f"{100 * share:.0f} % of it is where a plan may rest") for name, share in rooms.items()
    ]
    folded = page.folded("Specification", specification) if specification else ""
    yield Section("What was compared", _OWN, page.facts(rows) + folded)
    for number, (scenario, shown) in enumerate(SHOWN.items()):
        mine = [cell for cell in cells if cell.place.scenario == scenario and not cell.place.refused]
        if not mine:
            continue
        columns = ("vehicle", "cameras", "link", "air", "controller", *(one.heading for one in shown), "ended in")
        table = [
            (*_where(cell), cell.place.controller, *(one.told(cell.values[one.key]) for one in shown), _modes(cell))
            for cell in mine
        ]
        numbers = frozenset(range(5, 5 + len(shown)))
        body = page.table(columns, table, numbers).replace('class="many"', 'class="many dense"', 1)
        yield Section(_TITLES[scenario], MEANING if number == 0 else "", body)
    yield _amiss(cells)


def _modes(cell: TrialSummary) -> str:
    return ", ".join(f"{mode} {number}" for mode, number in cell.modes.items())


def _amiss(cells: Sequence[TrialSummary]) -> Section:
    rows = [
        (str(cell.place.index), cell.place.controller, ", ".join(_where(cell)), why)
        for cell in cells
        for why in ([cell.place.refused] if cell.place.refused else cell.errors)
    ]
    body = page.table(("cell", "controller", "where", "why"), rows, frozenset({0})) if rows else page.paragraph("None.")
    return Section("Not flown, or failed", "", body)

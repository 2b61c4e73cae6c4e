"""Page of a fleet's flight: one HTML file, complete in itself."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from markupsafe import Markup

from logs.recording.output_files import write_atomically
from logs.recording.sender import ServedPositions
from logs.recording.sender_choices import ROUND_ROBIN
from logs.report.approach import LeastDistance
from logs.report.findings import Banner, seconds
from logs.report.fleet import FleetRecording, RecordedVehicle, read_fleet
from logs.report.fleet_figures import (
    choose_raster_span,
    choose_style,
    draw_ages,
    draw_messages,
    draw_paths,
    find_longest_wait,
)
from logs.report.page import Mark, PageSection, Part, render_facts, render_folded, render_page, render_table
from uavctl.arrays import SECOND_NS
from uavctl.cause import BAD, CAUTION, GOOD
from uavctl.errors import UavctlError

_SHOWN_PAIRS = 12


class VehicleFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one vehicle; the field names are the keys of `--json`."""

    name: str
    ended: str
    as_ordered: bool
    let_go: str | None
    mean_age_s: float | None  # over the ticks that the controller flew; None without a position
    p99_age_s: float | None
    longest_age_s: float | None
    fallback_s: float
    mean_square_m2: float | None  # of the distance from the target at flown steps
    messages: int | None = None  # from the sender; None without its recording
    message_share: float | None = None
    longest_wait_s: float | None = None


class PairFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Closest approach of a pair."""

    vehicles: tuple[str, str]
    distance_m: float
    horizontal_m: float
    height_m: float  # of the second above the first
    at_s: float
    source: str  # "truth" or "estimate"


class ScheduledFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Believed cost and age of a vehicle at the messages of the sender, as flown and with round-robin."""

    cost: float
    round_robin_cost: float
    mean_age_s: float
    round_robin_age_s: float


class ScheduleFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Comparison of the sender's schedule with round-robin."""

    schedule: str
    messages: int
    cost_change: float | None  # cost over that of round-robin, less one
    vehicles: dict[str, ScheduledFigures]


class FleetFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of a fleet's flight, as `--json` has them."""

    headline: dict[str, object]
    report: str
    vehicles: tuple[VehicleFigures, ...]
    pairs: tuple[PairFigures, ...]  # the closest first
    collisions: tuple[tuple[str, str, float], ...]  # names, and time [s]
    notes: tuple[str, ...]
    schedule: ScheduleFigures | None  # None without a sender's recording of version 2


def compute_vehicle_figures(vehicle: RecordedVehicle, sent: ServedPositions | None) -> VehicleFigures:
    """Compute the figures of a vehicle."""
    ages_s = vehicle.ages_s
    figures = VehicleFigures(
        name=vehicle.name,
        ended=vehicle.ending.sentence,
        as_ordered=vehicle.ending.as_ordered,
        let_go=None if vehicle.let_go is None else vehicle.let_go[1],
        mean_age_s=float(ages_s.mean()) if len(ages_s) else None,
        p99_age_s=float(np.percentile(ages_s, 99)) if len(ages_s) else None,
        longest_age_s=float(ages_s.max()) if len(ages_s) else None,
        fallback_s=sum(end_ns - begin_ns for begin_ns, end_ns in vehicle.fallbacks_ns) / SECOND_NS,
        mean_square_m2=vehicle.mean_square_m2,
    )
    if sent is None or vehicle.name not in sent.names:
        return figures
    count = len(sent.get_times_ns(vehicle.name))
    return msgspec.structs.replace(
        figures,
        messages=count,
        message_share=count / len(sent.at_ns),
        longest_wait_s=find_longest_wait(sent, vehicle.name).wait_ns / SECOND_NS,
    )


def compute_figures(fleet: FleetRecording, page: Path) -> FleetFigures:
    """Compute the figures of a fleet's flight."""
    banner = derive_banner(fleet)
    return FleetFigures(
        headline={"tone": banner.tone, "text": f"{banner.word}: {banner.text}", "why": banner.reasons},
        report=str(page),
        vehicles=tuple(compute_vehicle_figures(vehicle, fleet.sent) for vehicle in fleet.vehicles),
        pairs=tuple(
            PairFigures(
                vehicles=one.names,
                distance_m=one.distance_m,
                horizontal_m=one.horizontal_m,
                height_m=one.height_m,
                at_s=float(fleet.to_seconds(one.at_ns)),
                source="truth" if one.is_true else "estimate",
            )
            for one in fleet.approaches
        ),
        collisions=tuple((*one.names, float(fleet.to_seconds(one.at_ns))) for one in fleet.collisions),
        notes=fleet.notes,
        schedule=compute_schedule_figures(fleet),
    )


def compute_schedule_figures(fleet: FleetRecording) -> ScheduleFigures | None:
    """Compute the figures of the sender's schedule."""
    one = fleet.schedule
    if one is None:
        return None
    columns = (one.costs, one.round_robin_costs, one.ages_s, one.round_robin_ages_s)
    fields = ScheduledFigures.__struct_fields__
    return ScheduleFigures(
        schedule=one.schedule,
        messages=one.messages,
        cost_change=one.change,
        vehicles={
            name: ScheduledFigures(**dict(zip(fields, (float(column[i]) for column in columns), strict=True)))
            for i, name in enumerate(one.names)
        },
    )


@dataclass(frozen=True)
class _Finding:
    tone: str
    word: str
    text: str


def _find_trouble(fleet: FleetRecording) -> Iterator[_Finding]:
    """Yield what went wrong, the gravest first."""
    for collision in fleet.collisions:
        at_s, (first, second) = seconds(fleet.to_seconds(collision.at_ns)), collision.names
        yield _Finding(BAD, "Collision", f"{first} and {second} at {at_s}, with {collision.speed_mps:.1f} m/s")
    for vehicle in fleet.vehicles:
        if vehicle.let_go is not None:
            at_ns, reason = vehicle.let_go
            yield _Finding(BAD, "Let go", f"{vehicle.name} at {seconds(fleet.to_seconds(at_ns))}: {reason}")
    names_by_ending: dict[str, list[str]] = {}
    for vehicle in fleet.vehicles:
        if not vehicle.ending.as_ordered and vehicle.let_go is None:
            names_by_ending.setdefault(vehicle.ending.sentence.rstrip("."), []).append(vehicle.name)
    for sentence, names in names_by_ending.items():
        yield _Finding(BAD, "Not as ordered", f"{', '.join(names)}: {sentence}")
    for vehicle in fleet.vehicles:
        if vehicle.fallbacks_ns:
            begin_s = seconds(fleet.to_seconds(vehicle.fallbacks_ns[0][0]))
            fallback_s = seconds(compute_vehicle_figures(vehicle, None).fallback_s)
            yield _Finding(CAUTION, "Fallback", f"{vehicle.name} flew it for {fallback_s}, first at {begin_s}")
    for note in fleet.notes:
        yield _Finding(CAUTION, "Incomplete", note)


def derive_banner(fleet: FleetRecording) -> Banner:
    """Return the first line of the page: whether anything went wrong, and the lowest distance."""
    findings = list(_find_trouble(fleet))
    distance_text = _describe_closest(fleet)
    if not findings:
        count = len(fleet.tracks)
        return Banner(GOOD, "All well", f"{count} vehicle{'s' if count > 1 else ''}; {distance_text}.")
    first, *others = findings
    reasons = tuple(f"{finding.word}: {finding.text}." for finding in others)
    return Banner(first.tone, first.word, f"{first.text}; {distance_text}.", reasons)


def _describe_closest(fleet: FleetRecording) -> str:
    if not fleet.approaches:
        return "no two vehicles whose distance is known"
    closest = fleet.approaches[0]
    source = "true distance" if closest.is_true else "by their own estimates"
    at_s = seconds(fleet.to_seconds(closest.at_ns))
    return f"lowest distance {closest.distance_m:.2f} m, {closest.names[0]} to {closest.names[1]} at {at_s} ({source})"


def _show_vehicles(fleet: FleetRecording) -> Iterator[Part]:
    rows = []
    for vehicle in fleet.vehicles:
        figures = compute_vehicle_figures(vehicle, fleet.sent)
        mean_square_m2 = figures.mean_square_m2
        rows.append(
            [
                _link_page(vehicle),
                figures.ended,
                _format(figures.mean_age_s),
                _format(figures.p99_age_s),
                _format(figures.longest_age_s),
                f"{figures.fallback_s:.1f}",
                _format(None if mean_square_m2 is None else mean_square_m2**0.5),
                _format(mean_square_m2, 4),
            ]
        )
    columns = (
        "vehicle",
        "how its flight ended",
        "mean age [s]",
        "99 % [s]",
        "longest [s]",
        "in fallback [s]",
        "from target, rms [m]",
        "mean square [m²]",
    )
    if rows:
        yield render_table(columns, rows, frozenset(range(2, len(columns))), kind="dense")


def _link_page(vehicle: RecordedVehicle) -> str:
    """Return the name of a vehicle, as a link to its own page where there is one."""
    page = vehicle.recording.with_suffix(".html")
    if not page.exists():
        return vehicle.name
    return Markup('<a href="{}/{}">{}</a>').format(vehicle.name, page.name, vehicle.name)


def _format(value: float | None, decimals: int = 3) -> str:
    return "–" if value is None else f"{value:.{decimals}f}"


def _show_pairs(fleet: FleetRecording) -> Iterator[Part]:
    if fleet.approaches:
        yield _make_pair_table(fleet, fleet.approaches[:_SHOWN_PAIRS])
    rest = fleet.approaches[_SHOWN_PAIRS:]
    if rest:
        yield render_folded(f"{len(rest)} further pairs", _make_pair_table(fleet, rest))


def _make_pair_table(fleet: FleetRecording, approaches: tuple[LeastDistance, ...]) -> Markup:
    rows = [
        (
            " – ".join(one.names),
            f"{one.distance_m:.3f}",
            f"{one.horizontal_m:.3f}",
            f"{abs(one.height_m):.3f}",
            f"{fleet.to_seconds(one.at_ns):.2f}",
            "truth" if one.is_true else "estimates",
        )
        for one in approaches
    ]
    columns = ("pair", "distance [m]", "horizontal [m]", "height [m]", "at [s]", "from")
    return render_table(columns, rows, frozenset(range(1, 5)))


def _explain_pairs(fleet: FleetRecording) -> str:
    if fleet.is_true:
        until = ", until both have collided" if fleet.collisions else ""
        return f"Least distance of the centres, by the simulator's own positions{until}."
    return (
        "Least distance of the centres, by the vehicles' own estimates: each may be wrong by its error. A vehicle "
        "without positions for its whole horizon is left out for that time."
    )


def _list_styles(fleet: FleetRecording) -> Iterator[Mark]:
    for name in fleet.names:
        style = choose_style(fleet, name)
        yield Mark(style.kind, style.role, name)


def _list_path_marks(fleet: FleetRecording) -> Iterator[Mark]:
    yield from _list_styles(fleet)
    yield Mark("ring", "muted", "begin")
    yield Mark("dot", "muted", "end")
    yield Mark("dashed", "muted", "limits of a vehicle")
    if fleet.contact_m is not None:
        yield Mark("dashed", "limit", "vehicles touch")
    if fleet.collisions:
        yield Mark("line", "limit", "collision")


def _show_messages(fleet: FleetRecording) -> Iterator[Part]:
    sent = fleet.sent
    if sent is None:
        return
    rows = []
    for name in sent.names:
        count, wait = len(sent.get_times_ns(name)), find_longest_wait(sent, name)
        share = f"{100 * count / len(sent.at_ns):.1f} %"
        wait_s, at_s = f"{wait.wait_ns / SECOND_NS:.3f}", f"{fleet.to_seconds(wait.begin_ns):.2f}"
        rows.append((name, str(count), share, wait_s, at_s))
    columns = ("vehicle", "messages", "share", "longest wait [s]", "from [s]")
    yield render_table(columns, rows, frozenset(range(1, len(columns))))
    yield from draw_messages(fleet, sent)


def _explain_messages(fleet: FleetRecording) -> str:
    text = "Each stroke is a position that the sender put on the channel; it does not show whether it arrived."
    if fleet.sent is None:
        return text
    first, last = choose_raster_span(fleet.sent)
    if last - first + 1 < len(fleet.sent.at_ns):
        text += " The strokes are those around the longest wait."
    return text


def _show_schedule(fleet: FleetRecording) -> Iterator[Part]:
    figures = compute_schedule_figures(fleet)
    if figures is None:
        return
    rows = [
        (
            name,
            f"{one.cost:.4g}",
            f"{one.round_robin_cost:.4g}",
            _format_change(one.cost / one.round_robin_cost - 1.0 if one.round_robin_cost > 0.0 else None),
            f"{one.mean_age_s:.3f}",
            f"{one.round_robin_age_s:.3f}",
        )
        for name, one in figures.vehicles.items()
    ]
    ones = figures.vehicles.values()
    total, other_total = sum(one.cost for one in ones), sum(one.round_robin_cost for one in ones)
    rows.append(("all", f"{total:.4g}", f"{other_total:.4g}", _format_change(figures.cost_change), "", ""))
    flown = f"with {figures.schedule}" if figures.schedule != ROUND_ROBIN else "as flown"
    columns = (
        "vehicle",
        f"cost {flown}",
        f"with {ROUND_ROBIN}",
        "change",
        f"mean age {flown} [s]",
        f"with {ROUND_ROBIN} [s]",
    )
    yield render_table(columns, rows, frozenset(range(1, len(columns))))


def _format_change(change: float | None) -> str:
    return "–" if change is None else f"{100 * change:+.1f} %"


def _show_recordings(fleet: FleetRecording) -> Iterator[Part]:
    yield render_facts(
        (vehicle.name, f"{vehicle.recording} · {vehicle.header.started_utc} · {vehicle.header.command}")
        for vehicle in fleet.vehicles
    )


SECTIONS: tuple[PageSection[FleetRecording], ...] = (
    PageSection(
        "Vehicles",
        _show_vehicles,
        note="The distance from the target is that at each flown step, on the way to it, too.",
        empty_text="No recording of a vehicle can be shown.",
    ),
    PageSection(
        "Closest approaches",
        _show_pairs,
        note=_explain_pairs,
        empty_text="There are no two vehicles whose positions are known at one time.",
    ),
    PageSection("Paths", draw_paths, legend=_list_path_marks),
    PageSection(
        "Age of information",
        draw_ages,
        note="The age of the newest position at each tick that the controller flew; where it never flew, at each tick.",
        legend=(
            Mark("line", "estimate", "age"),
            Mark("dashed", "limit", "a plan's end", when=lambda fleet: _reaches_horizon(fleet)),
            Mark("band", "fallback", "fallback", when=lambda fleet: any(v.fallbacks_ns for v in fleet.vehicles)),
        ),
    ),
    PageSection(
        "Who was served when",
        _show_messages,
        when=lambda fleet: fleet.sent is not None,
        note=_explain_messages,
        legend=_list_styles,
    ),
    PageSection(
        "Cost of the schedule",
        _show_schedule,
        when=lambda fleet: fleet.schedule is not None,
        note=(
            "Believed cost of the ages, the mean over all messages. Round-robin chooses from the same positions, at "
            "the same times. Losses are those that the design expects; reports count for neither."
        ),
    ),
    PageSection("Recordings", _show_recordings, is_closed=True),
)


def _reaches_horizon(fleet: FleetRecording) -> bool:
    return any(vehicle.horizon_s <= float(vehicle.ages_s.max(initial=0.0)) for vehicle in fleet.vehicles)


def render_fleet(fleet: FleetRecording) -> str:
    """Return the page of a fleet's flight as HTML."""
    count = len(fleet.names)
    started = fleet.vehicles[0].header.started_utc if fleet.vehicles else ""
    subtitle = f"{started} · {fleet.folder} · {fleet.duration_s:.1f} s".removeprefix(" · ")
    title = f"Flight of {count} vehicles" if count > 1 else "Flight of one vehicle"
    return render_page(title, subtitle, SECTIONS, fleet, derive_banner(fleet))


def write_fleet_page(fleet: FleetRecording, path: Path) -> FleetFigures:
    """Write the page; return its figures.

    Raises:
        RecordingError: The file cannot be written.
    """
    write_atomically(path, render_fleet(fleet))
    return compute_figures(fleet, path)


def main() -> int:
    """Write the page of a folder; return 0, or 1 with the reason on standard error if it cannot be written."""
    folder, page = Path(sys.argv[1]), Path(sys.argv[2])
    try:
        figures = write_fleet_page(read_fleet(folder), page)
    except UavctlError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.write(f"{figures.headline['text']}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

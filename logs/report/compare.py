"""Comparison of flights: loaded recordings, differences in their parameters and records, figures side by side."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from string import ascii_uppercase

import msgspec
import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.recording.file_scan import RecordedMessage
from logs.recording.flight import FlightData
from logs.recording.info import read_info
from logs.recording.parameters import VehicleParameter
from logs.recording.reader import read, read_messages
from logs.recording.replay import find_different_leaves
from logs.recording.summary import FlightSummary, Percentiles, compute_position_errors_m, summarise
from logs.recording.topics import HEADER, LIBRARY, RECORDER, decode, parse_raw_topic
from uavctl.config.load import flatten_keys, parse_stored_toml
from uavctl.errors import ConfigError, RecordingError
from uavctl.mavlink.framing import scan_frames
from uavctl.records import Header


class ComparedFlight(msgspec.Struct, frozen=True, kw_only=True):
    """One recording of a comparison: its name there, where it is from, and how its flight ended."""

    name: str  # A to Z, and then A1, B1, ..., unless it was given another
    recording: str
    config: str
    command: str
    started_utc: str
    seed: int
    ended: str
    finished: bool  # closed in order; else compared up to its end
    records_lost: int  # dropped, refused, or missing in the file


@dataclass(frozen=True, eq=False)
class LoadedFlight:
    """One recording of a comparison in memory, with its records and its summary."""

    identity: ComparedFlight
    flight: FlightData
    summary: FlightSummary
    parameters: Mapping[str, VehicleParameter]  # of the vehicle, as it reported them


def load_flights(
    paths: Sequence[Path], on_loaded: Callable[[], None] = lambda: None, names: Sequence[str] = ()
) -> tuple[LoadedFlight, ...]:
    """Read the recordings of a comparison.

    Args:
        names: Names of the flights; else A, B, … in their order.

    Raises:
        RecordingError: One cannot be read, or nothing was flown in it; names it.
    """
    recordings = []
    for number, path in enumerate(paths):
        letter = ascii_uppercase[number % 26] + (str(number // 26) if number >= 26 else "")
        recordings.append(_load_flight(path, names[number] if names else letter))
        on_loaded()
    return tuple(recordings)


def _load_flight(path: Path, name: str) -> LoadedFlight:
    file_info = read_info(path)
    flight = FlightData.from_records(read(path), path)
    summary = summarise(flight, wall_s=None)
    identity = ComparedFlight(
        name=name,
        recording=str(path),
        config="" if file_info.origin is None else file_info.origin.config,
        command=flight.header.command,
        started_utc=flight.header.started_utc,
        seed=flight.header.seed,
        ended=summary.ending.cause,
        finished=file_info.finished,
        records_lost=file_info.dropped + file_info.refused + file_info.missing,
    )
    return LoadedFlight(identity, flight, summary, file_info.parameters)


Value = int | float | None


class Figure(msgspec.Struct, frozen=True, kw_only=True):
    """One figure (error, cost, time, …) of all compared flights; null where it was not measured."""

    key: str
    group: str
    text: str
    unit: str
    values: tuple[Value, ...]  # one each recording
    differences: tuple[Value, ...]  # from the first, one each other recording
    ratios: tuple[float | None, ...]  # to the first, likewise; null if that is 0


def collect_figures(recordings: Sequence[LoadedFlight]) -> Iterator[Figure]:
    """Return the figures that at least one of the flights has."""
    methods = dict.fromkeys(name for recording in recordings for name in recording.summary.methods)
    measured = [{row[0]: row for row in _collect_rows(recording, methods)} for recording in recordings]
    for key, (_, group, text, unit, _) in {
        key: row for figures in reversed(measured) for key, row in figures.items()
    }.items():
        values = tuple(figures[key][-1] if key in figures else None for figures in measured)
        if all(value is None for value in values):
            continue
        first, *others = values
        yield Figure(
            key=key,
            group=group,
            text=text,
            unit=unit,
            values=values,
            differences=tuple(None if first is None or other is None else other - first for other in others),
            ratios=tuple(None if not first or other is None else other / first for other in others),
        )


_Row = tuple[str, str, str, str, Value]  # key, group, text, unit and value


def _collect_rows(recording: LoadedFlight, methods: Iterable[str]) -> tuple[_Row, ...]:
    """Return the figures of one flight, with the plans of each method; those of the summary keep its keys."""
    s, flight = recording.summary, recording.flight
    ages = [d.age_steps for d in flight.steps.decisions if d.age_steps is not None]
    error_m = compute_position_errors_m(flight)
    inputs = np.linalg.norm(flight.steps.input, axis=1)
    in_fallback_s = sum((b - a for a, b in flight.fallback_spans), 0.0)
    return (
        ("steps", "flight", "steps flown", "", s.steps),
        ("duration_s", "flight", "duration", "s", s.duration_s),
        ("received", "link", "positions received", "", s.received),
        ("lost", "link", "positions lost", "", s.lost),
        ("loss", "link", "share lost", "", None if s.lost is None else _divide(s.lost, s.received + s.lost)),
        ("rejected", "link", "positions refused", "", s.rejected),
        ("mean_age", "link", "mean age", "steps", _divide(sum(ages), len(ages))),
        ("max_age", "link", "largest age", "steps", s.max_age),
        ("max_age_s", "link", "largest age", "s", s.max_age_s),
        ("fallbacks", "limits", "fallbacks", "", s.fallbacks),
        ("fallback_s", "limits", "time in fallback", "s", round(in_fallback_s, 9)),
        ("state_violations", "limits", "state outside limits", "steps", s.state_violations),
        ("input_violations", "limits", "input outside limits", "steps", s.input_violations),
        ("slack_used", "limits", "plans with slack", "", s.slack_used),
        ("cost", "tracking", "cost", "", s.cost),
        ("cost_per_step", "tracking", "cost a step", "", _divide(s.cost, s.steps)),
        ("mean_error_m", "tracking", "distance from target, rms", "m", _compute_rms(error_m)),
        ("settled_error_m", "tracking", "same, last quarter", "m", s.settled_error_m),
        ("final_error_m", "tracking", "same, at the end", "m", s.final_error_m),
        ("mean_input", "tracking", "input, rms", flight.design.input_unit, _compute_rms(inputs)),
        ("solves", "plans", "solves", "", s.solves),
        ("failed_solves", "plans", "solves without optimum", "", s.failed_solves),
        *((f"methods.{name}", "plans", f"plans, {name}", "", s.methods.get(name, 0)) for name in methods),
        ("largest_gap", "plans", "largest certified gap", "", s.largest_gap),
        *_collect_percentiles("decision_us", "decision time", s.decision_us),
        *_collect_percentiles("tick_lateness_us", "tick lateness", s.tick_lateness_us),
        ("missed_ticks", "time", "ticks missed", "", s.missed_ticks),
        ("records_lost", "recording", "records lost", "", recording.identity.records_lost),
    )


def _collect_percentiles(key: str, text: str, percentiles: Percentiles) -> Iterator[_Row]:
    for name, percentile_text in (("p50", "median"), ("p99", "99 %"), ("max", "largest")):
        yield f"{key}.{name}", "time", f"{text}, {percentile_text}", "µs", getattr(percentiles, name)


def _divide(part: float, whole: float) -> float | None:
    return part / whole if whole else None


def _compute_rms(values: NDArray[np.float64]) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else None


# Origin of a recording and times of the computer's clock: not properties of the flight.
_IGNORED_TOPICS = frozenset({HEADER, LIBRARY, RECORDER, "/uavctl/timing"})
_MAX_VALUE_CHARACTERS = 72  # characters of a value


class FirstDivergence(msgspec.Struct, frozen=True, kw_only=True):
    """First record in which a flight differs from the first one."""

    topic: str
    flight_s: float  # since the first tick of the first recording
    field: str  # path in the record; empty if there is none on one side, or at another time
    first: str  # value in the first recording
    other: str


class Match(msgspec.Struct, frozen=True, kw_only=True):
    """Agreement of a flight with that of the first recording, bit for bit; computing times do not count."""

    name: str
    identical: bool
    records: int  # alike, from the beginning
    parting: FirstDivergence | None  # None if all are alike


class ParameterDifference(msgspec.Struct, frozen=True, kw_only=True):
    """Parameter in which the recordings differ; null where a recording does not have it."""

    # Key in the configuration, or design_id, library_id, cpu, platform, versions.<package>, vehicle.<PARAMETER>
    key: str
    values: tuple[object, ...]  # one each recording


class FlightComparison(msgspec.Struct, frozen=True, kw_only=True):
    """Result of `compare`: all flights against the first."""

    recordings: tuple[ComparedFlight, ...]
    likenesses: tuple[Match, ...]
    parameters: tuple[ParameterDifference, ...]
    figures: tuple[Figure, ...]
    notes: tuple[str, ...]  # cautions for reading the figures


def compare_flights(recordings: Sequence[LoadedFlight]) -> FlightComparison:
    """Compare flights with the first of them.

    Raises:
        RecordingError: A header's configuration cannot be read.
    """
    return FlightComparison(
        recordings=tuple(recording.identity for recording in recordings),
        likenesses=tuple(_compare_records(recordings[0], other) for other in recordings[1:]),
        parameters=(
            *_find_differences([_collect_parameters(recording) for recording in recordings]),
            *_find_differences(_collect_vehicle_parameters(recordings)),
        ),
        figures=tuple(collect_figures(recordings)),
        notes=tuple(_list_notes(recordings)),
    )


def _compare_records(first: LoadedFlight, other: LoadedFlight) -> Match:
    identical_count = 0
    first_messages, other_messages = (
        filter(
            lambda message: message.definition.topic not in _IGNORED_TOPICS,
            read_messages(Path(recording.identity.recording)),
        )
        for recording in (first, other)
    )
    for first_message, other_message in zip_longest(first_messages, other_messages):
        if first_message is None or other_message is None or _get_content(first_message) != _get_content(other_message):
            divergence = _find_divergence(first_message, other_message, first.flight.origin_ns)
            return Match(name=other.identity.name, identical=False, records=identical_count, parting=divergence)
        identical_count += 1
    return Match(name=other.identity.name, identical=True, records=identical_count, parting=None)


def _get_content(message: RecordedMessage) -> tuple[str, bytes, int]:
    """Return the content of a message that is compared: topic, bytes and log time [ns]."""
    return message.definition.topic, message.data, message.at_ns


def _find_divergence(
    first_message: RecordedMessage | None, other_message: RecordedMessage | None, origin_ns: int
) -> FirstDivergence:
    """Return the first difference of two recordings; None for a message stands for a recording's end."""
    message = first_message or other_message
    assert message is not None
    topic, at_ns = message.definition.topic, message.at_ns
    field = ""
    if first_message is None or other_message is None:
        contents = tuple("its end" if message is None else "a record" for message in (first_message, other_message))
    elif (first_message.definition.topic, first_message.at_ns) != (other_message.definition.topic, other_message.at_ns):
        contents = tuple(
            f"{message.definition.topic} at {(message.at_ns - origin_ns) * 1e-9:.3f} s"
            for message in (first_message, other_message)
        )
    elif parse_raw_topic(topic) is not None:
        contents = (_describe_frame(first_message.data), _describe_frame(other_message.data))
    else:
        field, first_value, other_value = find_different_leaves(
            decode(*_get_content(first_message)), decode(*_get_content(other_message))
        )[0]
        contents = (repr(first_value), repr(other_value))
    return FirstDivergence(
        topic=topic,
        flight_s=(at_ns - origin_ns) * 1e-9,
        field=field,
        first=_shorten(contents[0]),
        other=_shorten(contents[1]),
    )


def _describe_frame(data: bytes) -> str:
    """Return raw bytes in words: the name of their first MAVLink message, and their number."""
    frames = scan_frames(data, final=True).frames
    name = mavlink.mavlink_map[frames[0].message_id].msgname if frames else "no whole packet"
    return f"{name}, {len(data)} bytes"


def _shorten(text: str) -> str:
    return text if len(text) <= _MAX_VALUE_CHARACTERS else f"{text[: _MAX_VALUE_CHARACTERS - 1]}…"


def _collect_parameters(recording: LoadedFlight) -> dict[str, object]:
    """Return the set-up of a flight: configuration, design, library, versions, processor."""
    header: Header = recording.flight.header
    try:
        config = parse_stored_toml(header.config_toml, "configuration")
    except ConfigError as error:
        raise RecordingError(
            f"{recording.identity.recording}: the configuration in its header is damaged ({error})"
        ) from error
    return {
        # JSON has no infinity, which limits may be.
        **{
            key: str(value) if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in flatten_keys(config)
        },
        "design_id": header.design_id,
        "library_id": header.library_id,
        "cpu": header.cpu,
        "platform": header.platform or None,
        **{f"versions.{name}": version for name, version in sorted(header.versions.items())},
    }


def _collect_vehicle_parameters(recordings: Sequence[LoadedFlight]) -> list[dict[str, object]]:
    """Return the vehicle's parameters that differ, of those reported in all flights with any."""
    parameter_sets = [recording.parameters for recording in recordings if recording.parameters]
    common_names = sorted(set.intersection(*map(set, parameter_sets))) if parameter_sets else []
    differing_names = [
        name for name in common_names if len({recording[name].value for recording in parameter_sets}) > 1
    ]
    return [
        {f"vehicle.{name}": recording.parameters[name].value for name in differing_names if recording.parameters}
        for recording in recordings
    ]


def _find_differences(parameters: Sequence[Mapping[str, object]]) -> Iterator[ParameterDifference]:
    for key in dict.fromkeys(key for entry in parameters for key in entry):
        values = tuple(entry.get(key) for entry in parameters)
        if any(value != values[0] for value in values[1:]):
            yield ParameterDifference(key=key, values=values)


def _list_notes(recordings: Sequence[LoadedFlight]) -> Iterator[str]:
    if _differs(recordings, lambda recording: recording.parameters.keys()):
        counts_text = ", ".join(f"{recording.identity.name} {len(recording.parameters)}" for recording in recordings)
        yield (
            f"the vehicle did not report the same parameters in all ({counts_text}): those of some flights only are "
            f"left out"
        )
    for recording in recordings:
        if not recording.identity.finished:
            yield f"{recording.identity.name} is torn: compared up to its end"
        if recording.identity.records_lost:
            yield (
                f"{recording.identity.name} lacks {recording.identity.records_lost} records: no figure contains them"
            )
    if _differs(recordings, lambda recording: recording.summary.steps):
        yield "the flights are of different length: counts and the cost add up over the steps flown"
    if _differs(
        recordings,
        lambda recording: (recording.flight.design.q_x, recording.flight.design.q_u, recording.flight.design.dt_s),
    ):
        yield "the costs are not of one kind: weights or the length of a step differ"
    if _differs(recordings, lambda recording: recording.summary.state_source):
        sources = ", ".join(
            f"{recording.identity.name} by the {recording.summary.state_source}" for recording in recordings
        )
        yield f"states are judged by different sources: {sources}"
    if _differs(recordings, lambda recording: recording.flight.virtual_time):
        yield "some were flown in virtual time, where no tick is late"
    if _differs(recordings, lambda recording: recording.flight.header.cpu):
        yield "times were measured on different processors"


def _differs(recordings: Sequence[LoadedFlight], property_of: Callable[[LoadedFlight], object]) -> bool:
    return any(property_of(recording) != property_of(recordings[0]) for recording in recordings[1:])

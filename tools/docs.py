"""The pages of docs/ that are made from types and tables of the product; `make docs` writes them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from textwrap import wrap
from typing import cast

import msgspec
from msgspec import NODEFAULT
from msgspec.structs import FieldInfo

from logs.recording.derived_topics import VIEWS
from logs.recording.topics import TOPICS, get_definition
from uavctl.cli.app import app
from uavctl.config.document import Section, describe_type, get_description, get_element_type, is_section
from uavctl.config.room import RoomConfig
from uavctl.config.types import HAHN_STURSBERG_KEYS, Config
from uavctl.lab.campaign.spec import CampaignSpec
from uavctl.lab.campaign.trials import TrialSpec
from uavctl.mavlink.handover_states import TRANSITIONS, HandoverEvent, HandoverState
from uavctl.mavlink.profile import PROFILES, ModeChoice
from uavctl.records import Record

ROOT = Path(__file__).resolve().parent.parent
_CONFIGURATION = """# Configuration

This page lists every key. `make docs` generates it from `uavctl/config/`.

A configuration is a TOML file. The shortest one names a preset and overrides some keys:

```toml
base = "room-px4"

[room]
north_m = [-2.0, 2.0]
```

* `--config NAME` takes a file or a preset: `paper`, `room`, `room-px4`, `room-ardupilot` or `room-hahn-stursberg`
  (in `uavctl/presets/`).
* `--set key.path=value` overrides a key, as often as you like: `--set link.loss=0.3`,
  `--set 'link.blackout=[[20, 40]]'`. A string needs no quotes.
* `base` gives the missing keys. `[room]` replaces the lists of `[sets]`, `[target]` and `[limits]`. Without `base`, a
  file needs `[plant]`, `[sets]` and `[cost]`. `uavctl init` writes a file.
* All problems are reported at once, with file, line, key and remedy (exit code 2).

How to read the lists:

* The value after a key is its default.
* (0.2…10) is the range; `>` and `<` exclude its end. Numbers without a range are -1e7 to 1e7.
* The end of a key is its unit: `_s`, `_m`, `_deg`, `_ppm`, `_hz` (1/s), `_mps` (m/s), `_mps2` (m/s²), `_1ps` (1/s).
* A span is `[from_s, to_s]` since the start. Vectors are local NED: north, east, down.
* H is the horizon, Δt the step. n_x, n_u and n_w count states, inputs (one for each axis) and disturbances.
* States go axis by axis: position, velocity, and acceleration with model `drag-lag`. Model `velocity-reference` adds
  acceleration, lead of the vehicle's reference in position and velocity, and integral.
* A plant of `matrices` without `axes` cannot fly. `solve`, `design`, `campaign` and `uavctl.simulate` take it.
"""
# Keys that follow from others where they are left out.
_DERIVED = {
    "name": "the file's name",
    "plant.model": "`matrices` where `a` is given",
    "smpc.horizon": "48 with scheme `age-conditioned`",
    "target.position_m": "0, or the middle of the limits",
    "limits.accel_mps2": "by the limits of the inputs",
    "limits.slew_mps3": "15, more where an own plant's inputs are wider",
    "daemon.tick_s": "the longest up to 0.1 that divides Δt",
    "sim.camera.rate_hz": "one sample each Δt",
}
_CAMPAIGN = """# Keys of a campaign

This page lists every key of a campaign. `make docs` generates it. `docs/campaigns/` has complete files;
[campaigns](campaigns.md) runs them. The shortest one:

```toml
name = "mine"
config = "paper"

[[controller]]
name = "ours"
kind = "smpc"
```

Each `set` is a list of overrides of the flight [configuration](configuration.md), as for `--set`.
"""
_FLIGHTS = """# Keys of a campaign of flights

With `world = "quadrotor"` a campaign flies the simulated quadrotor. Its file has these keys instead; `[[link]]` is as
above.
"""
_TOPICS = """# Topics of a recording

This page lists the topics of an MCAP file and their fields. It is generated (`make docs`). To see the topics of a
recording:

```sh
uavctl log info FLIGHT
```

Records are JSON, with their schemas in the file. [Times](recordings.md#times) in records are nanoseconds of a monotonic
clock. Numbers have the digits that give the same float back. NaN and infinities are the strings `"NaN"`, `"Infinity"`,
`"-Infinity"`. `[]` is a list. A field with `?` may be null.

`/raw/<link>/in` and `/raw/<link>/out` are the datagrams (MAVLink) of connection `<link>`; log time is the time of
receiving or sending.
"""
_VIEWS = """# Topics for viewers

These topics are made from the records above for [viewers](viewers.md), as protobuf. No replay and no report reads them.
Positions are local NED, in frame `ned`; look from frame `room` (east, north, up). NaN: no number.

| topic | schema | content |
|---|---|---|"""


def configuration_page() -> str:
    """The page docs/configuration.md, made from the types of the configuration."""
    return "\n".join((_CONFIGURATION, *tables(RoomConfig, "room"), *tables(Config, "")))


def tables(section: type[Section], path: str) -> Iterator[str]:
    """A section's keys and those of its tables, as Markdown; `path` is the prefix of its keys."""
    fields = msgspec.structs.fields(section)
    title = f"`[{path}]`" if path else "Top level"
    yield "\n".join(
        (f"## {title}", "", *wrap(" ".join((section.__doc__ or "").split()), 120, break_on_hyphens=False), "")
    )
    for field in fields:
        if not is_section(field.type):
            key = f"{path}.{field.encode_name}" if path else field.encode_name
            needed = key in HAHN_STURSBERG_KEYS
            default = "required with `hahn-stursberg`" if needed else _describe_default(field, section, key)
            yield _wrap_item(_describe_key(field, default))
    yield ""
    for field in fields:
        name = f"{path}.{field.encode_name}" if path else field.encode_name
        one = get_element_type(field.type)
        if one is not None:
            yield from tables(one, f"[{name}]")
        elif is_section(field.type):
            yield from tables(field.type, name)


def _wrap_item(text: str) -> str:
    """Wrap an item of a Markdown list."""
    return "\n".join(wrap(text, 120, subsequent_indent="  ", break_on_hyphens=False))


# Endings of keys, and the unit that each of them states.
_UNITS = {
    "_s": "s",
    "_m": "m",
    "_mps": "m/s",
    "_mps2": "m/s²",
    "_mps3": "m/s³",
    "_1ps": "1/s",
    "_1ps2": "1/s²",
    "_hz": "1/s",
    "_deg": "deg",
    "_dps": "deg/s",
    "_ppm": "ppm",
    "_v": "V",
    "_bytes": "bytes",
    "_per_s": "1/s",
    "seconds": "s",
}


_SPANS = "lists of 2 numbers"  # the head of the page says what a span is


def _describe_key(field: FieldInfo, default: str) -> str:
    """Describe a key as an item of a list: name, default, type or range, meaning."""
    has_value = field.default is not NODEFAULT and field.default is not None
    is_shown = has_value and field.default != ()  # the default shows the type
    kind = _describe_type(field, is_shown=is_shown)
    if '"' in kind:
        kind = _describe_choices(kind, default if is_shown else "", get_description(field))
    details = [text for text in (kind, "" if has_value else default) if text and text != _SPANS]
    head = f"`{field.encode_name} = {default}`" if has_value else f"`{field.encode_name}`"
    shown = f" ({'; '.join(details)})" if details else ""
    return f"* {head}{shown}: {_describe_meaning(field, kind)}"


def _describe_meaning(field: FieldInfo, kind: str) -> str:
    """Return the meaning of a key, without a unit that its name or kind states."""
    meaning, _, unit = get_description(field).removesuffix("]").rpartition(" [")
    is_stated = kind == _SPANS or any(field.encode_name.endswith(end) and unit == _UNITS[end] for end in _UNITS)
    return meaning if meaning and is_stated else get_description(field)


def _describe_choices(kind: str, default: str, meaning: str) -> str:
    """Return the choices of a key besides its default; nothing where its meaning has all of them."""
    choices = re.findall(r'"[^"]+"', kind)
    others = ", ".join(choice for choice in choices if choice not in default)
    if not others or all(choice.replace('"', "`") in meaning for choice in choices):
        return ""
    return f"or {others}" if default else others


def _describe_type(field: FieldInfo, *, is_shown: bool) -> str:
    """Describe a type in few words: without lengths, and without a kind and a range that page or default show."""
    text = re.sub(
        r" \((entries|characters): (at least 1, )?at most \d+\)| \(>= -1e7, <= 1e7\)", "", describe_type(field.type)
    )
    text = re.sub(r"\((>=?) (\S+), (<=?) (\S+)\)", lambda found: _describe_range(*found.groups()), text)
    text = re.sub(r"\(<= (\S+)\)", r"to \1", text).replace("e-0", "e-").replace('" or "', '", "')
    text = text.replace("whole number", "integer").replace("list of lists", "lists")
    text = re.sub("^list of string$", "strings", text).replace("list of ", "")
    text = re.sub(r"^number (?=\S)", "", text)  # a range shows it
    if is_shown:
        text = re.sub(r"^(true or false|string|(integer|\d? ?numbers?) ?)", "", text).removeprefix(", ")
    return text


def _describe_range(lower: str, least: str, upper: str, most: str) -> str:
    return f"{lower.strip('=') if lower == '>' else ''}{least}…{upper if upper == '<' else ''}{most}"


def _describe_default(field: FieldInfo, section: type[Section], key: str) -> str:
    if field.default is NODEFAULT:
        is_of_campaign = section is not Config and "." not in key
        return "required" if is_of_campaign else _DERIVED.get(key, "required")
    return "" if field.default is None else _format_value(msgspec.to_builtins(field.default))


def _format_value(value: object) -> str:
    """Return a value as TOML writes it."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_format_value(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_format_value, value)) + "]"
    return msgspec.json.encode(value).decode()


def campaign_page() -> str:
    """The page docs/campaign-keys.md, made from the types of the two kinds of campaign."""
    keys, flights = ("\n".join(tables(spec, "")).split("\n## ") for spec in (CampaignSpec, TrialSpec))
    known = {section.strip() for section in keys}
    flights = [section for section in flights if section.strip() not in known]
    return "\n".join((_CAMPAIGN, "\n## ".join(keys), _FLIGHTS, "\n## ".join(flights)))


def topics_page() -> str:
    """The page docs/topics.md, made from the rows."""
    lines, plots = [_TOPICS], list[str]()
    for topic in TOPICS:
        properties = msgspec.json.decode(get_definition(topic.name).schema)["properties"]
        fields = {name: _json_type(schema) for name, schema in properties.items()}
        lines += _describe_topic(topic.name, f"`{topic.record.__name__}`: {topic.text}.", fields)
    lines += [_VIEWS]
    for view in VIEWS:
        if issubclass(view.kind, Record):
            plotted = {field.name: (field.type.__name__, False) for field in msgspec.structs.fields(view.kind)}
            plots += _describe_topic(view.name, f"`{view.schema_name}`: {view.text}.", plotted)
        else:
            lines.append(f"| `{view.name}` | `{view.schema_name}` | {view.text} |")
    return "\n".join([*lines, "", *plots])


def _describe_topic(topic: str, text: str, fields: dict[str, tuple[str, bool]]) -> list[str]:
    """Return the section of a topic: its content, and the names of its fields by type."""
    names: dict[str, list[str]] = {}
    for name, (kind, is_optional) in fields.items():
        names.setdefault(kind, []).append(f"`{name}`{'?' if is_optional else ''}")
    groups = "; ".join(f"{kind} {', '.join(group)}" for kind, group in names.items())
    return [f"## `{topic}`", "", *wrap(text, 120), "", *wrap(f"Fields: {groups}.", 120), ""]


def _json_type(schema: dict[str, object]) -> tuple[str, bool]:
    """Return one field's type in words, and whether it may be null."""
    if "$ref" in schema:
        return f"`{cast('str', schema['$ref']).rpartition('/')[2]}`", False
    if "anyOf" in schema:
        kinds = [_json_type(one)[0] for one in cast("list[dict[str, object]]", schema["anyOf"])]
        return " or ".join(kind for kind in kinds if kind != "null"), "null" in kinds
    kind = cast("str", schema.get("type", "any"))
    if kind == "array":
        return f"{_json_type(_items(schema))[0]}[]", False
    if kind == "object" and isinstance(schema.get("additionalProperties"), dict):
        return f"object of {_json_type(cast('dict[str, object]', schema['additionalProperties']))[0]}", False
    return kind, False


def _items(schema: dict[str, object]) -> dict[str, object]:
    fixed = cast("list[dict[str, object]]", schema.get("prefixItems", []))
    return fixed[0] if fixed else cast("dict[str, object]", schema["items"])


_STATES = {
    HandoverState.WAITING: "no vehicle is heard",
    HandoverState.READY: "a vehicle is heard; the pilot may switch",
    HandoverState.MODE: "take-off ordered: the mode is requested",
    HandoverState.ARMING: "arming is requested",
    HandoverState.CLIMBING: "the vehicle climbs by itself",
    HandoverState.ENGAGING: "at height: OFFBOARD or GUIDED is requested",
    HandoverState.RETURNING: "the same after `TAKEN_OVER`, by `ctl engage`",
    HandoverState.ENGAGED: "the controller flies",
    HandoverState.FAILSAFE: "a failsafe of the vehicle flies; nothing is sent",
    HandoverState.UNCLEAR: "another mode for an unknown reason; nothing is sent",
    HandoverState.TAKEN_OVER: "another pilot flies; nothing is sent without an order",
    HandoverState.LANDING: "landing is requested",
    HandoverState.SETTLING: "the vehicle lands by itself",
    HandoverState.DONE: "disarmed",
    HandoverState.FAILED: "the vehicle has not carried out a request",
}
_EVENTS = {
    HandoverEvent.REBOOT: "the vehicle has restarted",
    HandoverEvent.LAND: "the controller, or the operator during the climb, requests landing",
    HandoverEvent.UNSAFE: "in the climb: positions that jump, contradict inertial data or vehicle velocity, or are "
    "outside `[sets]` by more than `envelope.outside_m`; or none for a horizon",
    HandoverEvent.GRANTED: "the request has taken effect",
    HandoverEvent.REFUSED: "the vehicle refused for good, or did not react within `[hand_over]`; the event has its "
    "reason (COMMAND_ACK, STATUSTEXT); exit code 1",
    HandoverEvent.SILENCE: "no heartbeat, or the last one is too old",
    HandoverEvent.TAKE_OFF: "`--arm --takeoff HEIGHT`; nothing else leads to arming",
    HandoverEvent.ENGAGE: "`uavctl ctl engage`; nothing else leads back from the pilot",
    HandoverEvent.LEFT: "armed when first heard, and the daemon before ended unasked in flight "
    "([operation](operation.md#after-the-pilots-switch))",
    HandoverEvent.DISARMED: "disarmed",
    HandoverEvent.FAILSAFE: "a [failsafe of the vehicle](#failsafes-of-the-vehicle) acts",
    HandoverEvent.UNCLEAR: "another mode for an unknown reason",
    HandoverEvent.OTHER: "a person flies; or a failsafe on a flight that the pilot began",
    HandoverEvent.EXTERNAL: "armed, in OFFBOARD or GUIDED",
    HandoverEvent.PENDING: "the request has not taken effect yet",
}


def hand_over_page() -> str:
    """The page docs/hand-over.md, made from the table."""
    events = "\n".join(_wrap_item(f"* `{event}`: {_EVENTS[event]}") for event in HandoverEvent)
    return f"""# The hand-over between pilot and controller

This page lists the states between the pilot, the vehicle's own modes and the controller. `make docs` generates it from
`uavctl/mavlink/handover_states.py`.

Example: `uavctl fly --arm --takeoff 1.2` goes from `READY` through `MODE`, `ARMING`, `CLIMBING` and `ENGAGING` to
`ENGAGED`.

## States

Each state has its events with the next state. Any other event keeps the state.

{transitions_list()}
Setpoints are sent in `ENGAGED` only. Neutral setpoints (zero acceleration) are sent where PX4 needs a stream before
OFFBOARD: in `READY`, in the climb (not to ArduPilot, whose climb they would end) and in `RETURNING`. If heartbeats
of an engaged vehicle are missing, the controller brakes and holds, then sends nothing.

## Events

If several occur in a tick, the first of this list counts.

{events}

## Take-off

* PX4: AUTO.TAKEOFF, arming, OFFBOARD. The climb ends when positions show the height, not at MIS_TAKEOFF_ALT.
* ArduPilot: GUIDED, arming, MAV_CMD_NAV_TAKEOFF, setpoints. The climb ends at nine tenths of the height.

Positions further from inertial data than noise explains are not relayed, until for 3 s all agree.

## Failsafes of the vehicle

Evidence: system status CRITICAL, "failsafe" or "fence breached" in a text, FENCE_STATUS or SYS_STATUS. In addition
the mode must be one that failsafes choose ({_modes(ModeChoice.EITHER)}), or one that nothing else chooses
({_modes(ModeChoice.FAILSAFE)}).

A flight that the pilot began releases the vehicle. A flight with `--arm` reacts:

* The failsafe ends in the climb: continue the climb, within `climb_s`.
* The failsafe lands: wait for `land_s`.
* It hovers, or has ended an engaged flight: request landing after `climb_s`, unless `uavctl ctl engage` comes first.

## Another mode

* `other`: the person flies. Evidence: a stick or switch moved (RC_CHANNELS, a tenth of its way), or a ground station
  ordered the mode. Without RC_CHANNELS a mode that only a person chooses is evidence, too.
* `other`, because a failsafe explains the mode, and no stick moved ({_degrades()}): the same; exit code 1.
* `unclear`, without such evidence: after our take-off, landing is requested after `climb_s`, unless a stick moves. Exit
  code 1.

In each case nothing is sent. The pilot's switch counts once a heartbeat shows it:

* A request for the external mode or for landing is repeated only right after a heartbeat, so that a switch shows
  first.
* The first request at the end of a climb, and that for landing, do not wait. After a switch in that second the pilot
  must switch again.
* A COMMAND_ACK counts before the next heartbeat. A heartbeat that still shows another mode 0.3 s later is the
  pilot's switch.

## Landing

Once the vehicle shows that it lands, another mode is the pilot's (the previous mode only after 2 s). A vehicle that we
took off is asked to land while it is heard armed, up to ten times `land_s`.
"""


def _modes(choice: ModeChoice) -> str:
    """The modes that such a one can have chosen, by autopilot."""
    chosen = {
        name: sorted(mode for mode, by in profile.mode_choices.items() if by is choice)
        for name, profile in PROFILES.items()
    }
    return "; ".join(f"{name}: {', '.join(modes)}" for name, modes in chosen.items())


def _degrades() -> str:
    """The modes of a person that a failsafe chooses as well, by autopilot; those that end in a number as one."""
    names = {
        name: sorted({re.sub(r"\d+$", "1 and so on", mode) for mode in profile.degraded_modes})
        for name, profile in PROFILES.items()
    }
    return "; ".join(f"{name}: {', '.join(modes)}" for name, modes in names.items())


def transitions_list() -> str:
    """Every way from one state to another as a Markdown list, by event."""
    lines = []
    for before in HandoverState:
        ways: dict[HandoverState, list[str]] = {}
        for event in HandoverEvent:
            after = TRANSITIONS[before, event][0]
            if after is not before:
                ways.setdefault(after, []).append(f"`{event}`")
        cells = "; ".join(f"{', '.join(events)}: {after.name}" for after, events in ways.items())
        lines.append(_wrap_item(f"* **`{before.name}`**: {_STATES[before]}. {cells or 'End'}."))
    return "\n".join(lines) + "\n"


_MANUAL = """.SH EXIT STATUS
0 good; 1 ran, but failed its purpose; 2 usage or configuration; 3 recovered with loss; 4 \\fBtune\\fR: the pilot has
taken over; 130 interrupted.
.SH FILES
.TP
.I flights/
recordings, unless \\-\\-out names another folder
.SH ENVIRONMENT
.TP
.B UAVCTL_CONTROL
folder of the socket by which \\fBuavctl ctl\\fR reaches a flight
.SH SEE ALSO
\\fBuavctl docs\\fR lists the pages of the manual, and shows them.
""".replace("\\\\", "\\")


def man_page() -> str:
    """The manual page docs/uavctl.1, made from the commands and their options."""
    told = app.generate_docs(output_format="markdown", recursive=True)
    _, _, commands = told.partition("**Commands**")
    lines = [
        '.TH UAVCTL 1 "" "uavctl" "User Commands"',
        ".SH NAME",
        "uavctl \\- stochastic model predictive flight control shaped by the age of information, over MAVLink",
        ".SH SYNOPSIS",
        ".B uavctl",
        "COMMAND [OPTIONS]",
        ".SH COMMANDS",
    ]
    for line in commands.splitlines()[1:]:
        item = re.fullmatch(r"\* (?:\[?`(.+?)`(?:\]\(.*?\))?)(?:: (.*))?", line)
        if line.startswith("#"):
            title = _roff(line.lstrip("# "))
            lines.append(f".SH {title.upper()}" if line.startswith("## ") else f".SS {title}")
        elif item is not None:
            lines += [".TP", f".B {_roff(item[1])}", _roff(item[2] or "")]
        elif line and not line.startswith(("```", "**")):
            lines += [".PP", _roff(line)]
    return "\n".join(lines) + "\n" + _MANUAL


def _roff(text: str) -> str:
    """Return Markdown text as roff: without marks, and with what roff would take as its own escaped."""
    plain = re.sub(r"\*\[(.*?)\]\*", r"[\1]", text.replace("`", "").replace("**", ""))
    plain = plain.replace("\\", "\\e").replace("-", "\\-")
    return f"\\&{plain}" if plain.startswith((".", "'")) else plain


PAGES: dict[Path, Callable[[], str]] = {
    ROOT / "docs" / "configuration.md": configuration_page,
    ROOT / "docs" / "campaign-keys.md": campaign_page,
    ROOT / "docs" / "topics.md": topics_page,
    ROOT / "docs" / "hand-over.md": hand_over_page,
    ROOT / "docs" / "uavctl.1": man_page,
}

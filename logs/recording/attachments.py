"""Attachments and metadata of a recording, for other programs.

All of it follows from the messages, so that it is written anew for each file and by a recovery, and nothing is decided
or replayed from it.
"""

from __future__ import annotations

from functools import cache
from importlib import resources

import msgspec
from mcap.records import Attachment, Metadata

from logs.recording.parameters import ParameterReader, count_parameters, make_parameter_file
from uavctl.config.load import flatten_keys, parse_stored_toml
from uavctl.errors import ConfigError
from uavctl.records import Header

CONFIG, LAYOUT, PARAMETERS = "config.toml", "foxglove-layout.json", "vehicle.params"
_ORIGIN, _CONFIG, _VERSIONS = "uavctl", "configuration", "versions"
_VALUES, _TYPES, _LIST = "vehicle parameters", "vehicle parameter types", "vehicle parameter list"


@cache
def make_layout_text() -> str:
    """Return the layout for Foxglove."""
    return resources.files("logs").joinpath("foxglove-layout.json").read_text(encoding="utf-8")


def make_header_attachments(header: Header, utc_ns: int) -> tuple[Attachment | Metadata, ...]:
    """Return the parts of a header for other programs: configuration, versions, origin.

    Args:
        utc_ns: log time of the header [ns].
    """
    origin = {
        key: str(getattr(header, key))
        for key in Header.__struct_fields__
        if key not in ("config_toml", "design", "versions") and getattr(header, key) is not None
    }
    return (
        _make_file(CONFIG, "application/toml", header.config_toml, utc_ns),
        Metadata(_ORIGIN, origin),
        Metadata(_VERSIONS, header.versions),
        Metadata(_CONFIG, _flatten(header.config_toml)),
    )


def make_layout_attachment(utc_ns: int) -> tuple[Attachment, ...]:
    """Return the layout for Foxglove as an attachment."""
    return (_make_file(LAYOUT, "application/json", make_layout_text(), utc_ns),)


def make_parameter_attachments(reader: ParameterReader, utc_ns: int) -> tuple[Attachment | Metadata, ...]:
    """Return the vehicle's parameters for other programs; nothing if it told none."""
    parameters, count = reader.parameters(), reader.count
    if not parameters:
        return ()
    received_count = count_parameters(parameters)
    is_complete = "unknown" if count is None else str(received_count >= count).lower()
    return (
        _make_file(PARAMETERS, "text/tab-separated-values", make_parameter_file(parameters, count), utc_ns),
        Metadata(_LIST, {"told": str(received_count), "of": str(count or "unknown"), "complete": is_complete}),
        Metadata(_VALUES, {name: str(parameter.value) for name, parameter in parameters.items()}),
        Metadata(_TYPES, {name: parameter.type for name, parameter in parameters.items()}),
    )


def _make_file(name: str, media_type: str, text: str, utc_ns: int) -> Attachment:
    return Attachment(create_time=utc_ns, log_time=utc_ns, name=name, media_type=media_type, data=text.encode())


def _flatten(text: str) -> dict[str, str]:
    """Return a configuration by dotted names, its values as JSON; nothing if it is damaged."""
    try:
        return {key: _format_value(value) for key, value in flatten_keys(parse_stored_toml(text, "configuration"))}
    except ConfigError:
        return {}


def _format_value(value: object) -> str:
    return str(value) if isinstance(value, str | float) else msgspec.json.encode(value).decode()

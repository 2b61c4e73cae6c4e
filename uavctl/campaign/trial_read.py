"""The file of a campaign in the world of the quadrotor in, its specification out; all problems at once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import cast

import msgspec

from uavctl.campaign.compose import CONFIGURATION, Told, placed
from uavctl.campaign.read import text_of
from uavctl.campaign.spec import MOST_CELLS
from uavctl.campaign.trial_spec import QUADROTOR, TrialSpec
from uavctl.config import Source, dump_config, load, parse, presets
from uavctl.config.bounds import oversized
from uavctl.config.index import key_lines
from uavctl.config.load import decode, parse_toml
from uavctl.config.problem import Problem
from uavctl.errors import ConfigError


def is_trial(path: Path) -> bool:
    """Whether a campaign's file is of flights of the quadrotor.

    Raises:
        ConfigError: It cannot be read.
    """
    return parse_toml(text_of(path), str(path)).get("world") == QUADROTOR


def read_trial(path: Path, runs: int | None = None) -> tuple[TrialSpec, str]:
    """The specification of a file, with another number of runs if one is given, and the file's text.

    Its `config` is as `load_config` takes it.

    Raises:
        ConfigError: With all problems found, one a line: place, key, reason, what to do.
    """
    text = text_of(path)
    table = parse_toml(text, str(path))
    source = Source(str(path), key_lines(text))
    found: list[Problem] = []
    told = Told(source)
    told.tell(oversized(table))
    if told.problems:
        raise ConfigError(told.problems)
    spec = cast("TrialSpec | None", decode(TrialSpec, table, "", found, {}))
    told.tell(found)
    if spec is None:
        raise ConfigError(told.problems)
    name = spec.config if spec.config in presets() else str(path.parent / spec.config)
    spec = msgspec.structs.replace(spec, config=name, runs=spec.runs if runs is None else runs)
    told.tell(_wrong(spec))
    base = told.load(lambda overrides: load(name, overrides).config, placed("set", spec.set))
    if base is not None:
        written = dump_config(base)
        of_controllers = [placed(f"controller[{i}].set", one.set) for i, one in enumerate(spec.controller)]
        of_links = [placed(f"link[{i}].set", one.set) for i, one in enumerate(spec.link)]
        for each in (*of_controllers, *of_links):
            told.load(lambda overrides: parse(written, CONFIGURATION, overrides).config, each)
    if told.problems:
        raise ConfigError(told.problems)
    return spec, text


def _wrong(spec: TrialSpec) -> Iterator[Problem]:
    for key, names in (
        ("controller", [one.name for one in spec.controller]),
        ("link", [one.name for one in spec.link]),
    ):
        for i, name in enumerate(names):
            if name in names[:i]:
                yield Problem(f"{key}[{i}].name", f'"{name}" is there twice', "give each a name of its own")
    for i, one in enumerate(spec.controller):
        if one.kind == "own-loop" and (one.set or one.link != "true"):
            yield Problem(f"controller[{i}]", "the vehicle's own loop has no design", "leave out `set` and `link`")
        if one.kind == "smpc" and one.tuned:
            yield Problem(f"controller[{i}].tuned", "is of the vehicle's own loop", "leave it out")
    for i, link in enumerate(spec.link):
        for j, text in enumerate(link.set):
            if not text.startswith("link."):
                yield Problem(f"link[{i}].set[{j}]", f'"{text}" is no key of [link]', "give overrides of [link] alone")
    if spec.from_s >= spec.seconds:
        yield Problem("from_s", f"{spec.from_s:g} s is not within the flight", "give less than `seconds`")
    cells = len(spec.scenario) * len(spec.autopilot) * len(spec.rate_hz) * len(spec.air)
    cells *= len(spec.controller) * len(spec.link)
    if cells > MOST_CELLS:
        yield Problem("controller", f"there are {cells} cells", f"at most {MOST_CELLS} are flown; take fewer of them")

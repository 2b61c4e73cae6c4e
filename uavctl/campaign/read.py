"""A campaign's file in, its specification out, with every configuration that it asks for; all problems at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import cast

import msgspec
import numpy as np

from uavctl.campaign.compose import Campaign, Told, compose, flown, placed
from uavctl.campaign.spec import CHUNK, MOST_CELLS, MOST_DESIGNS, MOST_STEPS_AT_ONCE, TRUE, CampaignSpec
from uavctl.config import Config, Source, dump_config, load, presets
from uavctl.config.bounds import oversized
from uavctl.config.checks import dimensions
from uavctl.config.data_file import DataFileError, read_text
from uavctl.config.index import key_lines
from uavctl.config.load import decode, find_nearest, parse_toml
from uavctl.config.mission import MissionConfig
from uavctl.config.problem import Problem
from uavctl.errors import ConfigError


def read_campaign(path: Path, runs: int | None = None) -> tuple[Campaign, str]:
    """The campaign of a file, with another number of runs if one is given, and the file's text.

    Raises:
        ConfigError: With all problems found, one a line: place, key, reason, what to do.
    """
    text = text_of(path)
    table = parse_toml(text, str(path))  # refuses what is too deep to be gone through
    source = Source(str(path), key_lines(text))
    found: list[Problem] = []
    told = Told(source)
    told.tell(oversized(table))
    if told.problems:
        raise ConfigError(told.problems)
    spec = cast("CampaignSpec | None", decode(CampaignSpec, table, "", found, {}))
    told.tell(found)
    if spec is None:
        raise ConfigError(told.problems)
    spec = spec if runs is None else msgspec.structs.replace(spec, runs=runs)
    told.tell(_sizes(spec))
    if told.problems:  # the rest is work for each of them
        raise ConfigError(told.problems)
    told.tell(_names(spec))
    name = spec.config if spec.config in presets() else str(path.parent / spec.config)
    base = told.load(lambda overrides: load(name, overrides).config, placed("set", spec.set))
    if base is None:
        raise ConfigError(told.problems)
    told.tell(flown(base, placed("set", spec.set), "config"))
    told.tell(_starts(spec, base))
    base = msgspec.structs.replace(base, mission=MissionConfig(), fence=())  # runs go to the target, and nowhere else
    return compose(spec, dump_config(base), told), text


def text_of(path: Path) -> str:
    """The text of a campaign's file.

    Raises:
        ConfigError: It cannot be read.
    """
    try:
        return read_text(path)
    except DataFileError as error:
        raise ConfigError(tuple(f"{reason}; give the TOML file of a campaign" for reason in error.reasons)) from error


def _sizes(spec: CampaignSpec) -> Iterator[Problem]:
    """More than can be designed in minutes, or held in memory."""
    together = min(spec.runs, CHUNK)
    if spec.steps * together > MOST_STEPS_AT_ONCE:
        reason = f"{spec.steps} steps of {together} runs are flown at once"
        yield Problem("steps", reason, f"give so few that they are {MOST_STEPS_AT_ONCE} in all, or fewer runs")
    designs = len(spec.controller) * len(spec.link)
    if designs > MOST_DESIGNS:
        yield Problem("controller", f"with the links there are {designs} designs", f"take fewer, {MOST_DESIGNS} in all")
    cells = designs * len(spec.disturbance) * len(spec.plant)
    if cells > MOST_CELLS:
        reason = f"with links, disturbances and plants there are {cells} cells"
        yield Problem("controller", reason, f"at most {MOST_CELLS} are flown; take fewer of them")


def _names(spec: CampaignSpec) -> Iterator[Problem]:
    """Names that are taken twice, or that name nothing."""
    controllers, links = [one.name for one in spec.controller], [one.name for one in spec.link]
    lists = {
        "controller": controllers,
        "link": links,
        "disturbance": [one.name for one in spec.disturbance],
        "plant": [one.name for one in spec.plant],
    }
    for key, names in lists.items():
        if not names:
            yield Problem(key, "is empty: there is nothing to fly", f"add a [[{key}]]")
        for i, name in enumerate(names):
            if name in names[:i]:
                yield Problem(f"{key}[{i}].name", f'"{name}" is there twice', "give each a name of its own")
    if TRUE in links:
        place = f"link[{links.index(TRUE)}].name"
        yield Problem(place, f'"{TRUE}" means the link that is flown on', "give it another name")
    for i, one in enumerate(spec.controller):
        yield from _known(f"controller[{i}].link", one.link, [TRUE, *links], "link")
    for i, tuning in enumerate(spec.tuning):
        for j, name in enumerate(tuning.controllers):
            yield from _known(f"tuning[{i}].controllers[{j}]", name, controllers, "controller")
        for j, name in enumerate(tuning.links):
            yield from _known(f"tuning[{i}].links[{j}]", name, links, "link")
    for i, disturbance in enumerate(spec.disturbance):
        if disturbance.memory and disturbance.kind != "gusts":
            yield Problem(
                f"disturbance[{i}].memory", f'has no meaning with kind "{disturbance.kind}"', "remove it, or take gusts"
            )


def _known(key: str, name: str, names: Sequence[str], what: str) -> Iterator[Problem]:
    if name not in names:
        yield Problem(key, f'there is no {what} "{name}"{find_nearest(name, names)}', f"give one of {', '.join(names)}")


def _starts(spec: CampaignSpec, base: Config) -> Iterator[Problem]:
    n_x, _ = dimensions(base.plant)
    if spec.start and spec.start_box:
        yield Problem("start_box", "there is a start too", "give one of them")
    if spec.start and len(spec.start) != n_x:
        yield Problem("start", f"has {len(spec.start)} entries, n_x = {n_x}", f"give {n_x} numbers")
    if spec.start_box:
        if [len(row) for row in spec.start_box] != [n_x, n_x]:
            yield Problem("start_box", f"is not 2 rows of n_x = {n_x} numbers", "give [lower, upper]")
        elif (np.array(spec.start_box[0]) > np.array(spec.start_box[1])).any():
            yield Problem("start_box", "a lower limit is above the upper one", "give [lower, upper]")

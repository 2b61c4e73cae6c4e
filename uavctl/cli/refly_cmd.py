"""One run of a campaign flown again in virtual time, recorded and reported like any flight."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
from rich.console import Group, RenderableType
from rich.text import Text

from logs.reader import records
from logs.summary import FlightSummary, count, render
from uavctl.build import design_of
from uavctl.campaign.again import again
from uavctl.campaign.refly import Agreement, Reflight, agreement, reflight
from uavctl.campaign.results import read_cells
from uavctl.campaign.trial_results import told_trial
from uavctl.campaign.verdict import SMPC
from uavctl.cli.engagement import Engagement
from uavctl.cli.flying import new_recording
from uavctl.cli.loopback_cmd import lockstep
from uavctl.cli.prepare import prepare, ready_library
from uavctl.data import Truth
from uavctl.errors import UsageError


class Reflown(msgspec.Struct, frozen=True, kw_only=True):
    """A run of a campaign as a flight."""

    summary: FlightSummary
    agreement: Agreement


def refly(folder: Path, which: str, out: Path | None) -> Reflown:
    """Fly a run of a campaign again; the recording and its page go to `out`.

    Args:
        folder: Of the campaign.
        which: The run, as CELL:RUN.
        out: Folder; a new one below `flights/` if it is not given.

    Raises:
        UsageError: There is no such run, or it is a baseline's.
        UavctlError: The campaign cannot be read, or this version would make another design of it.
    """
    cell, run = _numbers(which)
    if told_trial(folder) is not None:
        raise UsageError(
            f"{folder} holds flights of the quadrotor; fly one again by `uavctl loopback` with its configuration, "
            "sim.plant = quadrotor and sim.seed as in runs.parquet"
        )
    _check_kind(folder, cell)
    found = again(folder, cell, run, ready_library)
    return fly_again(reflight(found, f"{found.campaign}, cell {cell}, run {run}"), out)


def fly_again(flight: Reflight, out: Path | None) -> Reflown:
    """Fly a run, record it and compare it with what the campaign flew."""
    config = flight.config
    as_flown = Engagement(config, take_off_m=None, goto=False)
    with new_recording(out, "refly", config.log.free_bytes) as path:
        summary = lockstep(prepare(config, design_of(config)), path, as_flown, flight.script)
        return Reflown(summary=summary, agreement=agreement(flight, list(records(path, Truth))))


def picture(reflown: Reflown) -> RenderableType:
    """The flight's summary, and how well it agrees."""
    one = reflown.agreement
    text = (
        f"Beside the campaign, over {count(one.steps, 'step')} of plans: states within {one.largest_state:.1e}, "
        f"inputs within {one.largest_input:.1e}; {'agrees' if one.agrees else 'differs'} (to {one.tolerance:g})"
    )
    return Group(render(reflown.summary), Text(f"{text}{': ' if one.reason else ''}{one.reason}"))


def _numbers(which: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+):(\d+)", which)
    if found is None:
        raise UsageError(f"--refly {which}: names no run; give CELL:RUN, as in 0:17")
    return int(found[1]), int(found[2])


def _check_kind(folder: Path, index: int) -> None:
    cells = [cell for cell in read_cells(folder) if cell.index == index]
    if cells and cells[0].kind != SMPC:
        raise UsageError(
            f"cell {index} is flown by {cells[0].controller} ({cells[0].kind}), a baseline without a flight "
            "controller; runs of an SMPC can be flown again"
        )

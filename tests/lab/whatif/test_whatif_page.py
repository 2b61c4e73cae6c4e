"""The page of a what-if draws the limits, the reserve kept from them and the horizon, as the report does."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from report_rig import collect_figures, data
from synthetic_scene import room
from text_numbers import find_numbers

from logs.recording.flight import FlightData
from logs.recording.summary import FlightSummary, summarise
from logs.report.plots import DISPLAY_AXES
from logs.report.svg import colour
from uavctl.lab.whatif.comparison import (
    ModelFit,
    Reproduction,
    WhatIf,
    describe_what_if,
    make_comparison_rows,
    render_what_if_page,
)


@pytest.fixture(scope="module")
def recorded() -> FlightData:
    return data(room(), 6.0)


@pytest.fixture(scope="module")
def other(recorded: FlightData) -> FlightData:
    """A flight with a shorter horizon and a nearer wall in the north."""
    design = recorded.design
    b_x = list(design.b_x)
    b_x[design.state_box.row_upper[design.position_index[0]]] -= 0.25
    nearer = msgspec.structs.replace(design, b_x=tuple(b_x), horizon=7)
    return dataclasses.replace(recorded, design=nearer)


def figures(recorded: FlightData, other: FlightData) -> tuple[dict[str, Axes], str]:
    """The page's axes by their titles, and its text."""
    summary = summarise(recorded, wall_s=None)
    with collect_figures() as drawings:
        text = render_what_if_page(worse_link(summary), recorded, other)
    return {title: figure.axes[0] for title, figure in drawings.items()}, text


def worse_link(summary: FlightSummary) -> WhatIf:
    """A what-if over a link that loses more, with no key changed; the same figures on every side."""
    return WhatIf(
        flight="flight.mcap",
        reproduction=Reproduction(identical=True, decisions=1, largest_state=0.0, largest_input=0.0),
        model=ModelFit(source="the recording's [plant]", ahead_s=1.0, moves=0, r2=None, rms_m=None),
        controller="smpc",
        link="loss=0.5",
        changed=(),
        compared_s=6.0,
        ended="the recording ends",
        largest_departure_m=0.0,
        recorded=summary,
        reproduced=summary,
        what_if=summary,
        recording="",
        report="",
        page="",
    )


def levels(ax: Axes, role: str = "limit") -> list[float]:
    """Heights of the horizontal lines in the colour of a role."""
    lines = [line for line in ax.lines if to_hex(line.get_color()) == to_hex(colour(role))]
    return sorted(float(np.asarray(line.get_ydata())[0]) for line in lines)


def test_limits_are_those_of_the_what_if(recorded: FlightData, other: FlightData) -> None:
    axes, _ = figures(recorded, other)
    box = other.design.state_box
    for name, index in zip(other.design.axes, other.design.position_index, strict=True):
        title, sign = DISPLAY_AXES[name]
        wanted = sorted(sign * side for side in (box.lower[index], box.upper[index]))
        assert levels(axes[title.capitalize()]) == pytest.approx(wanted)
    first = other.design.position_index[0]
    assert box.upper[first] == pytest.approx(recorded.design.state_box.upper[first] - 0.25)


def test_the_reserve_is_the_largest_of_each_plan(recorded: FlightData, other: FlightData) -> None:
    axes, _ = figures(recorded, other)
    design = other.design
    for name, index in zip(design.axes, design.position_index, strict=True):
        title, sign = DISPLAY_AXES[name]
        row = (design.state_box.row_upper if sign > 0 else design.state_box.row_lower)[index]
        limit = max(sign * side for side in (design.state_box.lower[index], design.state_box.upper[index]))
        scale = abs(design.c_x[row][index])
        drawings = [max(stage[row] for stage in plan.backoff_x) / scale for plan in other.flown_plans.values()]
        edges = [band.get_paths()[0].get_extents() for band in axes[title.capitalize()].collections]
        assert len(edges) == 2
        above = max(edges, key=lambda edge: edge.y1)
        assert above.y1 == pytest.approx(limit)
        assert above.y0 == pytest.approx(limit - max(drawings))


def test_another_link_is_listed_as_a_change(recorded: FlightData) -> None:
    summary = summarise(recorded, wall_s=None)
    (sentence,) = (text for text in describe_what_if(worse_link(summary)) if "link: loss=0.5" in text)
    assert "nothing" not in sentence


def test_a_comparison_that_ends_early_tells_it_in_each_column(recorded: FlightData) -> None:
    whole = worse_link(summarise(recorded, wall_s=None))
    cut = msgspec.structs.replace(whole, compared_s=4.25, ended="the pilot has taken over")
    rows = [{name: columns for name, *columns in make_comparison_rows(what_if)} for what_if in (whole, cut)]
    changed = {name for name in rows[0] if rows[0][name] != rows[1][name]}
    assert len(rows[0]) == len(rows[1]) and len(changed) == 1
    (columns,) = (rows[1][name] for name in changed)
    assert all(find_numbers(text) == [4.2] and cut.ended in text for text in columns)


def test_the_age_is_drawn_against_the_horizon(recorded: FlightData, other: FlightData) -> None:
    axes, text = figures(recorded, other)
    assert levels(axes["Age of information"], "muted") == sorted([7.0, recorded.design.horizon])
    assert "H = 7 steps" in text

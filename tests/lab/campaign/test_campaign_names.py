"""Names in a campaign's figures lie within the figure, beside its axes, and not on each other."""

from __future__ import annotations

import re
from dataclasses import dataclass
from html import unescape
from itertools import pairwise

import pytest
from campaign_results import cell, runs, summarise, write
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath

from logs.report.svg import Drawing
from uavctl.lab.campaign import plots
from uavctl.lab.campaign.plots import ControllerStyles
from uavctl.lab.campaign.results import read_results
from uavctl.lab.campaign.verdicts import group_cells, make_verdicts

LINKS = (
    "30 %",
    "bursts of 2.5 s, then recovery",
    "Gilbert-Elliott, 40 % in bursts of a second",
    "empirical WLAN trace of a laboratory at noon",
    "blackoutwithoutanyspace",
)
CONTROLLERS = ("SMPC with a fixed schedule of four and a risk of one in ten", "packetised predictive control")
_WIDEST = FontProperties(family="DejaVu Sans")  # of the fonts that browsers take for the page's
_ROOM = 0.5  # of rounding, in the figure's units
_NUMBER = r"(-?[\d.]+)"


@dataclass(frozen=True)
class Box:
    """Where a line of text is drawn, x to the right and y down, in the figure's units."""

    text: str
    left: float
    right: float
    top: float
    bottom: float


def boxes(svg: str) -> list[Box]:
    """Every line of text of a figure, by the glyphs of the widest font."""
    verdicts = []
    for attributes, content in re.findall(r"<text ([^>]*)>([^<]*)</text>", svg):
        text = unescape(content)
        size = float(re.findall(rf"font-size: {_NUMBER}px", attributes)[0])
        moved = re.search(rf"translate\({_NUMBER} {_NUMBER}\)", attributes)
        at = moved.groups() if moved else re.findall(rf'\b[xy]="{_NUMBER}"', attributes)
        x, y = map(float, at)
        extent = TextPath((0.0, 0.0), text, size=size, prop=_WIDEST).get_extents()
        width = extent.x1
        anchor = re.search(r"text-anchor: (\w+)", attributes)
        shift = {"middle": 0.5, "end": 1.0}.get(anchor[1] if anchor else "start", 0.0)
        verdicts.append(Box(text, x - shift * width, x + (1.0 - shift) * width, y - extent.y1, y - extent.y0))
    return verdicts


def size_of(svg: str) -> tuple[float, float]:
    """Width and height of a figure."""
    ((width, height),) = re.findall(rf'viewBox="0 0 {_NUMBER} {_NUMBER}"', svg)
    return float(width), float(height)


@pytest.fixture(scope="module")
def drawings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Drawing]:
    """A figure of costs by link, and one of differences."""
    cells, rows = [], []
    for place, link in enumerate(LINKS):
        for index, controller in enumerate(CONTROLLERS):
            cells.append(cell(2 * place + index, controller, "lqg" if index else "smpc", link=link))
            rows += runs(2 * place + index, [100.0 + index, 110.0, 105.0])
    folder = write(tmp_path_factory.mktemp("names"), cells, rows)
    summaries, looks = summarise(folder), ControllerStyles(CONTROLLERS)
    verdicts = list(make_verdicts(read_results(folder), group_cells(summaries)))
    (difference,) = plots.draw_differences(verdicts, looks, f"Beside {CONTROLLERS[0]}", "0")
    return {"cost": next(plots.draw_quantities(summaries, {}, looks, "0")), "difference": difference}


def names_of(svg: str) -> list[list[Box]]:
    """Lines of each link's name, in the order of the rows."""
    ticks = re.findall(r'<g id="[^"]*ytick_\d+">(.*?</text>)\s*</g>\s*</g>', svg, re.DOTALL)
    return [boxes(tick) for tick in ticks]


@pytest.mark.parametrize("figure", ["cost", "difference"])
def test_every_text_is_within_the_figure(figure: str, drawings: dict[str, Drawing]) -> None:
    svg = drawings[figure].svg
    width, height = size_of(svg)
    for box in boxes(svg):
        assert box.left >= -_ROOM and box.right <= width + _ROOM, box
        assert box.top >= -_ROOM and box.bottom <= height + _ROOM, box


@pytest.mark.parametrize("figure", ["cost", "difference"])
def test_names_of_links_are_complete_and_beside_the_axes(figure: str, drawings: dict[str, Drawing]) -> None:
    svg = drawings[figure].svg
    names = names_of(svg)
    assert ["".join(line.text for line in name).replace(" ", "") for name in names] == [
        link.replace(" ", "") for link in LINKS
    ]
    axis = min(float(x) for x in re.findall(rf'<g id="[^"]*ytick_1">.*?<use [^>]*x="{_NUMBER}"', svg, re.DOTALL))
    assert all(line.right <= axis for name in names for line in name)


@pytest.mark.parametrize("figure", ["cost", "difference"])
def test_names_of_links_do_not_overlap(figure: str, drawings: dict[str, Drawing]) -> None:
    names = names_of(drawings[figure].svg)
    lines = [line for name in names for line in name]
    assert all(below.top >= above.bottom for above, below in pairwise(lines))

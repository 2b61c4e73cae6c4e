"""Figures of `uavctl paper`: valid SVG with what the paper's have, at the right places."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from uavctl.build.controller import build_design
from uavctl.config import load_config
from uavctl.lab.paper.figures import AgeReference, PictureFrame, ages_svg, decades, ticks, trajectories_svg
from uavctl.smpc.hahn_stursberg.design import Design

Array = NDArray[np.float64]
SVG = "{http://www.w3.org/2000/svg}"
LINK = AgeReference(tau=4, horizon=12, loss=0.3)


@pytest.fixture(scope="module")
def design() -> Design:
    return build_design(load_config("paper"))


def of_class(root: ElementTree.Element, name: str) -> list[ElementTree.Element]:
    return [one for one in root.iter() if one.get("class") == name]


def points_of(path: ElementTree.Element) -> Array:
    numbers = [float(number) for number in re.findall(r"-?[\d.]+", path.get("d", ""))]
    return np.array(numbers).reshape(-1, 2)


def states(runs: int) -> Array:
    walk = np.random.default_rng(0).normal(size=(runs, 51, 4)).cumsum(axis=1) * 0.1
    walk[:, 0] = [35.0, -2.0, -20.0, -4.0]
    return walk


def test_trajectories_show_box_ellipsoid_start_and_every_run(design: Design) -> None:
    root = ElementTree.fromstring(trajectories_svg(states(7), design))
    assert root.tag == f"{SVG}svg"
    assert "7 runs" in (root.findtext(f"{SVG}title") or "")
    groups = of_class(root, "runs")
    assert [len(group) for group in groups] == [7, 7, 7]  # both axes, and the positions
    assert len({path.get("stroke") for path in groups[0]}) == 7
    assert all(len(points_of(path)) == 51 for group in groups for path in group)
    assert len(of_class(root, "terminal-set")) == 3
    assert len(of_class(root, "start")) == 4  # one of them in the key
    words = {one.text for one in root.iter(f"{SVG}text")}
    assert {"p_x", "v_x", "p_y", "v_y", "admissible states", "initial state"} <= words


def test_box_start_and_ellipse_are_to_scale(design: Design) -> None:
    root = ElementTree.fromstring(trajectories_svg(states(3), design))
    (box,) = (one for one in root.iter() if one.get("id") == "box-0-1")
    corners = points_of(box)
    (left, top), (right, bottom) = corners.min(axis=0), corners.max(axis=0)
    per_m, per_mps = (right - left) / 80.0, (bottom - top) / 15.0  # -30 … 50 m, -8 … 7 m/s
    start = of_class(root, "start")[0]
    assert float(start.get("x", "")) + 5 == pytest.approx(left + 65.0 * per_m, abs=0.2)
    assert float(start.get("y", "")) + 5 == pytest.approx(top + 9.0 * per_mps, abs=0.2)
    size = np.ptp(points_of(of_class(root, "terminal-set")[0]), axis=0) / 2
    half_widths = np.sqrt(chi2.ppf(0.95, 4) * np.diagonal(design.terminal.sigma_x)[:2])
    assert size / [per_m, per_mps] == pytest.approx(half_widths, rel=0.01)
    assert half_widths == pytest.approx([15.64, 5.13], abs=0.01)  # as calculated beside the paper


def test_the_largest_picture_stays_small_and_is_always_the_same(design: Design) -> None:
    many = states(200)
    svg = trajectories_svg(many, design)
    assert len(svg.encode()) < 1_000_000
    assert svg == trajectories_svg(many, design)


def test_ages_are_stacked_to_all_runs_in_each_step() -> None:
    ages = np.zeros((30, 30), dtype=np.intp)
    ages[:, 0] = 70
    ages[:, 1] = 30
    ages[0, :2] = [100, 0]
    ages[7, :8] = [60, 20, 10, 4, 3, 1, 1, 1]
    root = ElementTree.fromstring(ages_svg(ages, LINK))
    layers = [points_of(path) for path in of_class(root, "age")]
    assert len(layers) == 6  # 0 … 4, 5 or more
    bottom, top = layers[0][:, 1].max(), layers[-1][:, 1].min()
    at = slice(14, 16)  # both corners of step 7 in the upper outline
    heights = [(bottom - layer[at, 1]) / (bottom - top) for layer in layers]
    assert [height[0] for height in heights] == pytest.approx([0.6, 0.8, 0.9, 0.94, 0.97, 1.0], abs=1e-3)
    assert [height[1] for height in heights] == pytest.approx([0.6, 0.8, 0.9, 0.94, 0.97, 1.0], abs=1e-3)
    (measured,) = (one for one in root.iter() if one.get("id") == "measured")
    assert len(measured) == 8  # ages 0 … 7


def test_ages_without_loss_and_of_few_steps_are_drawn() -> None:
    ages = np.zeros((4, 4), dtype=np.intp)
    ages[:, 0] = 5
    root = ElementTree.fromstring(ages_svg(ages, AgeReference(tau=4, horizon=12, loss=0.0)))
    assert len(of_class(root, "age")) == 4


def test_ticks_are_round_and_within() -> None:
    assert ticks(-8.6, 7.6) == pytest.approx([-8, -6, -4, -2, 0, 2, 4, 6])
    assert ticks(0.0, 1.0) == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert decades(3e-4, 1.6) == pytest.approx([1e-3, 1e-2, 1e-1, 1.0])


def test_a_frame_maps_corners_to_corners() -> None:
    frame = PictureFrame(10, 20, 100, 50, (0.0, 4.0), (0.01, 1.0), log_y=True)
    places = frame.pixels(np.array([[0.0, 0.01], [4.0, 1.0], [1.0, 0.1]]))
    assert places == pytest.approx(np.array([[10, 70], [110, 20], [35, 45]]))

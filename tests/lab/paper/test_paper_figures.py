"""Figures of `uavctl paper`: valid SVG with what the paper's have, at the right places."""

from __future__ import annotations

import re
from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.stats import chi2

from uavctl.arrays import Array
from uavctl.config import load_config
from uavctl.lab.paper.figures import AgeReference, draw_ages_svg, draw_trajectories_svg
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.wiring.controller import build_design

SVG = "{http://www.w3.org/2000/svg}"
LINK = AgeReference(tau=4, horizon=12, loss=0.3)
PLANES = ("(0, 1)", "(2, 3)", "(0, 2)")  # both axes, and the positions


@pytest.fixture(scope="module")
def design() -> Design:
    return build_design(load_config("paper"))


def drawn(root: ElementTree.Element, name: str) -> ElementTree.Element:
    """What was drawn under a name, which the picture's own is before."""
    (elements,) = (element for element in root.iter() if (element.get("id") or "").endswith(f"-{name}"))
    return elements


def courses(root: ElementTree.Element, name: str) -> list[Array]:
    """The lines that were drawn under a name, as places (n, 2); those in the file are steps from the last place."""
    elements = []
    for path in drawn(root, name).iter(f"{SVG}path"):
        for part in path.get("d", "").split("m"):
            if numbers := re.findall(r"-?(?:\d+\.?\d*|\.\d+)", part):
                elements.append(np.array(numbers, dtype=np.float64).reshape(-1, 2))
    return elements


def size(root: ElementTree.Element, name: str) -> Array:
    (steps,) = courses(root, name)
    extent: Array = np.ptp(np.cumsum(steps, axis=0), axis=0)
    return extent


def states(runs: int) -> Array:
    walk = np.random.default_rng(0).normal(size=(runs, 51, 4)).cumsum(axis=1) * 0.1
    walk[:, 0] = [35.0, -2.0, -20.0, -4.0]
    return walk


def collect_texts(root: ElementTree.Element) -> set[str]:
    return {"".join(element.itertext()).strip() for element in root.iter(f"{SVG}text")}


@pytest.mark.slow
@pytest.mark.parametrize("runs", [1, 7, 40])
def test_trajectories_show_box_ellipsoid_start_and_every_run(design: Design, runs: int) -> None:
    root = ElementTree.fromstring(draw_trajectories_svg(states(runs), design))
    assert root.tag == f"{SVG}svg"
    assert f"{runs} runs" in (root.findtext(f"{SVG}title") or "")
    for plane in PLANES:
        assert len(courses(root, f"runs-{plane}")) == runs
        for part in ("box", "set", "start"):
            drawn(root, f"{part}-{plane}")
    assert {"p_x", "v_x", "p_y", "v_y", "admissible states", "initial state", f"{runs} runs"} <= collect_texts(root)


def test_box_start_and_ellipse_are_to_scale(design: Design) -> None:
    root = ElementTree.fromstring(draw_trajectories_svg(states(3), design))
    (box,) = courses(root, "box-(0, 1)")
    per_m, per_mps = size(root, "box-(0, 1)") / [80.0, 15.0]  # -30 … 50 m, -8 … 7 m/s
    corner = np.cumsum(box, axis=0)
    left, top = corner[:, 0].min(), corner[:, 1].min()
    start = drawn(root, "start-(0, 1)").find(f".//{SVG}use")
    assert start is not None
    assert float(start.get("x", "")) == pytest.approx(left + 65.0 * per_m, abs=0.2)
    assert float(start.get("y", "")) == pytest.approx(top + 9.0 * per_mps, abs=0.2)
    half_widths = np.sqrt(chi2.ppf(0.95, 4) * np.diagonal(design.terminal.sigma_x)[:2])
    assert size(root, "set-(0, 1)") / 2 / [per_m, per_mps] == pytest.approx(half_widths, rel=0.01)
    assert half_widths == pytest.approx([15.64, 5.13], abs=0.01)  # as calculated beside the paper


def test_the_largest_picture_stays_small_and_is_always_the_same(design: Design) -> None:
    trajectories = states(200)
    svg = draw_trajectories_svg(trajectories, design)
    assert len(svg.encode()) < 1_000_000
    assert svg == draw_trajectories_svg(trajectories, design)


def test_ages_are_stacked_to_all_runs_in_each_step() -> None:
    ages = np.zeros((30, 30), dtype=np.intp)
    ages[:, 0] = 70
    ages[:, 1] = 30
    ages[0, :2] = [100, 0]
    ages[7, :8] = [60, 20, 10, 4, 3, 1, 1, 1]
    root = ElementTree.fromstring(draw_ages_svg(ages, LINK))
    outlines = [np.cumsum(courses(root, f"age-{age}")[0], axis=0) for age in range(6)]  # 0 … 4, 5 or more
    high = np.ptp(outlines[0][:, 1])  # all runs, in step 0
    middle = np.ptp(outlines[0][:, 0]) * 7.5 / 30 + outlines[0][:, 0].min()  # of step 7

    def height(outline: Array) -> float:
        """Of a layer in step 7, by the horizontal edges across its middle."""
        edges = [a[1] for a, b in pairwise(outline) if a[1] == b[1] and min(a[0], b[0]) < middle < max(a[0], b[0])]
        return float(np.ptp(edges)) / high

    assert [height(part) for part in outlines[:5]] == pytest.approx([0.6, 0.2, 0.1, 0.04, 0.03], abs=2e-3)
    assert len(drawn(root, "measured").findall(f".//{SVG}use")) == 8  # ages 0 … 7
    assert {"age a(k)", "5 or more", "measured", "Markov chain (4)"} <= collect_texts(root)


def test_ages_without_loss_and_of_few_steps_are_drawn() -> None:
    ages = np.zeros((4, 4), dtype=np.intp)
    ages[:, 0] = 5
    root = ElementTree.fromstring(draw_ages_svg(ages, AgeReference(tau=4, horizon=12, loss=0.0)))
    assert sum("-age-" in (element.get("id") or "") for element in root.iter()) == 4

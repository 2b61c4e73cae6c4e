"""Versions: the lowest ones that are tested are those that pyproject.toml permits, and the exact ones satisfy it."""

from __future__ import annotations

import re
import tomllib

import pytest
from places import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def read_pins(name: str) -> dict[str, tuple[int, ...]]:
    """Version of each package of a file of constraints."""
    lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
    pins = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    return {normalise(package): parse_version(version) for package, version in pins.items()}


def normalise(package: str) -> str:
    return re.sub(r"[-_.]+", "-", package).lower()


def parse_version(text: str) -> tuple[int, ...]:
    """Numbers of a version, without zeros at its end: 2.4 is 2.4.0."""
    numbers = [int(number) for number in re.findall(r"\d+", text.partition(".post")[0])]
    while numbers and numbers[-1] == 0:
        numbers.pop()
    return tuple(numbers)


def list_bounds(*extras: str) -> dict[str, tuple[int, ...]]:
    """Lowest permitted version of each package that is needed, and of those extras."""
    needs = [*PROJECT["dependencies"], *(need for extra in extras for need in PROJECT["optional-dependencies"][extra])]
    bounds = dict(need.split(">=") for need in needs)
    return {normalise(package): parse_version(version) for package, version in bounds.items()}


def test_the_lowest_versions_are_those_of_the_project() -> None:
    bounds, pins = list_bounds("campaign", "pandas", "polars", "ulog"), read_pins("constraints-lowest.txt")
    assert {package: pins.get(package) for package in bounds} == bounds


def test_the_exact_versions_satisfy_the_project() -> None:
    pins = read_pins("constraints.txt")
    bounds = list_bounds(*(extra for extra in PROJECT["optional-dependencies"] if extra not in ("dev", "ros2")))
    assert {package for package, bound in bounds.items() if pins.get(package, ()) < bound} == set()


@pytest.mark.parametrize(("low", "high"), [("2.4", "2.10"), ("0.1.8", "0.1.9.post1"), ("3", "3.0.1")])
def test_versions_compare_by_their_numbers(low: str, high: str) -> None:
    assert parse_version(low) < parse_version(high)

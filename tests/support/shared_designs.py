"""Designs, and solvers of designs, that flights of one test process share."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, TypeVar

import pytest
from msgspec.structs import replace

from uavctl.config import Config
from uavctl.smpc.answer import Solver
from uavctl.smpc.conditioned.design import AnyDesign
from uavctl.wiring import controller

Built = TypeVar("Built")
KEPT = 24  # more than the configurations that the tests of a file take turns with
SECTIONS = (
    "name", "duration_s", "daemon", "sim", "frame", "fallback", "envelope", "clock", "hand_over", "check", "relay",
    "security", "log", "mission", "fence",
)  # fmt: skip
OF_THE_FLIGHT = dict.fromkeys(SECTIONS)  # None has no keys: a build that read one would fail


def share_designs(patch: pytest.MonkeyPatch) -> None:
    """Build each design, and its solver, once: no answer of a solver depends on earlier questions.

    test_shortcut.py and test_conditioned.py show that. A design depends on nothing but the problem, link and filter.
    Tests of the builders themselves import these by name, and build each time.
    """
    build_solver = controller.build_solver
    share_solver = lru_cache(KEPT)(build_solver)

    def find_solver(design: AnyDesign, config: Config) -> Solver:
        if config.smpc.controller:
            return build_solver(design, config)
        return share_solver(design, replace(config, **OF_THE_FLIGHT))

    patch.setattr(controller, "build_design", _share(controller.build_design))
    patch.setattr(controller, "build_conditioned", _share(controller.build_conditioned))
    patch.setattr(controller, "build_solver", find_solver)


def _share(build: Callable[..., Built]) -> Callable[..., Built]:
    shared = lru_cache(KEPT)(build)

    def find(config: Config, **more: Any) -> Built:
        return build(config, **more) if more else shared(replace(config, **OF_THE_FLIGHT))

    return find

"""Configurations, designs, and solvers of designs, that flights of one test process share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from importlib import import_module
from typing import Any, TypeVar

import pytest
from msgspec.structs import replace

from uavctl.config import Config
from uavctl.config.load import LoadedConfig
from uavctl.smpc.answer import Solver
from uavctl.smpc.conditioned.design import AnyDesign
from uavctl.wiring import controller

Built = TypeVar("Built")
KEPT = 24  # more than the configurations that the tests of a file take turns with
KEPT_TEXTS = 200  # they are small
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


def share_configurations(patch: pytest.MonkeyPatch) -> None:
    """Read each text of `load` with its overrides once: a configuration is frozen.

    One that names a file is read each time, and so is one by `parse`, which tests of reading import by name.
    """
    module = import_module("uavctl.config.load")  # its package has a function of that name
    parse: Callable[[str, str, Sequence[str]], LoadedConfig] = module.parse
    shared = lru_cache(KEPT_TEXTS)(parse)

    def find(text: str, file: str, overrides: Sequence[str] = ()) -> LoadedConfig:
        names_file = any("_file" in part for part in (text, *overrides))
        return parse(text, file, overrides) if names_file else shared(text, file, tuple(overrides))

    patch.setattr(module, "parse", find)


def _share(build: Callable[..., Built]) -> Callable[..., Built]:
    shared = lru_cache(KEPT)(build)

    def find(config: Config, **more: Any) -> Built:
        return build(config, **more) if more else shared(replace(config, **OF_THE_FLIGHT))

    return find

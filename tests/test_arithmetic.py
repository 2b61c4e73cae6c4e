"""Portable arithmetic: chosen where the processor has it and nobody chose otherwise, and told truly."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from places import without_pages

from uavctl.arithmetic import CHOICE, OWN, PORTABLE, choose_arithmetic, without_choice
from uavctl.arrays import sum_in_order

HASWELL = {"abm", "avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe", "sse4_2"}
WIDE = {*HASWELL, "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}
CORE = "OPENBLAS_CORETYPE"


@pytest.mark.parametrize("flags, more", [(HASWELL, {}), (WIDE, {CHOICE: "X86_V4"})])
def test_it_is_chosen_before_numpy_is_loaded_and_told_in_processes_started_from_there(
    flags: set[str], more: dict[str, str]
) -> None:
    environ: dict[str, str] = {}
    assert choose_arithmetic(flags, environ, begun=False) == PORTABLE
    assert environ == {CORE: "Haswell"} | more
    assert choose_arithmetic(flags, environ, begun=True) == PORTABLE  # a child that loads numpy first
    own = without_choice(environ | {"HOME": "/"})
    assert own == {"HOME": "/", CHOICE: ""}
    assert choose_arithmetic(flags, own, begun=False) == OWN
    assert own == {"HOME": "/", CHOICE: ""}


def test_half_of_the_choice_made_by_the_machine_is_completed() -> None:
    environ = {CORE: "Haswell"}
    assert choose_arithmetic(WIDE, environ, begun=False) == PORTABLE
    assert environ == {CORE: "Haswell", CHOICE: "X86_V4"}


def test_a_processor_without_the_instructions_is_left_alone() -> None:
    for flags in (set[str](), {"fp", "asimd"}, WIDE - {"fma"}):
        environ: dict[str, str] = {}
        assert choose_arithmetic(flags, environ, begun=False) == OWN
        assert environ == {}


@pytest.mark.parametrize("given", [{CORE: "SkylakeX"}, {CHOICE: ""}, {CHOICE: "AVX512_ICL"}])
def test_what_a_person_chose_stays(given: dict[str, str]) -> None:
    environ = dict(given)
    assert choose_arithmetic(WIDE, environ, begun=False) == OWN
    assert environ == given


def test_numpy_that_was_loaded_first_computes_as_it_does_in_the_children_too() -> None:
    environ: dict[str, str] = {}
    assert choose_arithmetic(HASWELL, environ, begun=True) == OWN
    assert choose_arithmetic(HASWELL, environ, begun=False) == OWN


SUM = """
import json, sys
{first}
import numpy as np
from scipy.linalg import cho_factor
from uavctl.arithmetic import ARITHMETIC
x = np.sin(np.arange(57 * 57.0)).reshape(57, 57)
y = x @ x.T + 57 * np.eye(57)
bits = [y.sum().hex(), np.linalg.solve(y, x[0]).sum().hex(), cho_factor(y)[0].sum().hex(), np.exp(x).sum().hex()]
print(json.dumps([ARITHMETIC, np._core._multiarray_umath.__cpu_features__["X86_V4"], bits]))
"""
# Of an Intel Xeon with AVX-512, whose own instructions make others of the second and the third.
BITS = ["0x1.9c270292bbc66p+11", "-0x1.1c5a6293b5a10p-9", "-0x1.69518ce56c5e9p+8", "0x1.0112a7b047a0bp+12"]


@cache
def computed(first: str) -> tuple[str, bool, list[str]]:
    environ = {name: value for name, value in os.environ.items() if name not in (CORE, CHOICE)}
    made = subprocess.run(
        [sys.executable, "-c", SUM.format(first=first)], env=environ, capture_output=True, check=True, timeout=60
    )
    arithmetic, wide, bits = json.loads(made.stdout)
    return arithmetic, wide, bits


@pytest.mark.parametrize(
    "first",
    ["uavctl", *(pytest.param(name, marks=pytest.mark.slow) for name in ("logs.recording.topics", "sim.vehicle"))],
)
def test_the_last_bits_are_those_of_other_makers(first: str) -> None:
    arithmetic, wide, bits = computed(f"import {first}")
    own, _, others = computed("import numpy")
    assert own == OWN
    if arithmetic == PORTABLE:
        assert not wide and bits == BITS
    else:  # a processor without AVX2 computes as it can
        assert bits == others


@pytest.mark.slow
def test_a_flight_is_replayed_with_the_arithmetic_that_it_was_made_with_or_to_a_tolerance(tmp_path: Path) -> None:
    portable = {name: value for name, value in os.environ.items() if name not in (CORE, CHOICE)}
    own = without_choice(os.environ)

    def told(environ: dict[str, str], *words: str) -> tuple[dict[str, object], bytes]:
        command = [sys.executable, "-m", "uavctl", *words, "--json"]
        made = subprocess.run(
            command, env=without_pages(environ), capture_output=True, check=True, timeout=120, cwd=tmp_path
        )
        return json.loads(made.stdout), made.stderr

    for name, environ in (("own", own), ("portable", portable)):
        told(environ, "loopback", "--config", "room-px4", "--duration", "2", "--out", name)
    for name in ("own", "portable"):
        found, messages = told(portable, "log", "replay", f"{name}/flight.mcap")
        assert found["identical"] and b"arithmetic" not in messages  # as is told of what is here another than there
    assert b"arithmetic" not in told(portable, "log", "whatif", "own/flight.mcap")[1]
    assert told(own, "log", "replay", "portable/flight.mcap", "--tolerance", "1e-6")[0]["identical"]


def test_a_sum_rounds_after_each_term_in_every_version_of_python() -> None:
    # Since Python 3.12 the sum of the first list is 1.0, that of the second one 1.0.
    assert sum_in_order([1e16, 1.0, -1e16]) == 0.0
    assert sum_in_order([0.1] * 10) == 0.9999999999999999

"""Portable arithmetic: processors of different makers agree on the last bits of linear algebra.

OpenBLAS and numpy choose their instructions by the processor, and each choice sums in another order. What x86-64-v3 has
(AVX2 and FMA, in processors since 2013) is the same everywhere, so a flight recorded on one machine replays bit for bit
on another. Products of the small matrices here are no slower with it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, MutableMapping, Set
from pathlib import Path

PORTABLE = "x86-64-v3"
OWN = "the processor's own"
CHOICE = "NPY_DISABLE_CPU_FEATURES"  # numpy's; set to nothing it leaves all to the processor
_CORE = "OPENBLAS_CORETYPE"  # OpenBLAS's own, in numpy and in scipy
_NEEDED = {"abm", "avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe"}
_WIDE = {"avx512bw", "avx512cd", "avx512dq", "avx512f", "avx512vl"}  # numpy's X86_V4; it warns where there is none
_HEAD_BYTES = 8192  # of /proc/cpuinfo: the first processor


def choose_arithmetic(flags: Set[str], environ: MutableMapping[str, str], begun: bool) -> str:
    """Set the environment for portable arithmetic, if possible and not chosen before; return its name.

    Args:
        flags: Features of the processor, in the words of /proc/cpuinfo.
        environ: Environment of this process, which those that it starts inherit.
        begun: Whether numpy is loaded: it and OpenBLAS read the environment once.
    """
    if not flags >= _NEEDED:
        return OWN
    wanted = {_CORE: "Haswell"} | ({CHOICE: "X86_V4"} if flags >= _WIDE else {})
    if begun:
        environ.setdefault(CHOICE, "")  # processes started from here compute as this one does
    elif CHOICE not in environ and environ.get(_CORE, wanted[_CORE]) == wanted[_CORE]:
        environ.update(wanted)  # also where the machine has made half of this choice
    return PORTABLE if all(environ.get(name) == value for name, value in wanted.items()) else OWN


def without_choice(environ: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of a process that computes with the processor's own instructions."""
    return {name: value for name, value in environ.items() if name != _CORE} | {CHOICE: ""}


def _flags() -> set[str]:
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8") as file:
            lines = file.read(_HEAD_BYTES).splitlines()
    except OSError:  # not Linux
        return set()
    return set(next((line.partition(":")[2].split() for line in lines if line.startswith("flags")), ()))


ARITHMETIC = choose_arithmetic(_flags(), os.environ, "numpy" in sys.modules)

"""What a policy library achieves: answers from states that it has not been grown on."""

from __future__ import annotations

from collections import Counter

import msgspec
import numpy as np

from uavctl.smpc.answer import NOMINAL, Outlook
from uavctl.smpc.components import decompose
from uavctl.smpc.design import Design
from uavctl.smpc.library import Library
from uavctl.smpc.library_solver import LibrarySolver
from uavctl.smpc.region import Region

STATES = 200
_SEED = (0x5EED, 1)  # other than those that libraries are grown with


class LibraryCheck(msgspec.Struct, frozen=True, kw_only=True):
    """Answers of the library solver, the exact program allowed, from seeded states and targets.

    Most of the states are uniform in the box of the limits, where some cannot be held: these take the exact program.
    """

    states: int
    methods: dict[str, int]  # number of answers by "frozen", "mixture" and "exact"
    worst_gap: float  # certified, relative to the cost


def check_library(design: Design, library: Library, states: int = STATES) -> LibraryCheck:
    """Ask a library from `states` seeded states for each age of the position that it knows."""
    solver = LibrarySolver(design, library)
    rng = np.random.default_rng(_SEED)
    methods = Counter(dict.fromkeys(("frozen", "mixture", "exact"), 0))
    worst_gap = 0.0
    for late, variant in enumerate((design, *design.late)):
        outlook = Outlook(late=late) if late else NOMINAL
        regions = [(component, Region(variant, component)) for component in decompose(variant)]
        for number in range(states):
            x, target = np.zeros(design.plant.n_x), np.zeros(design.plant.n_x)
            for component, region in regions:
                x[component.states], target[component.states] = region.draw(rng)
            answer = solver.solve(number, x, target, outlook)
            methods[answer.method] += 1
            worst_gap = max(worst_gap, answer.gap)
    return LibraryCheck(states=states * (1 + len(design.late)), methods=dict(methods), worst_gap=worst_gap)

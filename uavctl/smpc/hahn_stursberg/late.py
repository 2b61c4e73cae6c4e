"""Designs for late positions (re-basing).

1. A position that is newer than the plan's base but j steps old gives x̂(k|k-j), the prediction under the inputs since
   then.
2. A plan from there is a solve at the time of capture with those j inputs fixed: the means start at x̂(k|k-j), the
   disturbances w(k-j) … w(k-1) are unknown, and the past stages are no decision.
3. The likelihoods are conditional: nothing newer than k-j has arrived until k.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.hahn_stursberg.design import Design, DesignSpec, assemble_design
from uavctl.smpc.hahn_stursberg.exact import check_schedule
from uavctl.smpc.hahn_stursberg.schedule import ScheduleDemand, make_fixed
from uavctl.smpc.plant import digest


@dataclass(frozen=True, eq=False)
class LateDemand(ScheduleDemand):
    """Requirements on a schedule for a position `late` steps old; stages count from now."""

    late: int = 0

    def alpha(self, t: int, delay: int) -> float:
        """Return P(w(k+t-d) is known at stage t | a(k) = late); 1 for disturbances before the base."""
        newest = t - delay + self.late
        return 1.0 if newest < 0 else self.link.availability(t + self.late, newest, self.late)

    def joint_usability(self, delays: Sequence[int]) -> Array:
        """See `ScheduleDemand`."""
        if self.joint:
            past_delays = range(1, self.late + 1)  # longer than the time since the base: no feedback
            return self.link.joint_availability((*past_delays, *(delays)), self.late)[self.late :]
        return super().joint_usability(delays)


def add_late_designs(design: Design, spec: DesignSpec, steps: int) -> Design:
    """Return the design with designs for positions 1 … `steps` steps old.

    Raises:
        DesignError: There is none for one of these ages.
    """
    if not steps:
        return design
    late = tuple(make_late_design(design, spec, j) for j in range(1, steps + 1))
    extended = replace(design, late=late, design_id="")
    return replace(extended, design_id=digest(extended))


def make_late_design(design: Design, spec: DesignSpec, late: int) -> Design:
    """Make the design for positions `late` steps old; with `late` = 0 it is the design itself.

    It has the delays of the design. A stage t < d_t feeds back nothing here too: disturbances before now may become
    known in time, but too rarely.

    Args:
        design: Design for positions that are not late.
        late: Age of the position, j [steps].

    Raises:
        DesignError: Likelihoods are out of reach, a terminal limit does not hold, or the terminal condition cannot be
            met; the message names the age.
    """
    if not late:
        return design
    demand = LateDemand(spec.link, spec.horizon, spec.tau, spec.delta_x, spec.delta_u, spec.joint, late)
    delays = tuple(d if t >= d else t + late + 1 for t, d in enumerate(design.schedule.delays))
    try:
        late_design = assemble_design(spec, make_fixed(demand, delays), design.terminal, late)
        check_schedule(late_design)
    except DesignError as error:
        raise DesignError(error.key, f"for positions of age {late}: {error.reason}", error.hint) from error
    return late_design

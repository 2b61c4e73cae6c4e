"""Plans that are based on late positions (re-basing).

A position that is newer than the plan's base but j steps old gives x̂(k|k-j), the prediction under the inputs that were
flown. Planning from there is solving at the time of capture with those j inputs held fixed: the means start at
x̂(k|k-j), the disturbances w(k-j) … w(k-1) are not known yet but will be, and the sunk stages are nobody's to choose.
What feedback may be counted on is conditional on what is known: nothing newer than k-j has come until k.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from uavctl.errors import DesignError
from uavctl.smpc.design import Design, DesignSpec, assembled
from uavctl.smpc.digest import digest
from uavctl.smpc.feasibility import check_schedule
from uavctl.smpc.schedule import Array, Demand, fixed


@dataclass(frozen=True, eq=False)
class LateDemand(Demand):
    """What a schedule has to meet that is based on a position `late` steps old; stages count from now."""

    late: int = 0

    def alpha(self, t: int, delay: int) -> float:
        """P(w(k+t-d) is known at stage t | a(k) = late); 1 where that is not a disturbance since the base."""
        newest = t - delay + self.late
        return 1.0 if newest < 0 else self.link.available(t + self.late, newest, self.late)

    def usable(self, delays: Sequence[int]) -> Array:
        """See `Demand`."""
        if self.joint:
            sunk = range(1, self.late + 1)  # longer than the time since the base: no feedback
            return self.link.jointly((*sunk, *(delays)), self.late)[self.late :]
        return super().usable(delays)


def with_late(design: Design, spec: DesignSpec, steps: int) -> Design:
    """The design, with those for positions 1 … `steps` steps old.

    Raises:
        DesignError: There is none for one of these ages.
    """
    if not steps:
        return design
    late = tuple(make_late(design, spec, j) for j in range(1, steps + 1))
    whole = replace(design, late=late, design_id="")
    return replace(whole, design_id=digest(whole))


def make_late(design: Design, spec: DesignSpec, late: int) -> Design:
    """The design for positions that are `late` steps old, with `late` = 0 the design itself.

    It has the delays of the design. A stage t < d_t, which feeds back nothing there, does so here too: news of the
    disturbances before now could reach it, but too seldom to count on.

    Args:
        design: For positions that are not late.
        spec: What it was made from.
        late: Age of the position, j [steps].

    Raises:
        DesignError: The link leaves too little to count on, a terminal limit does not hold, or the terminal condition
            cannot be met; the message names the age.
    """
    if not late:
        return design
    demand = LateDemand(spec.link, spec.horizon, spec.tau, spec.delta_x, spec.delta_u, spec.joint, late)
    delays = tuple(d if t >= d else t + late + 1 for t, d in enumerate(design.schedule.delays))
    try:
        made = assembled(spec, fixed(demand, delays), design.terminal, late)
        check_schedule(made)
    except DesignError as error:
        raise DesignError(error.key, f"for positions of age {late}: {error.reason}", error.hint) from error
    return made

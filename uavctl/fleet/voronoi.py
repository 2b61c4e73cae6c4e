"""Buffered Voronoi cells by positions alone, the baseline of the moving cells.

A plane in the middle between two positions, normal to the axis where they are furthest apart, less half of the
distance. It is the same in all stages, and claims do not count. As in D. Zhou et al., Fast, on-line collision avoidance
for dynamic vehicles using buffered Voronoi cells (RA-L 2017), with planes normal to an axis.
"""

from __future__ import annotations

import numpy as np

from uavctl.arrays import Array
from uavctl.fleet.boxes import Boxes, divide_pairs
from uavctl.fleet.cell import MovingCell
from uavctl.fleet.coordinator import CellParameters


def make_voronoi_cells(
    positions_m: Array, guides_m: Array, number: int, step: int, parameters: CellParameters
) -> tuple[MovingCell, ...]:
    """Make a cell for each vehicle from the positions (N, 3) last reported; two that are too near get none apart."""
    points = Boxes(positions_m[:, None], positions_m[:, None])
    bounds = divide_pairs(points, points, parameters.distance_m)
    lower_m = np.maximum(bounds.lower_m, parameters.room_lower_m)
    upper_m = np.minimum(bounds.upper_m, parameters.room_upper_m)
    return tuple(
        MovingCell(number, step, low_m, high_m, guide_m)
        for low_m, high_m, guide_m in zip(lower_m, upper_m, guides_m, strict=True)
    )

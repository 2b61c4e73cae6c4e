"""The limits of the state over a flight: constant ones, and fences that closed in."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator

import msgspec
import numpy as np

from logs.design_view import Box, Floats
from logs.flight_data import FlightData
from uavctl.config.mission import FenceConfig


def limits_at(flight: FlightData, t_s: Floats) -> Floats:
    """Right sides of the state set's rows (n, m_x) at times of the report (n,) [s]."""
    design, begun_s = flight.design, flight.targets[0][0]
    limits = np.tile(np.array(design.b_x), (len(t_s), 1))
    for fence in _fences(flight):
        state, box = fence.state, design.state_box
        if isinstance(state, str):
            state = design.position_index[design.axes.index(state)]
        row = int((box.row_upper if fence.side == "upper" else box.row_lower)[state])
        moving = np.interp(t_s - begun_s, fence.times_s, fence.values) * design.c_x[row][state]
        limits[:, row] = np.minimum(limits[:, row], moving)
    return limits


def box_at(flight: FlightData, t_s: Floats) -> tuple[Floats, Floats]:
    """Axis-parallel limits of the states, lower and upper (n, n_x); infinite where a side is open."""
    design, limits = flight.design, limits_at(flight, t_s)
    sides = []
    box: Box = design.state_box
    for rows, constant in ((box.row_lower, box.lower), (box.row_upper, box.upper)):
        side = np.tile(constant, (len(t_s), 1))
        for state in np.flatnonzero(rows >= 0):
            row = int(rows[state])
            side[:, state] = limits[:, row] / design.c_x[row][state]
        sides.append(side)
    return sides[0], sides[1]


def _fences(flight: FlightData) -> Iterator[FenceConfig]:
    """Fences of the configuration that the flight was made with; none if it cannot be read any more."""
    try:
        found = tomllib.loads(flight.header.config_toml).get("fence", [])
        yield from msgspec.convert(found, tuple[FenceConfig, ...])
    except (tomllib.TOMLDecodeError, msgspec.ValidationError):
        return

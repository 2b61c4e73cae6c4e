"""Recordings of flights: written, read, replayed, reported."""

from uavctl.arithmetic import ARITHMETIC as ARITHMETIC  # before anything that loads numpy

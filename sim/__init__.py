"""Simulator: vehicle, autopilot, cameras and radio channel, on the other side of the connections."""

from uavctl.arithmetic import ARITHMETIC as ARITHMETIC  # before anything that loads numpy

"""Tuning by flying: excite inside a box, identify, change the values that the flight determines, fly again, compare."""

from __future__ import annotations

"""Tuning by flying: excite inside a box, identify, change what the flight tells, fly again, compare."""

from __future__ import annotations

"""Campaigns: many runs of many controllers on the same noise and the same losses."""

from __future__ import annotations

"""Identification of vehicle and link from a recording: plant, lag, disturbance, losses and delays."""

from __future__ import annotations

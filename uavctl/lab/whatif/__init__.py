"""What-if: a recorded flight flown again with another controller, schedule or link."""

from __future__ import annotations

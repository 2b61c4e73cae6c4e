"""A recorded flight flown by another controller, schedule or link: what would have been."""

from __future__ import annotations

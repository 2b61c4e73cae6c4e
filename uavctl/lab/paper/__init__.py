"""Section 5 of the paper, reproduced: runs, figures, and each claim beside its measurement."""

from __future__ import annotations

"""Section 5 of the paper, reproduced: runs, figures, and each claim beside what was measured."""

from __future__ import annotations

"""Section 5 of the paper, reproduced: its runs, its two figures, and each of its claims beside what was measured."""

from __future__ import annotations

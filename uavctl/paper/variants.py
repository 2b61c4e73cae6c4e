"""The designs that Section 5 can mean: τ = 4 as printed, and τ = 3, which the printed δ_τ = 99.19 % belongs to."""

from __future__ import annotations

from dataclasses import dataclass

PRESET = "paper"


@dataclass(frozen=True)
class Variant:
    """A reading of the paper's example.

    Attributes:
        tau: τ.
        overrides: What is changed in preset `paper`.
        note: What it is, and why it is made so.
    """

    tau: int
    overrides: tuple[str, ...]
    note: str


PRINTED = Variant(4, (), "τ = 4 as printed, d_t = τ + 1 = 5, likelihoods by (6)")
# With d_t = 4 the product in (6) is 0.937 < δ_x. The probability that it bounds is 0.9525, which will do.
SMALLEST = Variant(
    3,
    ("smpc.tau=3", "schedule.delays=4", "schedule.joint=true"),
    "the smallest τ with P(a ≤ τ) ≥ 99 %, d_t = τ + 1 = 4, likelihoods by the exact joint probability",
)
VARIANTS = (PRINTED, SMALLEST)

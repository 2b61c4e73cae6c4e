"""The bias of the input that braking and holding count on.

1. Estimates of the bias are kept for three seconds, those of boundaries with a fresh position only.
2. The part that was there for all of that time has lasted. Braking and holding fly against it without positions.
"""

from __future__ import annotations

from uavctl.records import Vector

# In the first seconds, and where the vehicle does not answer as the model says, an estimated bias comes and goes with
# what is flown. Its acceleration would be flown for seconds without a position.
LASTING_NS = 2_000_000_000  # a bias counts that has been estimated for so long,
RECENT_NS = 3_000_000_000  # as far as all estimates of this time have it

Biases = tuple[tuple[int, Vector], ...]  # (time [ns], estimated bias (n_u,)), oldest first


def remember_bias(biases: Biases, at_ns: int, bias: Vector) -> Biases:
    """Add a bias to the recent ones, from an estimate with a fresh position in it."""
    return (*(one for one in biases if at_ns - one[0] <= RECENT_NS), (at_ns, bias))


def find_lasting_bias(biases: Biases) -> Vector:
    """Find the part of a bias (n_u,) that has lasted through recent time; zero if it has not been known for long."""
    if not biases:
        return ()
    known = biases[-1][0] - biases[0][0] >= LASTING_NS
    sides = [(min(values), max(values)) for values in zip(*(bias for _, bias in biases), strict=True)]
    # max(min d, 0) + min(max d, 0): the value nearest to zero, if all have one sign
    return tuple(max(low, 0.0) + min(high, 0.0) if known else 0.0 for low, high in sides)

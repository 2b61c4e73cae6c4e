"""Whether the estimated bias is as large as what is flown against it: told once, and again when it no longer is."""

from __future__ import annotations

from collections.abc import Sequence

from uavctl.data import Event, Severity, Vec3

BIAS_AT_BOUND, BIAS_FREE = "bias-at-bound", "bias-free"
FREE = 0.9  # share of its bound below which a bias no longer is at it: one that settles there is told once


def at_bound(bias: Sequence[float], bounds: Sequence[float], told: Sequence[int]) -> tuple[int, ...]:
    """Inputs whose bias is at its bound.

    Args:
        bias: estimated one, each input [input units].
        bounds: what of each input may be spent against it [input units].
        told: inputs of which that was told.
    """
    return tuple(
        i
        for i, (value, bound) in enumerate(zip(bias, bounds, strict=False))
        if abs(value) >= (FREE * bound if i in told else bound)
    )


def bias_events(push_mps2: Vec3, before: Sequence[int], now: Sequence[int], at_ns: int) -> tuple[Event, ...]:
    """What has become of it: an event if more inputs are at their bounds than before, and one if none is any more.

    Args:
        push_mps2: the bias as an acceleration, local NED [m/s²].
        before: inputs of which was told that they are at their bounds.
        now: those of which it holds now.
        at_ns: now.
    """
    if set(now) - set(before):
        pushes = ", ".join(f"{value:+.2f}" for value in push_mps2)
        text = (
            f"a lasting push, as wind, is as large as what may be flown against it ({pushes} m/s² north, east, down): "
            "what it is more carries the vehicle off its target"
        )
        return (Event(at_ns=at_ns, severity=Severity.WARNING, code=BIAS_AT_BOUND, text=text),)
    if before and not now:
        text = "the lasting push is again within what may be flown against it"
        return (Event(at_ns=at_ns, severity=Severity.INFO, code=BIAS_FREE, text=text),)
    return ()

"""Controllers of a campaign by name: our own kinds, and those of other packages (`uavctl.build.outside`)."""

from __future__ import annotations

from typing import cast

from uavctl.build.outside import ACTS, controller_class, make
from uavctl.smpc.batch import BatchController
from uavctl.smpc.nominal import ControlProblem

KINDS = ("smpc", "lqg", "packetised", "mean-qp", "governor", "worst-case-delay", "hold-last", "zero-on-loss", "pid")
KEY = "kind"


def check_kind(kind: str) -> None:
    """Check that a kind that is none of `KINDS` is a controller of another package.

    Raises:
        DesignError: Nothing has that name, it cannot be imported, or it is no controller.
    """
    controller_class(kind, KEY, (ACTS,), KINDS)


def make_controller(kind: str, problem: ControlProblem) -> BatchController:
    """Make a controller of another package for a problem.

    Raises:
        DesignError: There is none, or its class does not take the problem.
    """
    return cast(BatchController, make(controller_class(kind, KEY, (ACTS,), KINDS), kind, KEY, problem))

"""Controllers to compare with, every one a real controller on the same plant, weights, limits, noise and losses."""

from uavctl.smpc.baselines.feedback import CascadedPid, Governor, Lqg, PidGains, tune
from uavctl.smpc.baselines.mpc import HoldLast, MeanQp, PacketisedPredictive, WorstCaseDelay, ZeroOnLoss
from uavctl.smpc.nominal import ControlProblem

__all__ = [
    "CascadedPid",
    "ControlProblem",
    "Governor",
    "HoldLast",
    "Lqg",
    "MeanQp",
    "PacketisedPredictive",
    "PidGains",
    "WorstCaseDelay",
    "ZeroOnLoss",
    "tune",
]

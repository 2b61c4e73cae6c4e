"""What others would fly: every one a real controller on the same plant, weights, limits, noise and losses."""

from uavctl.smpc.baselines.governor import Governor
from uavctl.smpc.baselines.lqg import Lqg
from uavctl.smpc.baselines.pid import CascadedPid, PidGains
from uavctl.smpc.baselines.pid_tuning import tune
from uavctl.smpc.baselines.problem import Problem
from uavctl.smpc.baselines.receipt import HoldLast, MeanQp, PacketisedPredictive, ZeroOnLoss
from uavctl.smpc.baselines.worst_case import WorstCaseDelay

__all__ = [
    "CascadedPid",
    "Governor",
    "HoldLast",
    "Lqg",
    "MeanQp",
    "PacketisedPredictive",
    "PidGains",
    "Problem",
    "WorstCaseDelay",
    "ZeroOnLoss",
    "tune",
]

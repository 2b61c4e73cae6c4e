"""Speed of one decision on this machine, in one run: policy library, exact program, problem as printed."""

from uavctl.bench.decisions import DecisionBench, time_decisions
from uavctl.bench.result import BenchResult, ConditionedTimes
from uavctl.bench.run import DEFAULT_SIZES, Sizes, run_bench

__all__ = [
    "DEFAULT_SIZES",
    "BenchResult",
    "ConditionedTimes",
    "DecisionBench",
    "Sizes",
    "run_bench",
    "time_decisions",
]

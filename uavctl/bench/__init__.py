"""Speed of one decision on this machine, in one run: policy library, exact program, problem as printed."""

from uavctl.bench.result import BenchResult, ConditionedTimes
from uavctl.bench.run import DEFAULT_SIZES, Sizes, run_bench

__all__ = ["DEFAULT_SIZES", "BenchResult", "ConditionedTimes", "Sizes", "run_bench"]

"""Experiments: campaigns, trials, the paper, identification, tuning, what-if and benchmarks."""

"""Flights of the true vehicle in lockstep, judged on the truth: ours, and the vehicle's own position loop beside it."""

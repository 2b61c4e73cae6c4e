"""Simulated autopilots with modes, estimator and telemetry as PX4 and ArduCopter have them."""

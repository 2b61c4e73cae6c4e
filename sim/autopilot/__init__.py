"""The simulated autopilots: modes, estimator, telemetry, as PX4 and ArduCopter have them."""

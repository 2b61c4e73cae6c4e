"""One control tick, pure: estimator, fallback, setpoint limiter."""

"""One control tick, pure: estimator, fallback, last gate."""

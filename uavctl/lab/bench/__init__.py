"""Speed of this machine: one decision, one tick."""

"""The flight daemon and what stands around a flight: orders, health, lock, real time."""

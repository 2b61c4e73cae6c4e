"""The flight daemon and its services: orders, health, lock, real time."""

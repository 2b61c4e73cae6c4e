"""Simulated vehicles: the linear plant and a quadrotor with its loops."""

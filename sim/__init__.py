"""Simulator: vehicle, autopilot, cameras and radio channel, on the other side of the connections."""

"""The other side of the wire: vehicle, autopilot, cameras, radio channel."""

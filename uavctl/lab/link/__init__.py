"""Measurement of a real link between two computers."""

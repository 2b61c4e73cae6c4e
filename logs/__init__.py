"""Recordings of flights: written, read, replayed, reported."""

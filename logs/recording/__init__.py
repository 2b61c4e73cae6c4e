"""Recordings: written, read, recovered, replayed, exported."""

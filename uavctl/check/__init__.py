"""Checks before a vehicle is armed: bytes and times in, items out; no socket, no clock, nothing armed."""

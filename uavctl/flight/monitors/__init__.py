"""Monitors of a flight, one file each: two sources that should agree are compared, with a verdict."""

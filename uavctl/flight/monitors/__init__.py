"""Monitors of a flight, one file each: two sources that should agree are compared, and a verdict says what follows."""

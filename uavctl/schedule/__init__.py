"""Schedules of one sender for several vehicles: which vehicle gets the next message of a channel with a budget."""

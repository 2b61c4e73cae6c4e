"""A controller and a position source for uavctl."""

"""MPC with risk conditioned on the age of information: the default controller."""

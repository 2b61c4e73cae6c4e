"""MPC with risk conditioned on the age of information: what flies by default."""

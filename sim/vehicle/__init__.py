"""What flies in the simulator: the linear plant and a quadrotor with its loops."""

"""Speed of decisions and of the control loop on this machine."""

"""What stands on the simulated stage."""

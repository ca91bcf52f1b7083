"""What does the work of a fleet: jobs, the processes or machines that run them, and the steps of a pass."""

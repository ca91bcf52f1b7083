"""Transfer between tasks and across sensors."""

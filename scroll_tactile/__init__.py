"""A robot's memory of how things feel."""

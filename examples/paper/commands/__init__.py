"""The commands of `python -m examples.paper`."""

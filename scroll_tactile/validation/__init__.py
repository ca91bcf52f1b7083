"""Validation: what may come in from a folder; values, rows and checkpoints, each taken for what it must be."""

"""Runs of many cells that resume where they were stopped."""

"""Readouts: classifiers computed from the statistics alone, and their calibration."""

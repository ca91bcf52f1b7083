"""Signals: streams of readings, their tactile images, windows, contact and augmentation."""

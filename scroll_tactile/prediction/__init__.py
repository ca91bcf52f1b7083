"""Prediction: from a touch to an answer."""

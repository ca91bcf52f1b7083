"""Sensors without hardware: simulated touches, a pressed gel, and shifts of readings for live sessions."""

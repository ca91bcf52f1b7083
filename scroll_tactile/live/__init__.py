"""Readings as they come: where a touch begins and ends, and an answer as soon as it is safe to act on."""

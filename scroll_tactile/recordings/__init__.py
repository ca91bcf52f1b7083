"""Recordings: streams in files."""

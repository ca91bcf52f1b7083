"""Readers of published data sets in their publishers' layouts; no data."""

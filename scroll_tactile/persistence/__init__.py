"""Persistence: how a memory survives; journal, replay, merge, packing, another embedding."""

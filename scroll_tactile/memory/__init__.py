"""The memory: its state, how it is kept in a store, and what it may be opened with."""

"""A memory for a microcontroller: the exported judge, in whole numbers, and the C that runs it."""

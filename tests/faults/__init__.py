"""Commands that harm a memory in every way that a machine can, and look at what is left of it."""

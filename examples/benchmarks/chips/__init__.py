"""The exported judge on chips that QEMU plays, and what runs it there."""

"""`python -m scroll_tactile.cli`."""

from scroll_tactile.cli import app

app(prog_name="scroll-tactile")

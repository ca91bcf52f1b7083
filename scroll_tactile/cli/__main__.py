"""`python -m scroll_tactile.cli`."""

from scroll_tactile.cli import main

main()

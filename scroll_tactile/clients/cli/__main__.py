"""`python -m scroll_tactile.clients.cli`."""

from scroll_tactile.clients.cli import main

main()

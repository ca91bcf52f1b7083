"""`python -m scroll_tactile.cli`: the command line, where its script is not on the path."""

from scroll_tactile.clients.cli import main

if __name__ == "__main__":
    main()

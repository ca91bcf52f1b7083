"""The paper's tables and figures, from one's own copy of the data: `python -m examples.paper --help`."""

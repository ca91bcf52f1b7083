"""The tables of RESULTS.md, made from the files of results."""

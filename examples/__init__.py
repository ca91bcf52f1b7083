"""Programs to run from a clone: first steps, the paper's tables and figures, and benchmarks."""

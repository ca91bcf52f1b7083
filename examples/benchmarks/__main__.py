"""`python -m examples.benchmarks`: speed beside error."""

from examples.benchmarks.commands import bench as app

__all__ = ["app"]

if __name__ == "__main__":
    app(prog_name="python -m examples.benchmarks")

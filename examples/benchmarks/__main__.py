"""`python -m examples.benchmarks`: speed beside error, side by side in one run."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec

import typer

from examples.benchmarks.adapting import adapt
from examples.benchmarks.appending import log
from examples.benchmarks.buffers import buffers
from examples.benchmarks.chips.comparison import chips
from examples.benchmarks.fleet import fleet
from examples.benchmarks.health import health
from examples.benchmarks.interleaved import interleaved
from examples.benchmarks.live_decision import decisions
from examples.benchmarks.live_shift import live
from examples.benchmarks.many_materials import many
from examples.benchmarks.node_latency import ros2
from examples.benchmarks.speed import speed
from scroll_tactile.clients.cli.terminal import Commands
from scroll_tactile.libraries import missing

__all__ = ["app"]

app = typer.Typer(
    name="examples.benchmarks",
    cls=Commands,
    no_args_is_help=True,
    help="Measure speed beside error, side by side in one run.",
)
BENCHMARKS: tuple[Callable[..., None], ...] = (
    *(speed, many, live, decisions, ros2),
    *(buffers, interleaved, log, fleet, chips, health, adapt),
)
for benchmark in BENCHMARKS:
    app.command()(benchmark)
if find_spec("flint") is not None:  # python-flint, of the extra `bench`: the exact sums
    from examples.benchmarks.numerics.comparison import numerics

    app.command()(numerics)
else:

    @app.command(name="numerics")
    def without_flint() -> None:
        """Compare exact sums with others; needs python-flint."""
        raise missing("python-flint", "bench", "the comparison with exact sums")


if __name__ == "__main__":
    app(prog_name="python -m examples.benchmarks")

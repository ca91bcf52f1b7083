"""Ten thousand steps of random histories against the model: `python tests/faults/history.py --steps 10000 --seed 0`."""

import argparse
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis.stateful import invariant, run_state_machine_as_test
from test_learner_machine import History

from faults.common import parser, progress, run  # after the path to the tests

LENGTH = 50


def main(options: argparse.Namespace) -> dict[str, Any]:
    """Run the machine; what it finds is a failure, told with the shortest history that leads there."""
    steps, done, failures = 300 if options.quick else options.steps, {"steps": 0, "histories": 0}, []

    class Counted(History):
        @invariant()
        def counted(self) -> None:
            done["steps"] += 1
            if done["steps"] % 1000 == 0:
                progress(f"{done['steps']} steps, {done['histories']} histories")

        def teardown(self) -> None:
            done["histories"] += 1
            super().teardown()

    chosen = settings(
        max_examples=-(-steps // LENGTH) * 2,
        stateful_step_count=LENGTH,
        deadline=None,
        database=None,
        phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
    )
    try:
        run_state_machine_as_test(seed(options.seed)(Counted), settings=chosen)
    except Exception as error:
        failures.append("\n".join([repr(error), *getattr(error, "__notes__", [])]))
    return {**done, "failures": failures}


if __name__ == "__main__":
    run("history", parser(__doc__, steps=10_000).parse_args(), main)

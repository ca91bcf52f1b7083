"""Ten thousand steps of random histories against the model: `python tests/faults/history.py --steps 10000 --seed 0`."""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from hypothesis import HealthCheck, Phase, seed, settings  # after the path to the tests
from hypothesis.stateful import invariant, run_state_machine_as_test
from test_learner_machine import History

LENGTH = 50


def main() -> dict[str, int]:
    """Run the machine; raises what it finds."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    done = {"steps": 0, "histories": 0}

    class Counted(History):
        @invariant()
        def counted(self) -> None:
            done["steps"] += 1
            if done["steps"] % 1000 == 0:
                print(done, flush=True)

        def teardown(self) -> None:
            done["histories"] += 1
            super().teardown()

    chosen = settings(
        max_examples=-(-options.steps // LENGTH) * 2,
        stateful_step_count=LENGTH,
        deadline=None,
        database=None,
        phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
    )
    run_state_machine_as_test(seed(options.seed)(Counted), settings=chosen)
    print(done)
    return done


if __name__ == "__main__":
    main()

"""Histories of a learner against a list of touches; `tests/faults/history.py` does thousands of random steps."""

import random

from faults.history import History
from faults.learners import expected, seen
from faults.plans import KINDS
from hypothesis import HealthCheck, settings

History.TestCase.settings = settings(
    max_examples=2, stateful_step_count=8, deadline=None, suppress_health_check=list(HealthCheck)
)
TestHistory = History.TestCase

# Each operation once while a memory has all of its rows, and all of them in any order behind it.
FIRST = [*["observe"] * 5, "reembed", "pack", "retract", "fleet", "merge what was packed", "reembed"]


def test_after_each_operation_it_is_the_memory_that_was_fed_afresh():
    rng, machine = random.Random(0), History()
    try:
        machine.create()
        for number, kind in enumerate([*FIRST, *rng.sample(KINDS, len(KINDS))]):
            if kind == "reembed":
                machine.reembed(rng)
            elif kind == "fleet":
                machine.learn_as_a_fleet(rng)
            elif kind == "merge what was packed":
                machine.do(("merge", "packed-0", "once", "theirs"))
                assert machine.state.rows[-1][0] == "observe"  # what was retracted came back
            else:
                machine.change(kind, rng)
            assert seen(machine.learner) == expected(machine.state), (number, kind)
    finally:
        machine.teardown()

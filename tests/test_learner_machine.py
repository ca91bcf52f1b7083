"""Histories of a learner against a list of touches; `tests/faults/history.py` does thousands of random steps."""

import random

import pytest
from faults.history import History
from faults.model import expected, seen
from faults.plans import KINDS
from hypothesis import HealthCheck, settings

History.TestCase.settings = settings(
    max_examples=5, stateful_step_count=15, deadline=None, suppress_health_check=list(HealthCheck)
)
TestHistory = History.TestCase

# Each operation once while a memory has all of its rows, and all of them in any order behind it.
FIRST = [*["observe"] * 6, "reembed", "pack", "retract", "fleet", "merge", "reembed"]


@pytest.mark.parametrize("seed", range(2))
def test_after_each_operation_it_is_the_memory_that_was_fed_afresh(seed):
    rng, machine = random.Random(seed), History()
    try:
        machine.create()
        for number, kind in enumerate([*FIRST, *rng.sample(KINDS, len(KINDS))]):
            if kind == "reembed":
                machine.reembed(rng)
            elif kind == "fleet":
                machine.learn_as_a_fleet(rng)
            else:
                machine.change(kind, rng)
            assert seen(machine.learner) == expected(machine.state), (number, kind)
    finally:
        machine.teardown()

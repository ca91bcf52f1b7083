"""A few random histories of a learner against a list of touches; `tests/faults/history.py` does thousands of steps."""

from faults.history import History
from hypothesis import HealthCheck, settings

History.TestCase.settings = settings(
    max_examples=8, stateful_step_count=15, deadline=None, suppress_health_check=list(HealthCheck)
)
TestHistory = History.TestCase

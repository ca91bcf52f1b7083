"""Each bug that the simulation has to find can be put in; `tests/faults/all.py --quick` does a few of each fault."""

import inspect

import pytest

import faults.planted_reads
import faults.planted_writes  # noqa: F401  # which name their bugs
from faults.planting import BUGS, planted


@pytest.mark.parametrize("title", BUGS)
def test_a_bug_can_be_put_in_where_the_simulation_has_to_find_it(title):
    for replacement in BUGS[title]:
        before = replacement.before()
        own = before.fget if isinstance(before, property) else getattr(before, "__func__", before)
        if replacement.spoilt is not None:
            parameters = inspect.signature(own).parameters.values()
            positional = [
                one.name for one in parameters if one.kind in (one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD)
            ]
            named = dict.fromkeys(one.name for one in parameters if one.kind is one.KEYWORD_ONLY)
            inspect.signature(replacement.spoilt).bind(own, *positional, **named)
    with planted(title):
        assert all(replacement.before() is not None for replacement in BUGS[title])

"""A few of each fault of tests/faults, in seconds; the commands there do thousands."""

import inspect
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import faults.planted_reads
import faults.planted_writes  # noqa: F401  # which name their bugs
from faults.planting import BUGS, planted

FAULTS = Path(__file__).parent
COLUMNS = {
    "kill": ["kills", "landed in", "counts"],
    "each_call": ["calls", "steps", "outcomes"],
    "power_cut": ["disks", "histories", "calls written down", "cut in", "styles"],
    "bit_flips": ["flips", "outcomes", "by file"],
    "disk": ["operations", "outcomes"],
    "processes": ["locks", "readers"],
    "latency": ["tiny, 64 features, exemplars=0", "bulk: tiny, 64 features, exemplars=0"],
    "space": ["rows", "large"],
    "hostile": ["cases", "attacks by name", "outcomes"],
    "hostile --recordings": ["cases", "attacks by name", "outcomes"],
    "threads": ["rounds", "calls", "answers looked up"],
    "simulate": ["seeds", "events", "plants"],
}
# What is taken from a memory, or from its disk, must be missed: this many failures are found at least.
HARSH = {"power_cut --without log": 3, "hostile --without gate --cases 15 --seconds 5": 3}

watched = pytest.mark.skipif(
    sys.platform != "linux" or not any(map(shutil.which, ("cc", "gcc", "clang"))),
    reason="needs Linux and a C compiler, for what is done to files",
)


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """The records of quick runs, all in one process that imports everything once."""
    record = tmp_path_factory.mktemp("faults") / "record.json"
    command = [sys.executable, FAULTS / "all.py", "--quick", "--json", record, "--only", *COLUMNS, *HARSH]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=1200)
    assert record.exists(), done.stdout + done.stderr
    return json.loads(record.read_text())


@watched
@pytest.mark.parametrize("name", COLUMNS)
def test_a_few_of_each_fault_do_no_harm(name, records):
    record = records[name]
    assert record["failures"] == []
    assert all(record[column] for column in COLUMNS[name]), record
    assert record["command"].startswith(f"python tests/faults/{name.split()[0]}.py")
    assert record["versions"]["scroll-tactile"]
    if record.get("skipped"):
        pytest.skip("; ".join(record["skipped"]))


@watched
@pytest.mark.parametrize("name", HARSH)
def test_what_would_do_harm_is_noticed(name, records):
    assert len(records[name]["failures"]) >= HARSH[name]


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

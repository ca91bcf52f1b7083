"""Tables of touches with values and labels: learned by one process or a fleet, on the command line, and written out."""

import csv
import json
import shutil

import numpy as np
import pytest
from commands import refused, run
from touches import SETTINGS, stream

from examples.benchmarks.fleet import DyingExecutor
from scroll_tactile import Quantity, TactileLearner
from scroll_tactile.clients.learning.fleet import learn
from scroll_tactile.clients.learning.learning import learn_sources
from scroll_tactile.clients.learning.sources import SourceOptions
from scroll_tactile.errors import AnnotationError, FieldError, InputError
from scroll_tactile.recordings import declared_quantities, read_intervals

FORCE = Quantity(name="force", unit="N", low=0, high=10, resolution=0.01)
HEADING = "file,begin,end,material,force [N] 0..10 step 0.01,slip [label],Notes"
ROWS = [
    "0.npy,0,2,oak,1.4,north,x",
    "1.npy,0,2,oak,,south,y",
    "2.npy,0,2,silk,2.5,,z",
    "3.npy,0,2,silk,,,",
]


@pytest.fixture
def data(tmp_path):
    """Four recordings of a touch each."""
    for i in range(5):
        np.save(tmp_path / f"{i}.npy", stream((i, 60)).astype(np.float32))
    return tmp_path


def table(data, rows=ROWS, heading=HEADING):
    (data / "table.csv").write_text("\n".join([heading, *rows]))
    return data / "table.csv"


def options(path):
    return SourceOptions(intervals=read_intervals(path), quantities=declared_quantities(path))


def sources(data, count=4):
    return [str(data / f"{i}.npy") for i in range(count)]


def expected():
    """What one learner holds that observed these with what is noted of them."""
    learner = TactileLearner(**SETTINGS)
    learner.declare(FORCE)
    noted = [({"force": 1.4}, {"slip": "north"}), ({}, {"slip": "south"}), ({"force": 2.5}, {}), ({}, {})]
    for i, (values, labels) in enumerate(noted):
        learner.observe(["oak", "silk"][i // 2], stream((i, 60)).astype(np.float32), values=values, labels=labels)
    return learner


@pytest.mark.parametrize("fleet", [False, True])
def test_what_is_noted_in_a_table_is_learned_once_and_another_value_is_refused(data, fleet):
    def learned(path):
        made = options(path)
        if not fleet:
            with TactileLearner.open(data / "m", **SETTINGS) as learner:
                done = learn_sources(learner, sources(data), made)
                return done.learned.total(), done.skipped, done.refused
        shutil.rmtree(data / "m.fleet", ignore_errors=True)  # each is a run of its own
        done = learn(data / "m", sources(data), made, client=DyingExecutor(), **SETTINGS, add=True)
        return done.observations, done.repeated, done.refused

    assert learned(table(data)) == (4, 0, [])
    assert learned(table(data)) == (0, 4, [])
    count, repeated, why = learned(table(data, [ROWS[0].replace("1.4", "1.5"), *ROWS[1:]]))
    assert (count, repeated, len(why)) == (0, 3, 1)
    assert "values {'force': 1.4} and labels {'slip': 'north'}" in why[0].why and "values {'force': 1.5}" in why[0].why
    with TactileLearner.open(data / "m", **SETTINGS) as learner:
        whole = expected()
        assert learner.digest() == whole.digest() and learner.axes == whole.axes
        assert learner.quantities == {"force": FORCE}
        with pytest.raises(AnnotationError, match=r"declared as force \[N\] 0..10 step 0.01; came force \[N\] 0..20"):
            learn_sources(learner, [], options(table(data, heading=HEADING.replace("..10", "..20"))))
        # In a later table the heading needs the unit alone.
        later = table(data, ["4.npy,0,2,oak,3,"], "file,begin,end,material,force [N],slip [label]")
        assert learn_sources(learner, [str(data / "4.npy")], options(later)).learned == {"oak": 1}
        assert learner.observations()[-1].values == {"force": 3.0}


def test_a_fleet_learns_by_the_quantities_of_the_memory_that_it_adds_to(data):
    with TactileLearner.open(data / "m", **SETTINGS) as learner:
        learner.declare(FORCE)

    def learned(heading):
        path = table(data, ["0.npy,0,2,oak,1.4"], f"file,begin,end,material,{heading}")
        shutil.rmtree(data / "m.fleet", ignore_errors=True)
        return learn(data / "m", sources(data, 1), options(path), client=DyingExecutor(), **SETTINGS, add=True)

    with pytest.raises(AnnotationError, match=r"declared as force \[N\] 0..10 step 0.01; came force \[N\] 0..20"):
        learned("force [N] 0..20 step 0.01")
    assert "expected 'force' in N" in learned("force [mN]").refused[0].why
    assert learned("force [N]").observations == 1


@pytest.mark.parametrize(
    ("heading", "row", "match"),
    [
        ("force [N] 0..10 step 0.01", "11", "'force' as a number from 0 to 10 N; came 11.0"),
        ("force [N] 0..10 step 0.01", "nan", "came nan"),
        ("force [N]", "1", r"declared quantities, out of \[\]; came \['force'\]"),
        ("slip [label]", "\x07", "printable"),
    ],
)
def test_a_touch_with_what_cannot_be_noted_is_refused_and_the_others_learned(data, heading, row, match):
    path = table(data, [f"0.npy,0,2,oak,{row}", "1.npy,0,2,silk,"], f"file,begin,end,material,{heading}")
    learner = TactileLearner(**SETTINGS)
    done = learn_sources(learner, sources(data, 2), options(path))
    assert done.learned == {"silk": 1} and len(done.refused) == 1
    with pytest.raises(InputError, match=match):
        raise InputError(done.refused[0].why)


def test_another_unit_is_refused_for_each_touch_that_has_a_value(data):
    learner = TactileLearner(**SETTINGS)
    learner.declare(FORCE)
    path = table(data, ["0.npy,0,2,oak,1400", "1.npy,0,2,silk,"], "file,begin,end,material,force [mN]")
    done = learn_sources(learner, sources(data, 2), options(path))
    assert [each.why for each in done.refused] == [
        "expected 'force' in N, as it was declared; came 1400 mN: convert the column, and head it force [N]"
    ]


@pytest.mark.parametrize(
    ("heading", "row", "error", "match"),
    [
        ("force [N]", "much", InputError, r"row 2: expected 'force \[N\]' as a number"),
        ("force [N],force [mN]", "1,1", FieldError, "several columns 'force' with a unit"),
        ("force [N] 0..0 step 1", "1", InputError, "a range whose low"),
    ],
)
def test_a_table_that_cannot_be_is_refused(data, heading, row, error, match):
    path = table(data, [f"0.npy,0,2,oak,{row}"], f"file,begin,end,material,{heading}")
    with pytest.raises(error, match=match):
        options(path)


@pytest.mark.parametrize(
    "quantity",
    [FORCE, Quantity(name="a b [c", unit="°C/s", low=-1.25e-7, high=3, resolution=1e-5)],
    ids=str,
)
def test_a_quantity_is_read_as_it_is_written(quantity):
    assert Quantity.parsed(str(quantity)) == quantity
    for text in ("force", "force [N]", "[N] 0..1 step 1", "force [N] 0..1", "force [N] a..b step c"):
        with pytest.raises(InputError, match="expected a quantity such as"):
            Quantity.parsed(text)


@pytest.mark.parametrize(
    "text", [f"a [N] {'1' * 3000}..{'1' * 3000} step x", f"a{' ' * 20000}x", "a [N]" * 3000 + " 0"]
)
def test_a_long_heading_from_elsewhere_is_refused_at_once(text):
    """Each number could once be read in as many ways as it has digits, which would not end."""
    with pytest.raises(InputError, match="expected a quantity such as"):
        Quantity.parsed(text)


def test_the_command_line_declares_observes_answers_and_lists_them(data, tmp_path):
    memory = str(tmp_path / "m")
    TactileLearner.open(memory, **SETTINGS).close()
    assert "declared: force [N] 0..10 step 0.01, 1000 steps" in run("memory", "declare", memory, str(FORCE)).output
    assert "was declared as" in refused("memory", "declare", memory, "force [mN] 0..10 step 0.01")
    for i in range(4):
        noted = ["--value", f"force={i}", "--axis", f"slip={'ns'[i % 2]}"]
        assert run("observe", memory, "oak", sources(data)[i], *noted).exit_code == 0
    for words, said in (
        (["--value", "force"], "--value as name=what"),
        (["--value", "force=x"], "such as force=1.4: could not convert"),
        (["--value", "force=1", "--value", "force=2"], "each name once"),
        (["--value", "force=99"], "'force' as a number from 0 to 10 N; came 99.0"),
    ):
        assert said in refused("observe", memory, "oak", str(data / "4.npy"), *words)
    answer = json.loads(run("predict", memory, sources(data)[1], "--of", "slip", "--json").output)
    assert answer["material"] == "s" and len(answer["ranking"]) == 2
    lines = run("live", memory, sources(data)[1], "--touch", "--of", "slip", "--json").output.splitlines()
    assert [said["material"] for said in map(json.loads, lines) if "material" in said][-1] == "s"
    assert "expected an axis" in refused("live", memory, sources(data)[1], "--of", "slop")
    listed = [json.loads(line) for line in run("memory", "list", memory, "--json").output.splitlines()]
    assert [row["values"] for row in listed] == [{"force": float(i)} for i in range(4)]
    assert "force=3.0  slip=s" in run("memory", "list", memory).output
    assert run("memory", "export", memory, str(tmp_path / "plain")).exit_code == 0
    with (tmp_path / "plain" / "observations.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row[str(FORCE)], row["slip [label]"]) for row in rows] == [(f"{i}.0", "ns"[i % 2]) for i in range(4)]

"""Values and labels of touches: kept with their row, exact, and refused where they cannot be."""

import math

import pytest
from scroll_tactile_store import Store
from touches import OBSERVED, SETTINGS, filled, stream

from scroll_tactile import Quantity, TactileLearner
from scroll_tactile.errors import AnnotationError, InputError, MismatchError
from scroll_tactile.memory.touch_rows import DECLARE
from scroll_tactile.statistics.annotations import Annotation

FORCE = Quantity(name="force", unit="N", low=-1, high=10, resolution=0.01)
SPEED = Quantity(name="speed", unit="m/s", low=0, high=1, resolution=0.001)
NOTED = (
    [  # of each touch in `OBSERVED`: values and labels
        ({"force": i / 3} if i % 3 else {}) | ({"speed": 0.25} if i == 4 else {}) for i in range(len(OBSERVED))
    ],
    [{"slip": "ns"[i % 2]} if i % 4 else {} for i in range(len(OBSERVED))],
)
ALL = [*zip(OBSERVED, *NOTED, strict=True)]


def feel(learner, noted=ALL, **how):
    """Observe touches with what is noted of them; their receipts."""
    learner.declare(FORCE)
    learner.declare(SPEED)
    return [
        learner.observe(name, stream(touch), values=values, labels=labels, **how)
        for (name, touch), values, labels in noted
    ]


def opened(path, **settings):
    return TactileLearner.open(path, **SETTINGS | settings)


def told(learner):
    """All that is kept of values and labels, to the byte."""
    memory = learner.memory
    chosen = [[(name, key, touch.annotation) for name, key, touch in of] for of in (memory.sample, memory.kept or ())]
    return learner.digest(), memory.targets.digest(), chosen, learner.axes, learner.quantities


@pytest.fixture(scope="module")
def whole():
    """What is kept of all touches by a memory without a path."""
    learner = TactileLearner(**SETTINGS)
    feel(learner)
    return told(learner)


def test_a_value_is_kept_to_its_resolution_in_the_decimals_it_was_written_in():
    assert FORCE.integer(1.4) == 240 and FORCE.value(240) == 1.4
    assert (FORCE.integer(-1), FORCE.integer(10), FORCE.steps) == (0, 1100, 1100)
    assert FORCE.integer(0.005) == 100 and FORCE.integer(0.015) == 102  # halves to the even
    assert Quantity(name="force", unit="N", low=-1.0, high=10, resolution=0.01) == FORCE
    for integer in (-1, 1101):
        with pytest.raises(AnnotationError, match="0 to 1100 steps"):
            FORCE.value(integer)


@pytest.mark.parametrize(
    "wrong",
    [
        *({"name": name} for name in ("", "x" * 201, "a\n", 3)),
        *({"unit": unit} for unit in ("", "x" * 41, "\x1b[2J", None)),
        *({"low": low} for low in (math.nan, -math.inf, 10, "x", -1e9)),
        *({"resolution": resolution} for resolution in (0, -1, math.nan, 1e-9, 100)),
    ],
    ids=str,
)
def test_a_quantity_that_cannot_be_is_refused(wrong):
    with pytest.raises(InputError, match="expected"):
        Quantity(**FORCE.model_dump() | wrong)


@pytest.mark.parametrize("keep", [0, 4])
@pytest.mark.parametrize("packed", [False, True])
def test_a_merge_brings_them_and_a_retraction_takes_them_out(tmp_path, whole, keep, packed):
    with opened(tmp_path / "m") as ours, opened(tmp_path / "o") as theirs:
        feel(ours, ALL[:5])
        feel(theirs, ALL[5:] + (ALL[4:5] if packed and keep else []))
        if packed:
            theirs.pack(tmp_path / "packed")
        elif keep:
            theirs.compact(keep=keep)
        before = len(ours.observations())
        ours.merge(tmp_path / "packed" if packed else theirs)
        assert told(ours) == whole
        again = ours.observe("a", stream((9, 60)), values={"force": 2}, labels={"grip": "firm"})
        assert "grip" in ours.axes and told(ours) != whole
        ours.relabel(again, "b")
        ours.retract(ours.observations()[-1].sequence)
        assert told(ours) == whole
        listed = [(row.values, row.labels) for row in ours.observations()[before : len(ALL)]]
        expected = [Annotation.of(ours.quantities, *noted) for _, *noted in ALL[5:]]
        assert listed == [(one.measured(ours.quantities), dict(one.labels)) for one in expected]
        ours.compact(keep=2)
        assert told(ours) == whole
    with opened(tmp_path / "m") as again:
        assert told(again) == whole


def test_where_there_are_none_a_memory_is_the_one_that_it_was(tmp_path):
    """The same rows, arrays and digest, and not a byte more; a quantity that no touch carries changes no digest."""
    plain, _ = filled(tmp_path / "plain")
    declared, _ = filled(tmp_path / "declared")
    declared.declare(FORCE)
    assert plain.digest() == declared.digest() == plain.memory.statistics.digest()
    for learner in (plain, declared):
        learner.close()
    with Store.open(tmp_path / "plain", mode="read") as store:
        assert not {"values", "labels"} & {name for head in store.heads() for name in head.attributes}
        point = store.latest()
        assert not [name for name in (*point.arrays, *point.attributes) if "quant" in name or "axis" in name]
        assert not [name for name in point.attributes if "target" in name or "annot" in name]
    with Store.open(tmp_path / "declared", mode="read") as store:
        assert [head.kind for head in store.heads()].count(DECLARE) == 1


def test_an_axis_that_every_touch_has_keeps_no_second_moments_of_its_own(tmp_path):
    def own():
        with Store.open(tmp_path / "m", mode="read") as store:
            moments = tuple(f"targets-axes-0-statistics-{what}" for what in ("second", "codes"))
            return [name for name in store.latest().arrays if name.startswith(moments)]

    with opened(tmp_path / "m") as learner:
        feel(learner, [(pair, {}, {"slip": pair[0]}) for pair in OBSERVED])
    assert not own()
    with opened(tmp_path / "m") as learner:
        assert learner.memory.targets.axes["slip"] == learner.memory.statistics
        receipt = learner.observe("a", stream((9, 60)))
        assert learner.axes["slip"] == {"a": 4, "b": 4, "c": 4}
    assert own()
    with opened(tmp_path / "m") as learner:
        learner.retract(receipt)
        assert learner.memory.targets.axes["slip"] == learner.memory.statistics
    assert not own()


def test_the_same_quantity_again_is_no_row_and_another_is_refused(tmp_path):
    with opened(tmp_path / "m") as learner:
        learner.declare(FORCE)
        learner.declare(Quantity(**FORCE.model_dump()))
        assert learner._ledger.store.last == 1
        for changed in ({"unit": "mN"}, {"high": 11}, {"resolution": 0.1}):
            with pytest.raises(AnnotationError, match=r"was declared as force \[N\] -1..10 step 0.01; came force \["):
                learner.declare(FORCE.model_copy(update=changed))
        with pytest.raises(AnnotationError, match="expected a Quantity; came dict"):
            learner.declare(FORCE.model_dump())
        with learner.batch():
            for number in range(63):
                learner.declare(FORCE.model_copy(update={"name": f"force {number}"}))
        with pytest.raises(AnnotationError, match="at most 64 quantities; came 'speed'"):
            learner.declare(SPEED)
        assert len(learner.quantities) == 64
    with opened(tmp_path / "m") as learner:
        assert learner.quantities["force"] == FORCE and len(learner.quantities) == 64


@pytest.mark.parametrize(
    ("noted", "match"),
    [
        ({"values": {"force": math.nan}}, "'force' as a number from -1 to 10 N; came nan"),
        ({"values": {"force": 10.01}}, "from -1 to 10 N; came 10.01"),
        ({"values": {"force": "1"}}, "'force' as a number from -1 to 10 N; came '1'"),
        ({"values": {"force": True}}, "came True"),
        ({"values": {"mass": 1.0}}, r"declared quantities, out of \['force', 'speed'\]; came \['mass'\]: declare it"),
        ({"values": [("force", 1.0)]}, "values as a mapping by name; came list"),
        ({"labels": {"slip": ""}}, "axes and labels as materials' names are: expected a name of 1 to 200"),
        ({"labels": {"slip": 3}}, "came int 3"),
        ({"labels": {"a\nb": "x"}}, "printable"),
        ({"labels": {str(i): "x" for i in range(17)}}, "at most 16 axes; came 17"),
        ({"labels": {str(i): "x" for i in range(16)}}, "at most 16 axes; came .*'slip'"),
        ({"values": {"force": 2.5}}, r"observation 4 has this touch of 'b' with values \{'force': 0.33\} and labels"),
        ({"labels": {"slip": "s"}}, r"came values \{\} and labels \{'slip': 's'\}. Retract it first"),
    ],
    ids=lambda one: str(one)[:40],
)
def test_what_cannot_be_noted_is_refused_and_nothing_changed(tmp_path, noted, match):
    with opened(tmp_path / "m") as learner:
        feel(learner, ALL[:3])
        before = told(learner), learner._ledger.store.last
        name, touch = OBSERVED[1] if "observation" in match or "Retract" in match else ("d", (9, 60))
        with pytest.raises(AnnotationError, match=match):
            learner.observe(name, stream(touch), **noted)
        assert (told(learner), learner._ledger.store.last) == before


@pytest.mark.parametrize("path", [True, False])
def test_the_same_again_is_a_repeat(tmp_path, path):
    with opened(tmp_path / "m") if path else TactileLearner(**SETTINGS) as learner:
        first = feel(learner, ALL[:3])
        assert [receipt.repeated for receipt in feel(learner, ALL[:3])] == [True] * 3
        assert learner.observe("b", stream(OBSERVED[1][1])) == first[1]
        assert learner.memory.targets.sums("force") == {"b": (1, 133, 133**2), "c": (1, 167, 167**2)}


def test_one_that_is_observed_again_after_its_retraction_has_what_is_noted_then(tmp_path):
    (name, touch), (values, other) = OBSERVED[1], ({"force": 1.0}, {"force": 2.5})
    learner, expected = opened(tmp_path / "m"), TactileLearner(**SETTINGS)
    for each in (learner, expected):
        each.declare(FORCE)
    learner.retract(learner.observe(name, stream(touch), values=values))
    for each in (learner, expected):
        each.observe(name, stream(touch), values=other, labels={"slip": "n"})
    assert told(learner) == told(expected)
    learner._ledger.store.close()  # as if the power failed: all rows are replayed
    with opened(tmp_path / "m") as again:
        assert told(again) == told(expected)


def test_a_merge_of_another_unit_or_value_changes_nothing(tmp_path):
    with opened(tmp_path / "m") as ours, opened(tmp_path / "o") as theirs, opened(tmp_path / "p") as third:
        feel(ours, ALL[:5])
        theirs.declare(FORCE.model_copy(update={"unit": "mN"}))
        feel(third, [(ALL[1][0], {"force": 9.0}, {})])
        before = told(ours), ours._ledger.store.last
        with pytest.raises(MismatchError, match=r"declared as force \[N\] -1..10 step 0.01; came force \[mN\]"):
            ours.merge(theirs)
        with pytest.raises(MismatchError, match=r"row 4 of .* has this touch of 'b' with .*; row 3 comes with"):
            ours.merge(third)
        assert (told(ours), ours._ledger.store.last) == before

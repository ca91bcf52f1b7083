"""Values and labels of touches, and what materials are made of: kept with their rows, or refused."""

import math

import pytest
from scroll_tactile_store import Store
from touches import OBSERVED, SETTINGS, filled, require_same, spoil, stream

from scroll_tactile import Quantity, TactileLearner
from scroll_tactile.clients.learning.plain_export import export_plain
from scroll_tactile.errors import AnnotationError, DescriptionError, InputError, MismatchError
from scroll_tactile.statistics.annotations import Annotation

FORCE = Quantity(name="force", unit="N", low=-1, high=10, resolution=0.01)
SPEED = Quantity(name="speed", unit="m/s", low=0, high=1, resolution=0.001)
ALL = [  # touches with values and labels
    (
        pair,
        ({"force": i / 3} if i % 3 else {}) | ({"speed": 0.25} if i == 4 else {}),
        {"slip": "ns"[i % 2]} if i % 4 else {},
    )
    for i, pair in enumerate(OBSERVED)
]


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
    """Not a byte more is written; a quantity that no touch carries changes no digest."""
    with filled(tmp_path / "m")[0] as plain:
        plain.declare(FORCE)
        assert plain.digest() == plain.memory.statistics.digest()
    with Store.open(tmp_path / "m", mode="read") as store:
        assert not {"values", "labels"} & {name for head in store.heads() for name in head.attributes}
        point = store.latest()
        assert not [name for name in (*point.arrays, *point.attributes) if "target" in name or "axis" in name]


def test_an_axis_that_every_touch_has_keeps_no_second_moments_of_its_own(tmp_path):
    for extra in (0, 1):
        with opened(tmp_path / "m") as learner:
            feel(learner, [(pair, {}, {"slip": pair[0]}) for pair in OBSERVED])
            assert learner.memory.targets.axes["slip"] == learner.memory.statistics
            if extra:
                learner.observe("a", stream((9, 60)))
            assert learner.axes["slip"] == {"a": 4, "b": 4, "c": 4}
        with Store.open(tmp_path / "m", mode="read") as store:
            moments = tuple(f"targets-axes-0-statistics-{what}" for what in ("second", "codes"))
            assert any(name.startswith(moments) for name in store.latest().arrays) == bool(extra)


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
    before = told(learner)
    learner._ledger.store.close()  # as if the power failed: all rows are replayed
    with opened(tmp_path / "m") as again:
        assert told(again) == before == told(expected)


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


HARD = {"hardness": [62.0, "Shore A"]}
SAID = {
    "a": {"silk": 0.25, "wool": 0.75, **HARD},
    "b": {"silk": 1.0},
    "d": {"soft": True, "wool": 0.5, "jute": None},
}


def described(path, felt=OBSERVED, said=SAID):
    learner, receipts = filled(path, felt)
    for name, one in said.items():
        learner.describe(name, one)
    return learner, receipts


def test_a_compaction_checkpoint_that_all_is_begun_from_again_has_what_was_said_until_then(path):
    learner, _ = described(path)
    learner.compact(keep=4)  # what was said comes behind it
    learner.describe("a", None)
    store = learner._ledger.store
    learner._ledger._write_checkpoint()
    compaction = store.compaction().number
    store.close()  # as if the power failed
    for folder in (path / "checkpoints").iterdir():
        if int(folder.name) != compaction:
            spoil(path, int(folder.name))
    with TactileLearner.open(path, **SETTINGS) as again:
        assert again.memory.checkpoint == compaction
        require_same(again, OBSERVED, {name: one for name, one in SAID.items() if name != "a"})


def test_of_two_descriptions_one_has_to_be_chosen(path, tmp_path):
    other = SAID | {"a": {"wool": 1.0}}
    ours, _ = described(path, OBSERVED[:6])
    theirs, _ = described(tmp_path / "other", OBSERVED[6:], other)
    with ours, theirs:
        with pytest.raises(MismatchError, match=r"such as 'a': here it is .* there \{'wool': 1.0\}"):
            ours.merge(theirs)
        with pytest.raises(InputError, match="'same', 'ours' or 'theirs'"):
            ours.merge(theirs, descriptions="both")
        require_same(ours, OBSERVED[:6], SAID)
        ours.merge(theirs, descriptions="ours")
        require_same(ours, OBSERVED, SAID)
        assert ours.merge(theirs, descriptions="theirs").described == 1
        require_same(ours, OBSERVED, other)


def test_it_is_written_out_plain(path, tmp_path):
    with described(path)[0] as learner:
        export_plain(learner, tmp_path / "plain")
    rows = (tmp_path / "plain" / "descriptions.csv").read_text(encoding="utf-8").split()
    assert rows[0] == "material,constituent,present,share"
    assert rows[1:4] == ["a,silk,yes,0.25", "a,wool,yes,0.75", "b,silk,yes,1.0"]
    assert rows[4:] == ["d,jute,unknown,", "d,soft,yes,", "d,wool,yes,0.5"]
    properties = (tmp_path / "plain" / "properties.csv").read_text(encoding="utf-8")
    assert properties.split() == ["material,property,value,unit", "a,hardness,62.0,Shore", "A"]


def test_a_property_has_a_value_and_one_unit_for_all_materials(path, tmp_path):
    with described(path, [], {"a": {"hardness": (62, "Shore A")}})[0] as learner:
        assert learner.descriptions == {"a": HARD}
        for wrong, match in (
            ({"hardness": (3.5, "MPa")}, "'b', 'hardness': expected it in Shore A, as of 'a'; came 3.5 MPa"),
            ({"hardness": (float("nan"), "Shore A")}, "the value finite"),
            ({"hardness": (62,)}, "a property as"),
            ({"hardness": ("62", "Shore A")}, "a property as"),
            ({"hardness": (62, "")}, "1 to 40 printable"),
        ):
            with pytest.raises(DescriptionError, match=match):
                learner.describe("b", wrong)
        with pytest.raises(DescriptionError, match="nothing was described yet"):
            learner.compose(stream((7, 25)))  # a property is no constituent
        other, _ = described(tmp_path / "other", [], {"b": {"hardness": (3.5, "MPa")}})
        with other, pytest.raises(MismatchError, match=r"expected it in Shore A, as of 'a'; came 3\.5 MPa"):
            learner.merge(other)
        learner.describe("a", {"hardness": (6.2, "MPa")})  # the only one may change its unit
        assert learner.descriptions == {"a": {"hardness": [6.2, "MPa"]}}
        rows = learner._ledger.store.last
        for share, more in ((1.0, 1), (1, 1), (True, 2)):  # the same again is no row, and one is not true
            learner.describe("b", {"silk": share})
            assert (learner._ledger.store.last, learner.descriptions["b"]) == (rows + more, {"silk": share})

"""What materials are made of is kept as durably as what was observed, and told apart from it."""

import csv

import pytest
from touches import OBSERVED, SETTINGS, filled, require_same, spoil, stream

from scroll_tactile import TactileLearner
from scroll_tactile.clients.learning.plain_export import export_plain
from scroll_tactile.errors import DescriptionError, InputError, MismatchError

HARD = {"hardness": [62.0, "Shore A"]}
SAID = {
    "a": {"silk": 0.25, "wool": 0.75, **HARD},
    "b": {"silk": 1.0},
    "d": {"soft": True, "wool": 0.5, "jute": None},
}


def told(path, felt=OBSERVED, said=SAID):
    learner, receipts = filled(path, felt)
    for name, one in said.items():
        learner.describe(name, one)
    return learner, receipts


def test_the_same_twice_is_one_row_and_one_is_not_true(path):
    with told(path, [])[0] as learner:
        rows = learner._ledger.store.last
        learner.describe("b", {"silk": 1})
        assert learner._ledger.store.last == rows
        learner.describe("b", {"silk": True})
        assert learner._ledger.store.last == rows + 1
        assert learner.descriptions["b"] == {"silk": True}


def test_a_compaction_checkpoint_that_all_is_begun_from_again_has_what_was_said_until_then(path):
    learner, _ = told(path)
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
    ours, _ = told(path, OBSERVED[:6])
    theirs, _ = told(tmp_path / "other", OBSERVED[6:], other)
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
    with told(path)[0] as learner:
        export_plain(learner, tmp_path / "plain")
    with (tmp_path / "plain" / "descriptions.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    assert rows == [
        ["material", "constituent", "present", "share"],
        ["a", "silk", "yes", "0.25"],
        ["a", "wool", "yes", "0.75"],
        ["b", "silk", "yes", "1.0"],
        ["d", "jute", "unknown", ""],
        ["d", "soft", "yes", ""],
        ["d", "wool", "yes", "0.5"],
    ]
    properties = (tmp_path / "plain" / "properties.csv").read_text(encoding="utf-8")
    assert properties.split() == ["material,property,value,unit", "a,hardness,62.0,Shore", "A"]


def test_a_property_has_a_value_and_one_unit_for_all_materials(path, tmp_path):
    with told(path, [], {"a": {"hardness": (62, "Shore A")}})[0] as learner:
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
        other, _ = told(tmp_path / "other", [], {"b": {"hardness": (3.5, "MPa")}})
        with other, pytest.raises(MismatchError, match=r"expected it in Shore A, as of 'a'; came 3\.5 MPa"):
            learner.merge(other)
        learner.describe("a", {"hardness": (6.2, "MPa")})  # the only one may change its unit
        assert learner.descriptions == {"a": {"hardness": [6.2, "MPa"]}}

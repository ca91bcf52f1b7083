"""`CURRENT`: lost, damaged, forged or of another time, it is named, and never believed beyond what it names."""

import json
import shutil

import pytest
from forging import describe_again, get_current, log_of, set_current
from scroll_tactile_store import DamageError, NotAStoreError, Store, VersionError, check_store, repair_store
from second_reader import digest
from store_builds import IDENTITY, LAST, add, agrees, commit, contents, damage, flip, in_turns, is_refused, newest

HARMS = {
    "gone": lambda file: file.unlink(),
    "cut off": lambda file: file.write_bytes(file.read_bytes()[:-9]),
    "a flipped bit": lambda file: flip(file, 60),
    "too long": lambda file: file.write_text(json.dumps({"x": "x" * 2**17})),
    "nested": lambda file: file.write_text('{"x":' + "[" * 9000 + "]" * 9000 + "}"),
    "zeros": lambda file: file.write_bytes(bytes(len(file.read_bytes()))),
}


@pytest.mark.parametrize(("which", "harm"), in_turns(HARMS), ids=HARMS, indirect=["which"])
def test_what_is_lost_with_it_is_nothing(either, which, harm):
    harm(either / "CURRENT")
    before = contents(either)
    assert is_refused(either, identity={"for": "another"}).path == either / "CURRENT"
    assert [problem.kind for problem in damage(either)] == ["spare"]
    after = contents(either)
    assert {name: after[name] for name in before} == before
    done = repair_store(either)
    assert (done.kept, done.lost) == (LAST, [])
    assert agrees(either, compacted=6 if which else 0, latest=15)
    with Store.open(either) as opened:
        add(opened, LAST + 1)
        commit(opened.compact, LAST + 1)


def placed(offset=None, number=None, previous=None):
    """The newest checkpoint at another place in the log."""

    def changes(known):
        place = [new or old for new, old in zip((offset, number, previous), known["newest"]["place"], strict=True)]
        return {"newest": known["newest"] | {"place": place}}

    return changes


def named(**changes):
    return lambda known: {"newest": known["newest"] | changes}


def logged(number=1, identity=None):
    return lambda known: {"log": [number, identity or known["log"][1]]}


CURRENTS = {  # what it says in place of what it said; all but the last are about numbers and texts that nobody wrote
    "no log": lambda known: {"log": None},
    "a log in words": logged("../../log"),
    "a text for a checkpoint": lambda known: {"newest": "x"},
    "a checkpoint without a place": named(place=None),
    "a last row in words": named(last_sequence="15"),
    "a number above any": named(number=2**64),
    "a log that is not there": logged(7),
    "a log of the last number": logged(2**63 - 1),
    "a log of another identity": logged(1, "00" * 8),
    "a place in no frame": placed(offset=500),
    "a place beyond the end": placed(offset=2**40),
    "a place of another number": placed(number=3),
    "a place of another checksum": placed(previous="00" * 16),
}


@pytest.mark.parametrize("changes", CURRENTS.values(), ids=CURRENTS)
def test_what_it_never_said_is_named_and_repaired(plain, changes):
    log, before = log_of(plain), log_of(plain).read_bytes()
    set_current(plain, **changes(get_current(plain)))
    is_refused(plain, "repair the store|another store")
    assert damage(plain)
    assert repair_store(plain).kept == LAST or get_current(plain)["compaction"] is not None
    assert damage(plain) == []
    assert before in (log.read_bytes() if log.exists() else None, *contents(plain).values())  # kept aside
    with Store.open(plain) as opened:
        assert add(opened, opened.last + 1).sequence == opened.last
    assert damage(plain) == []


def test_a_log_and_a_checkpoint_of_another_store_are_not_believed(plain, tmp_path):
    with Store.open(tmp_path / "other", identity=IDENTITY | {"other": True}) as other:
        for number in range(1, 4):
            add(other, number)
        commit(other.commit, 3)
    mixed = shutil.copytree(plain, tmp_path / "mixed")
    shutil.copy(log_of(tmp_path / "other"), log_of(mixed))
    is_refused(mixed, r"another store|holds no batch")
    assert "another store" in " ".join(problem.what for problem in damage(mixed))
    # A checkpoint of the other, named by a forged CURRENT.
    shutil.rmtree(newest(plain))
    shutil.copytree(newest(tmp_path / "other"), newest(plain))
    known = get_current(tmp_path / "other")["newest"]
    set_current(plain, **named(last_sequence=3, sha256=known["sha256"])(get_current(plain)))
    assert "another store" in " ".join(problem.what for problem in damage(plain))
    repair_store(plain)
    assert damage(plain) == []
    with Store.open(plain) as opened:
        assert (opened.last, opened.latest()) == (LAST, None)


# Other formats.


def raise_the_logs_version(path):
    data = bytearray(log_of(path).read_bytes())
    data[6] = 2
    data[72:88] = digest(bytes(data[:72]))
    log_of(path).write_bytes(data)


def latest(path):
    with Store.open(path, mode="read") as opened:
        return opened.latest()


UPGRADE, USES = r"format \d; this release reads format \d: upgrade", (latest, Store.open, check_store, repair_store)
FORMATS = {
    # what is done; what is said; to whom
    "a newer CURRENT": (lambda path: set_current(path, format=4), UPGRADE, USES),
    "a newer one of another kind": (lambda path: set_current(path, format=4, log=None, more=[1]), UPGRADE, USES),
    "a newer log": (raise_the_logs_version, UPGRADE, USES),
    "format 1": (lambda path: set_current(path, format=1), r"format 1, by .* 0\.15 .*learn it again", USES),
    "format 2": (lambda path: set_current(path, format=2), r"format 2, by .* 0\.16 to 0\.18; .*learn it again", USES),
    "a checkpoint of format 1": (lambda path: describe_again(path, format=1), "format 1, ", USES[:1]),
    "a checkpoint of format 4": (lambda path: describe_again(path, format=4), "format 4; ", USES[:1]),
}


@pytest.mark.parametrize(("which", "make", "said", "uses"), in_turns(FORMATS), ids=FORMATS, indirect=["which"])
def test_another_format_is_refused_by_name_and_not_touched(either, make, said, uses):
    make(either)
    before = contents(either)
    for use in uses:
        with pytest.raises(VersionError, match=said):
            use(either)
    assert contents(either) == before
    if get_current(either)["format"] == 4:
        flip(either / "CURRENT", -20)  # where that is not what was written, nothing is said of a format
        with pytest.raises(DamageError):
            Store.open(either)


def test_of_an_empty_store_nothing_is_lost_with_it(tmp_path):
    Store.open(tmp_path, identity={"a": 1}).close()
    (tmp_path / "CURRENT").unlink()
    with pytest.raises(NotAStoreError):
        Store.open(tmp_path, mode="read")
    with Store.open(tmp_path, identity={"a": 2}) as opened:
        assert opened.identity == {"a": 2}

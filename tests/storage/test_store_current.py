"""`CURRENT`: lost, damaged, forged or of another time, it is named, and never believed beyond what it names."""

import json
import shutil

import pytest
from forging import frames_of, get_current, log_of, set_current, write_log
from scroll_tactile_store import DamageError, NotAStoreError, Store, VersionError, check_store, repair_store
from scroll_tactile_store.layout import log_path
from scroll_tactile_store.records import payload_digest
from store_builds import (
    IDENTITY,
    LAST,
    add,
    agrees,
    commit,
    contents,
    cut_rows,
    damage,
    flip,
    folders,
    in_turns,
    newest,
)

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
    for mode in ("read", "write"):
        with pytest.raises(DamageError, match="repair") as caught:
            Store.open(either, mode=mode, identity={"for": "another"})
        assert caught.value.path == either / "CURRENT"
    assert [problem.kind for problem in damage(either)] == ["spare"]
    after = contents(either)
    assert {name: after[name] for name in before} == before
    done = repair_store(either)
    assert (done.kept, done.lost) == (LAST, [])
    assert agrees(either, compacted=6 if which else 0, latest=15)
    with Store.open(either) as opened:
        add(opened, LAST + 1)
        commit(opened.compact, LAST + 1)


def newest_is(path, **changes):
    """What `CURRENT` says of the newest checkpoint, with changes."""
    return dict(get_current(path)["newest"]) | changes


def placed(path, **changes):
    """The newest checkpoint at another place in the log."""
    place = dict(zip(("offset", "number", "previous"), newest_is(path)["place"], strict=True)) | changes
    return {"newest": newest_is(path, place=list(place.values()))}


CURRENTS = {
    "no log": lambda path: {"log": None},
    "a log in words": lambda path: {"log": ["../../log", get_current(path)["log"][1]]},
    "a log that is not there": lambda path: {"log": [7, get_current(path)["log"][1]]},
    "a log of the last number": lambda path: {"log": [2**63 - 1, get_current(path)["log"][1]]},
    "a log of another identity": lambda path: {"log": [get_current(path)["log"][0], "00" * 8]},
    "a text for a checkpoint": lambda path: {"newest": "x"},
    "a checkpoint without a place": lambda path: {"newest": newest_is(path, place=None)},
    "a last row in words": lambda path: {"newest": newest_is(path, last_sequence="15")},
    "a number above any": lambda path: {"newest": newest_is(path, number=2**64)},
    "a place in no frame": lambda path: placed(path, offset=newest_is(path)["place"][0] + 1),
    "a place beyond the end": lambda path: placed(path, offset=2**40),
    "a place of another number": lambda path: placed(path, number=3),
    "a place of another checksum": lambda path: placed(path, previous="00" * 16),
}


@pytest.mark.parametrize("changes", CURRENTS.values(), ids=CURRENTS)
def test_what_it_never_said_is_named_and_repaired(plain, changes):
    set_current(plain, **changes(plain))
    with pytest.raises(DamageError, match=r"repair the store|another store"):
        Store.open(plain)
    assert damage(plain)
    try:
        with Store.open(plain, mode="read") as opened:  # which can begin at the beginning
            assert [head.sequence for head in opened.heads()] == list(range(1, LAST + 1))
    except DamageError:
        pass
    before = log_path(plain, 1).read_bytes()
    repair_store(plain)
    assert damage(plain) == []
    assert before in contents(plain).values()  # kept aside, if anything of it was not believed
    with Store.open(plain) as opened:
        assert add(opened, opened.last + 1).sequence == opened.last
    assert damage(plain) == []


@pytest.mark.parametrize("current", ["of now", "gone"])
def test_of_several_logs_the_one_with_the_last_row_is_gone_on_from(plain, current):
    """Compaction failed just before `CURRENT`, the store went on, and then the disk lost some of it."""
    other = log_path(plain, 3)
    shutil.copy(log_of(plain), other)
    with Store.open(plain, mode="read"):
        cut_rows(plain, 19)
    if current == "of now":
        log_of(plain).rename(log_path(plain, 2))
        set_current(plain, log=[7, get_current(plain)["log"][1]])
    else:
        (plain / "CURRENT").unlink()
    assert damage(plain)
    assert repair_store(plain).kept == LAST
    assert agrees(plain, latest=15)


def test_a_log_and_a_checkpoint_of_another_store_are_not_believed(plain, tmp_path):
    with Store.open(tmp_path / "other", identity=IDENTITY | {"other": True}) as other:
        for number in range(1, 4):
            add(other, number)
        commit(other.commit, 3)
    mixed = shutil.copytree(plain, tmp_path / "mixed")
    shutil.copy(log_of(tmp_path / "other"), log_of(mixed))
    for mode in ("read", "write"):
        with pytest.raises(DamageError, match=r"another store|holds no batch"):
            Store.open(mixed, mode=mode)
    assert "another store" in damage(mixed)[0].what
    # A checkpoint of the other, named by a forged CURRENT.
    shutil.rmtree(newest(plain))
    shutil.copytree(newest(tmp_path / "other"), newest(plain))
    set_current(
        plain, newest=newest_is(plain, last_sequence=3, sha256=get_current(tmp_path / "other")["newest"]["sha256"])
    )
    assert "another store" in " ".join(problem.what for problem in damage(plain))
    repair_store(plain)
    assert damage(plain) == []
    with Store.open(plain) as opened:
        assert (opened.last, opened.latest()) == (LAST, None)


def refuses_the_format(path):
    before = contents(path)
    for call in (Store.open, lambda path: Store.open(path, mode="read"), check_store, repair_store):
        with pytest.raises(VersionError, match=r"format \d; this release reads format \d: upgrade"):
            call(path)
    assert contents(path) == before


@pytest.mark.parametrize("more", [{}, {"log": None, "more": [1]}])
def test_a_newer_format_is_refused_and_not_touched(either, more):
    set_current(either, format=4, **more)
    refuses_the_format(either)
    flip(either / "CURRENT", -20)  # and where that is not what was written, nothing is said of a format
    with pytest.raises(DamageError):
        Store.open(either)


def test_a_newer_log_is_refused_and_not_touched(plain):
    data = bytearray(log_of(plain).read_bytes())
    data[6] = 2
    data[72:88] = payload_digest(bytes(data[:72]))
    log_of(plain).write_bytes(data)
    refuses_the_format(plain)


def test_an_older_format_is_refused_by_name_and_not_touched(plain):
    set_current(plain, format=1)
    before = contents(plain)
    for attempt in (Store.open, repair_store):
        with pytest.raises(VersionError, match=r"format 1, by scroll-tactile 0\.15 .*learn it again"):
            attempt(plain)
    assert contents(plain) == before


def test_of_an_empty_store_nothing_is_lost_with_it(tmp_path):
    Store.open(tmp_path, identity={"a": 1}).close()
    (tmp_path / "CURRENT").unlink()
    with pytest.raises(NotAStoreError):
        Store.open(tmp_path, mode="read")
    with Store.open(tmp_path, identity={"a": 2}) as opened:
        assert opened.identity == {"a": 2}


@pytest.mark.parametrize("harm", ["an older frame at the end", "a frame that is no row"])
def test_what_was_never_appended_keeps_all_out(plain, harm):
    if harm == "a frame that is no row":
        write_log(plain, [b"no row"])
    else:
        frame, data = frames_of(plain)[18], log_of(plain).read_bytes()
        log_of(plain).write_bytes(data + data[frame.offset : frame.end])
    for mode in ("read", "write"):
        with pytest.raises(DamageError, match="repair the store"):
            Store.open(plain, mode=mode)
    assert damage(plain)
    kept = repair_store(plain).kept
    assert kept == (15 if harm == "a frame that is no row" else LAST)
    assert folders(plain) == ["00000001"]
    assert agrees(plain, kept=kept, latest=15, **({} if kept == LAST else {"compacted": 15, "lost": range(1, 16)}))

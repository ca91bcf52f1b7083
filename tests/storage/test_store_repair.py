"""Repairing a store: the longest part that verifies is kept, what is lost is named, and nothing is thrown away."""

import json
import os
import shutil
import sqlite3
import subprocess
import threading
from contextlib import closing

import pytest
import store.header
from store_builds import (
    IDENTITY,
    LAST,
    add,
    as_after_a_crash,
    change,
    commit,
    contents,
    damage,
    flip,
    folders,
    query,
    same_arrays,
    spoil,
    state,
    two_kept,
    values,
)

import store.repair
import store.store
from store import (
    CompactedError,
    DamageError,
    LockedError,
    ReadOnlyError,
    Repair,
    Store,
    StoreFullError,
    check_store,
    repair_store,
)
from store.journal import Journal


@pytest.fixture
def path(plain):
    return plain


def agrees(path, *, kept, base=0, latest=None, lost=()):
    """A store of rows 1 to `kept`, of which those up to `base` have no arrays and those in `lost` are not there."""
    assert damage(path) == []
    for mode in ("read", "write"):
        with Store.open(path, mode=mode) as opened:
            assert (opened.identity, opened.last, opened.compacted) == (IDENTITY, kept, base)
            rows = [(row.sequence, row.label, row.key, row.attributes) for row in opened.heads()]
            expected = [n for n in range(1, kept + 1) if n not in lost]
            assert rows == [(n, f"row {n}", bytes([n]), {"n": n}) for n in expected]
            rows = [(row.sequence, row.arrays["x"].tobytes()) for row in opened.records(base)]
            assert rows == [(n, values(n).tobytes()) for n in range(base + 1, kept + 1)]
            for number in range(1, base + 1):
                with pytest.raises(CompactedError):
                    opened.record(number)
            for found, upto in ((opened.latest(), latest), (opened.base(), base or None)):
                assert (found and found.upto) == upto
                if found:
                    assert found.attributes == {"n": upto}
                    assert same_arrays(found.arrays, state(upto))
    return True


def goes_on(path):
    """New rows are numbered behind those that were kept, and generations can be made."""
    with Store.open(path) as opened:
        number = opened.last + 1
        assert add(opened, number).sequence == number
        commit(opened.commit, number)
        commit(opened.compact, number)
        assert opened.base().upto == number
    assert damage(path) == []
    return True


def test_a_sound_store_is_left_as_it_is(either):
    path = either
    shutil.copytree(path / "generations" / "00000002", path / "generations" / "00000009")
    before = contents(path)
    assert repair_store(path) == Repair(LAST, [], None)
    after = contents(path)
    assert {name: after[name] for name in before} == before
    assert after.keys() - before.keys() <= {"lock"}


HARMS = {
    # a statement about row {0} and the next, {1}; what is said of it; how many heads are lost
    "a damaged head": ("UPDATE record SET label = 'z' WHERE sequence = {0}", "row {0} fails its checksum", 1),
    "a damaged checksum": ("UPDATE record SET checksum = x'00' WHERE sequence = {0}", "row {0} fails its checksum", 1),
    "a missing row": ("DELETE FROM record WHERE sequence = {0}", "row {0} is missing", 1),
    "missing rows": ("DELETE FROM record WHERE sequence IN ({0}, {1})", "rows {0} to {1} are missing", 2),
    "damaged arrays": (
        "UPDATE payload SET bytes = zeroblob(9) WHERE sequence = {0}",
        "row {0} has arrays that fail",
        0,
    ),
    "arrays of the next": (
        "UPDATE payload SET bytes = (SELECT bytes FROM payload WHERE sequence = {1}) WHERE sequence = {0}",
        "row {0} has arrays that fail",
        0,
    ),
    "missing arrays": ("DELETE FROM payload WHERE sequence = {0}", "row {0} has lost its arrays", 0),
}


@pytest.mark.parametrize("row", [8, 18])
@pytest.mark.parametrize(("statement", "said", "gone"), HARMS.values(), ids=HARMS)
def test_a_lost_row_is_found_and_stays_in_its_generation_or_ends_the_store(either, which, statement, said, gone, row):
    change(either, statement.format(row, row + 1))
    said = said.format(row, row + 1)
    problems = check_store(either)
    assert {problem.path for problem in problems} == {either / "journal.sqlite"}
    # The arrays that belong to a missing row are named, too, but not as another loss.
    (lost,) = [problem.what for problem in problems if problem.kind == "lost"]
    assert said in lost
    done = repair_store(either)
    if row == 18:  # behind the newest generation
        assert done.kept == 17
        (lost,) = done.lost
        assert lost.startswith(f"rows 18 to 20 are dropped, also those that verify: {said}")
        assert agrees(either, kept=17, base=6 if which else 0, latest=15)
    else:
        assert done.kept == LAST
        assert said in done.lost[0]
        assert "in generation 2, but can no longer be retracted" in done.lost[0]
        assert "rows 1 to 15 give up their arrays, generation 2 stands for them" in done.lost[-1]
        assert agrees(either, kept=LAST, base=15, latest=15, lost=range(8, 8 + gone))
    assert goes_on(either)


def test_a_lost_head_of_a_compacted_row_is_left_out_and_no_more(compacted):
    change(compacted, "UPDATE record SET key = x'' WHERE sequence = 3", "DELETE FROM record WHERE sequence = 5")
    done = repair_store(compacted)
    assert [lost.split(";")[0] for lost in done.lost] == ["row 3 fails its checksum", "row 5 is missing"]
    assert agrees(compacted, kept=LAST, base=6, latest=15, lost=[3, 5])
    with Store.open(compacted, mode="read") as opened:
        assert [head.sequence for head in opened.heads(kind="a")][:4] == [1, 2, 4, 6]
    # They are named as lost once; another one that goes is damage.
    change(compacted, "DELETE FROM record WHERE sequence = 4")
    with Store.open(compacted) as opened, pytest.raises(DamageError, match="rows 4 to 4 are missing"):
        list(opened.heads())
    repair_store(compacted)
    assert agrees(compacted, kept=LAST, base=6, latest=15, lost=[3, 4, 5])
    assert goes_on(compacted)
    with Store.open(compacted) as opened:
        assert [head.sequence for head in opened.heads()] == [1, 2, *range(6, LAST + 2)]


GENERATIONS = {
    # compacted, generations spoilt, rows lost: kept, base, latest, what is said of rows
    "the newest": ((False, [2], ""), (LAST, 0, 10, [])),
    "all": ((False, [1, 2], ""), (LAST, 0, None, [])),
    "all, and rows": ((False, [1, 2], "4, 12"), (3, 0, None, ["rows 4 to 20 are dropped"])),
    "the base": ((True, [3], ""), (LAST, 15, 15, ["rows 1 to 15 give up their arrays, generation 2 stands for them"])),
    "the newest beside a base": ((True, [2], ""), (LAST, 6, 6, [])),
    "both": ((True, [2, 3], ""), (0, 0, None, ["rows 1 to 20 are dropped"])),
}


@pytest.mark.parametrize(("harm", "expected"), GENERATIONS.values(), ids=GENERATIONS)
def test_damaged_generations_are_put_aside_and_the_next_best_gone_on_from(stores, tmp_path, harm, expected):
    (base, spoilt, rows), (kept, upto, latest, said) = harm, expected
    path = shutil.copytree(stores[base], tmp_path / "s")
    for number in spoilt:
        spoil(path, number)
    change(path, f"DELETE FROM payload WHERE sequence IN ({rows})")
    before = {number: contents(path / "generations" / f"{number:08d}") for number in spoilt}
    done = repair_store(path)
    assert (done.kept, done.aside) == (kept, path / "journal.sqlite.damaged")
    said = [*said, *(f"generation {number}: array 'rows'" for number in spoilt)]
    assert [text[: len(begin)] for text, begin in zip(done.lost, said, strict=True)] == said
    assert agrees(path, kept=kept, base=upto, latest=latest)
    for number in spoilt:
        assert contents(path / "generations" / f"{number:08d}.damaged") == before[number]
    assert goes_on(path)


def test_a_generation_that_does_not_tell_what_it_is_is_written_again(compacted):
    for number in (2, 3):
        header = compacted / "generations" / f"{number:08d}" / "zarr.json"
        known = json.loads(header.read_text())
        known["attributes"]["upto"] = 99
        header.write_text(json.dumps(known))
    assert repair_store(compacted).lost == []
    assert agrees(compacted, kept=LAST, base=6, latest=15)
    with Store.open(compacted) as opened:
        assert {opened.base().number, opened.latest().number} == {4, 5}
    assert goes_on(compacted)


KNOWN_TWICE = [
    *(f"UPDATE generation SET {column}" for column in ("upto = 3", "content = '{}'", "base = 0", "checksum = x''")),
    "UPDATE meta SET value = '{}' WHERE key = 'identity'",
    "DELETE FROM meta",
    "UPDATE meta SET checksum = x'' WHERE key = 'created'",
    "INSERT INTO payload VALUES (1, x'00') ON CONFLICT DO UPDATE SET bytes = x'00'",
    # Of the first page: place and bit of its magic, page size, way of writing, encoding, version, id, a table's place.
    *((0, 0), (16, 0), (18, 2), (59, 1), (63, 2), (70, 1), (4096 - 200, 0)),
]


@pytest.mark.parametrize("harm", KNOWN_TWICE, ids=str)
def test_what_is_known_twice_is_not_lost(compacted, harm):
    if isinstance(harm, str):
        change(compacted, harm)
    else:
        flip(compacted / "journal.sqlite", *harm)
    done = repair_store(compacted)
    assert done.lost == []
    assert done.aside is not None
    assert agrees(compacted, kept=LAST, base=6, latest=15)


def test_without_any_identity_nothing_is_done(path):
    shutil.rmtree(path / "generations")
    change(path, "DELETE FROM meta WHERE key = 'identity'")
    before = contents(path)
    with pytest.raises(DamageError, match=r"tells what the store .* is for"):
        repair_store(path)
    after = contents(path)
    assert {name: after[name] for name in before if name != "holder.json"} == before


@pytest.mark.parametrize("pages", [2, 5, 9, 12, 20])
def test_a_journal_that_was_cut_off_gives_what_it_still_has(path, pages):
    file = path / "journal.sqlite"
    file.write_bytes(file.read_bytes()[: 4096 * pages])
    done = repair_store(path)
    assert 15 <= done.kept <= LAST
    with Store.open(path) as opened:
        base = opened.compacted
        rows = {head.sequence for head in opened.heads()}
    assert base in (0, 15)
    assert agrees(path, kept=done.kept, base=base, latest=15, lost=set(range(1, base + 1)) - rows)
    assert goes_on(path)


@pytest.mark.parametrize("how", ["deleted", "empty", "stub", "text"])
def test_without_a_journal_the_newest_generation_is_gone_on_from(either, which, how):
    path = either
    file = path / "journal.sqlite"
    if how == "deleted":
        file.unlink()
    else:
        file.write_bytes({"empty": b"", "stub": b"SQLite format 3\0", "text": b"dear diary" * 900}[how])
    with pytest.raises(DamageError, match="generations but no .* repair" if how == "deleted" else "repair"):
        Store.open(path, identity={"for": "another"})
    done = repair_store(path)
    assert done.kept == 15
    assert done.aside == (None if how == "deleted" else path / "journal.sqlite.damaged")
    assert f"rows 1 to 15 {'cannot be read' if how == 'text' else 'are missing'}" in done.lost[0]
    if how != "text":
        assert "the rows behind 15, if there were any, are lost" in done.lost[-1]
    assert agrees(path, kept=15, base=15, latest=15, lost=range(1, 16))
    assert goes_on(path)


def test_a_log_without_its_journal_never_meets_the_new_one(path, tmp_path):
    """Its frames would be taken for changes to the repaired file."""
    with Store.open(path) as opened:
        for number in range(21, 40):
            add(opened, number)
        copy = as_after_a_crash(opened, tmp_path / "copy")
    log = (copy / "journal.sqlite-wal").read_bytes()
    assert len(log) > 10 * 4096
    (copy / "journal.sqlite").unlink()
    done = repair_store(copy)
    assert (done.kept, done.aside) == (15, None)
    assert (copy / "journal.sqlite.damaged-wal").read_bytes() == log
    assert agrees(copy, kept=15, base=15, latest=15, lost=range(1, 16))


def test_what_the_log_holds_is_kept_with_the_damaged_journal(path, tmp_path):
    with Store.open(path) as opened:
        for number in range(21, 25):
            add(opened, number)
        copy = as_after_a_crash(opened, tmp_path / "copy")
    spoil(copy, 2)
    log, main = (copy / "journal.sqlite-wal").read_bytes(), (copy / "journal.sqlite").read_bytes()
    done = repair_store(copy)
    assert done.kept == 24
    assert agrees(copy, kept=24, latest=10)
    assert done.aside.read_bytes() == main
    assert (copy / "journal.sqlite.damaged-wal").read_bytes() == log
    # And whoever looks into it there can read it, with all its rows.
    with closing(sqlite3.connect(done.aside)) as connection:
        assert connection.execute("SELECT count(*) FROM record").fetchone() == (24,)


def test_a_journal_of_another_store_keeps_its_rows_and_no_generation_of_this_one(path, tmp_path):
    with two_kept(), Store.open(tmp_path / "other", identity=IDENTITY | {"other": True}) as other:
        for number in range(1, 4):
            add(other, number)
        for upto in (2, 3):
            commit(other.commit, upto)
    shutil.copy(tmp_path / "other" / "journal.sqlite", path / "journal.sqlite")
    assert "another identity" in " ".join(problem.what for problem in damage(path))
    done = repair_store(path)
    assert done.kept == 3
    assert folders(path) == ["00000001.damaged", "00000002.damaged"]
    assert damage(path) == []
    with Store.open(path) as opened:
        assert opened.identity == IDENTITY | {"other": True}
        assert opened.latest() is None
        assert len(list(opened.records())) == 3


def test_damaged_journals_are_never_written_over(path):
    for expected in ("journal.sqlite.damaged", "journal.sqlite.damaged-2", "journal.sqlite.damaged-3"):
        with Store.open(path) as opened:
            last = opened.last
        change(path, f"UPDATE record SET label = 'z' WHERE sequence = {last}")
        done = repair_store(path)
        assert done.aside == path / expected
        assert done.kept == last - 1
    assert len([problem for problem in check_store(path) if problem.kind == "leftover"]) >= 3
    assert agrees(path, kept=17, latest=15)


def test_what_a_repair_lost_is_noted_in_the_journal(path):
    change(path, "DELETE FROM record WHERE sequence = 8")
    done = repair_store(path)
    ((noted,),) = query(path, "SELECT value FROM meta WHERE key = 'repaired'")
    assert json.loads(noted) == {
        "aside": "journal.sqlite.damaged",
        "heads": [[8, 8]],
        "kept": LAST,
        "lost": done.lost,
    }


def test_progress_is_told(path):
    change(path, "DELETE FROM record WHERE sequence = 18")
    told = []
    repair_store(path, progress=lambda *step: told.append(step))
    assert {"generations", "rows written"} <= {what for what, _, _ in told}


def test_while_a_writer_has_it_nothing_is_done(path):
    change(path, "DELETE FROM record WHERE sequence = 18")
    with Store.open(path), pytest.raises(LockedError, match=f"process {os.getpid()}"):
        repair_store(path)
    assert repair_store(path).kept == 17


def test_a_folder_that_may_not_be_written_is_left(path, small_disk):
    change(path, "DELETE FROM record WHERE sequence = 18")
    shutil.copytree(path, small_disk / "s")
    subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
    with pytest.raises(ReadOnlyError):
        repair_store(small_disk / "s")
    assert "row 18 is missing" in " ".join(problem.what for problem in damage(small_disk / "s"))


def test_a_full_disk_leaves_the_damaged_store_as_it_was(path, small_disk):
    change(path, "DELETE FROM record WHERE sequence = 18")
    shutil.copytree(path, small_disk / "s")
    (small_disk / "ballast").write_bytes(bytes(shutil.disk_usage(small_disk).free - 3 * 4096))
    journal = (small_disk / "s" / "journal.sqlite").read_bytes()
    with pytest.raises(StoreFullError):
        repair_store(small_disk / "s")
    assert (small_disk / "s" / "journal.sqlite").read_bytes() == journal
    (small_disk / "ballast").unlink()
    assert repair_store(small_disk / "s").kept == 17
    assert agrees(small_disk / "s", kept=17, latest=15)


class KilledError(BaseException):
    pass


def steps_of(monkeypatch, last):
    """Kill the repair before its step `last`: a step is a rename, a sync, a removal or a file that SQLite makes."""
    count = [0]

    def killing(owner, name):
        real = getattr(owner, name)

        def step(*args, **options):
            count[0] += 1
            if count[0] == last:
                raise KilledError
            return real(*args, **options)

        monkeypatch.setattr(owner, name, step)

    killing(os, "rename")
    killing(os, "fsync")
    killing(shutil, "rmtree")
    killing(store.repair, "build_journal")
    killing(store.repair, "_verify")
    return count


@pytest.mark.parametrize("how", ["row", "row and generation", "no journal", "description"])
def test_killed_before_any_step_it_can_be_begun_again(stores, tmp_path, monkeypatch, how):
    source = shutil.copytree(stores[how == "description"], tmp_path / "source")
    if how == "no journal":
        (source / "journal.sqlite").unlink()
    elif how == "description":
        flip(source / "generations" / "00000002" / "zarr.json", 100)
        assert [problem.kind for problem in damage(source)] == ["spare"]
    else:
        change(source, "DELETE FROM payload WHERE sequence IN (8, 18)")
    if how == "row and generation":
        spoil(source, 1)
    whole = shutil.copytree(source, tmp_path / "whole")
    expected = repair_store(whole)
    i, interrupted, stride = 0, 0, 1 if how == "row" else 3
    while True:
        i += stride
        path = shutil.copytree(source, tmp_path / str(i))
        with monkeypatch.context() as broken:
            count = steps_of(broken, i)
            try:
                repair_store(path)
            except KilledError:
                interrupted += 1
        if count[0] < i:
            break
        # Whoever opens it now finds a store, or is told to repair it; and never another one.
        try:
            with Store.open(path, mode="read") as opened:
                rows = [row.sequence for row in opened.heads(opened.compacted)]
                assert rows == list(range(opened.compacted + 1, opened.last + 1))
                assert opened.identity == IDENTITY
                assert opened.last in (LAST, expected.kept)
        except DamageError:
            pass
        if not (path / "journal.sqlite").exists():
            for mode in ("read", "write"):
                with pytest.raises(DamageError, match="repair the store"):
                    Store.open(path, identity={"for": "another"}, mode=mode)
        again = repair_store(path)
        assert again.kept == expected.kept
        assert damage(path) == []
        with Store.open(whole, mode="read") as right, Store.open(path, mode="read") as found:
            assert (found.last, found.compacted, found.identity) == (right.last, right.compacted, right.identity)
            assert list(found.heads()) == list(right.heads())
            assert found.latest().upto == right.latest().upto
        # The damaged journal is never lost on the way.
        if how != "no journal":
            asides = [file for file in path.iterdir() if file.name.startswith("journal.sqlite.damaged")]
            assert (source / "journal.sqlite").read_bytes() in [file.read_bytes() for file in asides]
    assert interrupted >= 8 // stride


def test_what_an_interrupted_repair_made_is_not_believed_after_the_store_went_on(path, monkeypatch):
    change(path, "DELETE FROM payload WHERE sequence = 18")
    with monkeypatch.context() as broken, pytest.raises(KilledError):
        broken.setattr(store.repair, "_put_in_place", lambda *_: (_ for _ in ()).throw(KilledError))
        repair_store(path)
    assert (path / "journal.sqlite.repaired").exists()
    with Store.open(path) as opened:
        add(opened, 21)
    assert not (path / "journal.sqlite.repaired").exists()
    (path / "journal.sqlite").unlink()
    assert repair_store(path).kept == 15


def test_a_damaged_result_of_an_interrupted_repair_is_named(path, monkeypatch):
    change(path, "DELETE FROM payload WHERE sequence = 18")
    with monkeypatch.context() as broken, pytest.raises(KilledError):
        broken.setattr(store.repair, "_put_in_place", lambda *_: (_ for _ in ()).throw(KilledError))
        repair_store(path)
    (path / "journal.sqlite").rename(path / "journal.sqlite.damaged")
    (path / "journal.sqlite.repaired").write_bytes(b"no longer what it was" * 900)
    with pytest.raises(DamageError, match=r"is damaged: remove it, .* and repair the store once more"):
        repair_store(path)
    assert (path / "journal.sqlite.damaged").exists()


def test_a_disk_that_does_not_keep_what_is_written_is_told_of(path, monkeypatch):
    change(path, "DELETE FROM payload WHERE sequence = 18")
    real = store.repair.build_journal

    def forgetful(draft, meta, fill=None):
        real(draft, meta, fill)
        with closing(sqlite3.connect(draft)) as connection, connection:
            connection.execute("UPDATE record SET time = 0 WHERE sequence = 3")

    with monkeypatch.context() as broken, pytest.raises(DamageError, match="does not read back as it was just written"):
        broken.setattr(store.repair, "build_journal", forgetful)
        repair_store(path)
    assert not (path / "journal.sqlite.repaired").exists()
    assert repair_store(path).kept == 17


@pytest.mark.parametrize("there_again", [True, False])
def test_a_reader_that_comes_while_the_journal_is_replaced_reads_or_is_told(path, monkeypatch, there_again):
    journal, opening = path / "journal.sqlite", []

    def replaced(*arguments, **options):
        opening.append(1)
        if len(opening) == 1:
            aside = journal.rename(path / "journal.sqlite.damaged")
            try:
                Journal(*arguments, **options)
            finally:
                if there_again:
                    aside.rename(journal)
        return Journal(*arguments, **options)

    monkeypatch.setattr(store.store, "Journal", replaced)
    if there_again:
        with Store.open(path, mode="read") as reader:
            assert reader.last > 0
    else:
        with pytest.raises(DamageError, match=r"has journal\.sqlite\.damaged .*but no journal\.sqlite"):
            Store.open(path, mode="read")


def test_a_reader_that_looks_just_when_the_journal_is_moved_away_is_told(path, monkeypatch):
    real = store.header._header

    def moved(journal):
        journal.rename(path / "journal.sqlite.damaged")
        return real(journal)

    monkeypatch.setattr(store.header, "_header", moved)
    with pytest.raises(DamageError, match="repair the store"):
        Store.open(path, mode="read")


def test_readers_meanwhile_get_right_answers_or_are_told(path):
    change(path, "DELETE FROM payload WHERE sequence = 18")
    stop, wrong = threading.Event(), []

    def read():
        while not stop.is_set():
            try:
                with Store.open(path, mode="read") as reader:
                    rows = [row.arrays["x"].tobytes() for row in reader.records()]
                    if rows != [values(number).tobytes() for number in range(1, len(rows) + 1)]:
                        wrong.append(len(rows))
            except DamageError:
                pass
            except BaseException as error:
                wrong.append(error)

    thread = threading.Thread(target=read)
    thread.start()
    repair_store(path)
    stop.set()
    thread.join()
    assert wrong == []
    assert agrees(path, kept=17, latest=15)

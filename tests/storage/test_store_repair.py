"""Repairing a store: the longest part that verifies is kept, what is lost is named, and nothing is thrown away."""

import itertools
import os
import random
import re
import shutil
import subprocess
from contextlib import suppress
from functools import partial

import pytest
import scroll_tactile_store.repair
from forging import frames_of, get_current, log_of, set_current
from scroll_tactile_store import DamageError, LockedError, ReadOnlyError, Store, StoreFullError, repair_store
from scroll_tactile_store.layout import log_path
from scroll_tactile_store.rows import decode_row, head_without_arrays
from second_reader import HEAD
from store_builds import (
    IDENTITY,
    LAST,
    add,
    agrees,
    as_after_a_crash,
    change_rows,
    commit,
    compaction,
    contents,
    cut_rows,
    damage,
    flip,
    flip_row,
    in_turns,
    is_refused,
    lose_rows,
    newest,
    sequences,
    spoil,
)


def goes_on(path):
    """New rows are numbered behind those that were kept, and checkpoints can be made."""
    with Store.open(path) as opened:
        number = opened.last + 1
        assert add(opened, number).sequence == number
        commit(opened.commit, number)
        commit(opened.compact, number)
        assert opened.compaction().last_sequence == number
    assert damage(path) == []
    return True


def test_a_sound_store_is_left_as_it_is(either):
    shutil.copytree(newest(either), either / "checkpoints" / "00000009")
    before = contents(either)
    done = repair_store(either)
    assert (done.kept, done.lost, done.aside) == (LAST, [], None)
    after = contents(either)
    assert {name: after[name] for name in before} == before
    assert after.keys() - before.keys() <= {"lock"}


# Rows.


def give_up(path, number):
    """A row without its arrays, as compaction leaves it."""
    change_rows(path, lambda found: found.update({number: head_without_arrays(decode_row(found[number])[0])}))


def forge_arrays(path, number):
    change_rows(path, lambda found: found.update({number: found[number][:-3] + b"xyz"}))


HARMS = {
    # what is done to row n; what is said of it; how many heads are lost
    "a damaged row": (flip_row, "row {0} is missing", 1),
    "a damaged frame": (lambda path, n: flip(log_of(path), frames_of(path)[n].offset + 30), "row {0} is missing", 1),
    "no frame": (lose_rows, "row {0} is missing", 1),
    "no frames": (lambda path, n: lose_rows(path, n, n + 1), "rows {0} to {1} are missing", 2),
    "damaged arrays": (lambda path, n: flip_row(path, n, arrays=True), "row {0} has arrays that fail", 0),
    "no arrays": (give_up, "row {0} ", 0),
    "arrays of nobody": (forge_arrays, "row {0} ", 0),
}


@pytest.mark.parametrize(("row", "which"), [(8, False), (8, True), (18, True)], indirect=["which"])
@pytest.mark.parametrize(("harm", "said", "gone"), HARMS.values(), ids=HARMS)
def test_a_lost_row_is_found_and_stays_in_its_checkpoint_or_ends_the_store(either, which, harm, said, gone, row):
    harm(either, row)
    file, number = log_of(either), newest(either).name.lstrip("0")
    said = said.format(row, row + 1)
    (lost,) = [problem.what for problem in damage(either) if problem.kind == "lost"]
    assert said in lost
    before = file.read_bytes()
    done = repair_store(either)
    assert done.aside == file.with_name(f"{file.name}.damaged")
    assert done.aside.read_bytes() == before
    if row == 18:  # behind the newest checkpoint
        assert done.kept == 17
        (lost,) = done.lost
        assert lost.startswith(f"rows 18 to 20 are dropped, also those that verify: {said}")
        assert agrees(either, kept=17, compacted=6 if which else 0, latest=15)
    else:
        assert done.kept == LAST
        assert said in done.lost[0]
        assert f"in checkpoint {number}, but can no longer be retracted" in done.lost[0]
        assert f"rows 1 to 15 give up their arrays, checkpoint {number} stands for them" in done.lost[-1]
        assert "took back of them counts again" in done.lost[-1]
        assert agrees(either, kept=LAST, compacted=15, latest=15, lost=range(8, 8 + gone))
    assert goes_on(either)


def test_a_lost_head_of_a_compacted_row_is_left_out_and_no_more(compacted):
    flip_row(compacted, 3)
    flip_row(compacted, 5)
    with Store.open(compacted, mode="read") as opened, pytest.raises(DamageError, match="row 3 is not as"):
        list(opened.heads())
    done = repair_store(compacted)
    assert [lost.split(";")[0] for lost in done.lost] == ["row 3 is missing", "row 5 is missing"]
    assert agrees(compacted, kept=LAST, compacted=6, latest=15, lost=[3, 5])
    # They are named as lost once; another one that goes is damage.
    flip_row(compacted, 4)
    with pytest.raises(DamageError, match="repair the store"):
        Store.open(compacted, mode="read")
    repair_store(compacted)
    assert agrees(compacted, kept=LAST, compacted=6, latest=15, lost=[3, 4, 5])
    assert goes_on(compacted)


def test_a_torn_end_is_no_damage_and_is_in_no_repair(plain, tmp_path):
    with Store.open(plain) as opened:
        for number in range(21, 25):
            add(opened, number)
        copy = as_after_a_crash(opened, tmp_path / "copy")
    flip(log_of(copy), frames_of(copy)[24].end - 9)
    assert damage(copy) == []
    spoil(newest(copy))
    assert repair_store(copy).kept == 23
    assert agrees(copy, kept=23)


@pytest.mark.parametrize("places", [(0.3,), (0.2, 0.5, 0.8)])
def test_whole_pages_of_rubbish_are_found_and_what_is_left_is_as_it_was(either, places):
    """More than one at a time: rows on both sides of a page that cannot be read are found one by one."""
    file = log_of(either)
    data = bytearray(file.read_bytes())
    for place in places:
        begin = int(len(data) * place) // 4096 * 4096
        data[begin : begin + 4096] = random.Random(begin).randbytes(4096)
    file.write_bytes(data)
    assert damage(either)
    kept = repair_store(either).kept
    with Store.open(either) as opened:
        compacted, found = opened.compacted, sequences(opened.heads())
        latest = opened.latest() and opened.latest().last_sequence
    lost = set(range(1, kept + 1)) - set(found)
    assert max(lost, default=0) <= compacted  # a head is lost only where a compaction checkpoint stands for it
    assert agrees(either, kept=kept, compacted=compacted, latest=latest, lost=lost)


# Checkpoints and logs.

CHECKPOINTS = {
    # checkpoints spoilt, rows lost; kept, compacted, latest, what is said of rows
    "the newest": ([newest], [], LAST, 0, None, []),
    "the newest of two": ([newest], [], LAST, 6, 6, []),
    "the newest, and rows": ([newest], [4, 12], 3, 0, None, ["rows 4 to 20 are dropped"]),
    "that of the compaction": ([compaction], [], LAST, 15, 15, ["rows 1 to 15 give up their arrays, checkpoint 2"]),
    "rows alone": ([], [4, 12], LAST, 15, 15, ["row 4 has arrays", "row 12 has arrays", "rows 1 to 15 give up"]),
    "both": ([newest, compaction], [], 0, 0, None, ["rows 1 to 20 are dropped"]),
}


@pytest.mark.parametrize(
    ("which", "spoilt", "lost", "kept", "last_sequence", "latest", "said"),
    in_turns(CHECKPOINTS),
    ids=CHECKPOINTS,
    indirect=["which"],
)
def test_damaged_checkpoints_are_put_aside_and_the_next_best_gone_on_from(
    either, spoilt, lost, kept, last_sequence, latest, said
):
    path = either
    for number in lost:
        flip_row(path, number, arrays=True)
    spoilt, log = [choose(path) for choose in spoilt], log_of(path)
    for folder in spoilt:
        spoil(folder)
    before = [contents(folder) for folder in spoilt]
    done = repair_store(path)
    assert (done.kept, done.aside) == (kept, log.with_name(f"{log.name}.damaged"))
    said = [*said, *(f"checkpoint {folder.name.lstrip('0')}: array 'rows'" for folder in spoilt)]
    assert [text[: len(begin)] for text, begin in zip(done.lost, said, strict=True)] == said
    assert agrees(path, kept=kept, compacted=last_sequence, latest=latest)
    assert [contents(folder.with_name(f"{folder.name}.damaged")) for folder in spoilt] == before
    assert goes_on(path)


LOGS = {
    # what is done to it; what is said of it; whether its rows still verify
    "gone": (lambda file: file.unlink(), "is gone", False),
    "a stub": (lambda file: file.write_bytes(file.read_bytes()[:80]), "does not begin as a log", False),
    "zeros": (lambda file: file.write_bytes(bytes(500)), "does not begin as a log", False),
    "another version": (lambda file: flip(file, 6, 1), "does not begin as a log", True),
    "another identity": (lambda file: flip(file, 9, 1), "does not begin as a log", True),
    "another header": (lambda file: flip(file, HEAD.size + 4, 1), "payload of frame 0", True),
}


@pytest.mark.parametrize(("which", "harm", "said", "rows_verify"), in_turns(LOGS), ids=LOGS, indirect=["which"])
def test_without_a_log_all_the_rest_is_checked_and_the_newest_checkpoint_gone_on_from(
    either, which, harm, said, rows_verify
):
    file = log_of(either)
    before = contents(either)
    harm(file)
    is_refused(either, re.escape(str(file)), identity={"for": "another"})
    assert said in " ".join(problem.what for problem in damage(either))
    assert contents(either).keys() >= before.keys() - {file.name}
    done = repair_store(either)
    assert done.aside == (file.with_name(f"{file.name}.damaged") if "is gone" not in said else None)
    if rows_verify:  # and a checkpoint knows the identity
        assert done.lost == []
        assert agrees(either, kept=LAST, compacted=6 if which else 0, latest=15)
        return
    assert done.kept == 15
    assert "are missing" in done.lost[0]
    assert "the rows behind 15, if there were any, are lost" in done.lost[-1]
    assert agrees(either, kept=15, compacted=15, latest=15, lost=range(1, 16))
    assert goes_on(either)


@pytest.mark.parametrize("current", ["names a log that is gone", "is gone"])
def test_of_several_logs_the_one_that_the_others_were_replaced_by_is_gone_on_from(plain, current):
    shutil.copy(log_of(plain), log_path(plain, 3))
    cut_rows(plain, 19)
    if current == "is gone":
        (plain / "CURRENT").unlink()
    else:
        log_of(plain).rename(log_path(plain, 2))
        set_current(plain, log=[7, get_current(plain)["log"][1]])
    assert damage(plain)
    assert repair_store(plain).kept == LAST
    assert agrees(plain, latest=15)


def test_damaged_logs_are_never_written_over_and_nothing_is_done_while_a_writer_has_it(plain):
    """Numbers go on behind those that were put aside."""
    asides = []
    for last in (20, 19, 18):
        with Store.open(plain) as opened, Store.open(plain, mode="read") as reader:
            assert opened.last == reader.last == last
            flip_row(plain, last - 1)
            with pytest.raises(LockedError, match=f"process {os.getpid()}"):
                repair_store(plain)
            opened.close()
            done = repair_store(plain)
            assert done.aside.read_bytes() not in asides
            assert (done.kept, reader.last, reader.state().last) == (last - 2, last, last - 2)
            asides.append(done.aside.read_bytes())
        with Store.open(plain) as opened:
            add(opened, last - 1)
    assert sorted(asides) == sorted(file.read_bytes() for file in plain.glob("log-*damaged*"))
    assert agrees(plain, kept=17, latest=15)


# Disks and kills.


def test_a_disk_that_is_full_or_may_not_be_written_leaves_the_damaged_store_as_it_was(plain, small_disk):
    flip_row(plain, 18)
    path, ballast = shutil.copytree(plain, small_disk / "s"), small_disk / "ballast"
    before = contents(path)
    ballast.write_bytes(bytes(shutil.disk_usage(small_disk).free - 3 * 4096))
    for mode, error in (("ro", ReadOnlyError), ("rw", StoreFullError)):
        subprocess.run(["mount", "-o", f"remount,{mode}", small_disk], check=True)
        with pytest.raises(error):
            repair_store(path)
        after = contents(path)
        assert {name: after[name] for name in before} == before
    ballast.unlink()
    assert repair_store(path).kept == 17
    assert agrees(path, kept=17, latest=15)


class KilledError(BaseException):
    pass


def killed_at(monkeypatch, step):
    """Kill what is done before or after its step of this number: a rename, a sync or a removal; all steps so far."""
    steps = []

    def killing(real, *args, **options):
        steps.append(real)
        number = len(steps)
        if number == step and step % 2:
            raise KilledError
        done = real(*args, **options)
        if number == step:
            raise KilledError
        return done

    for name in ("rename", "replace", "fsync", "unlink", "rmdir"):
        monkeypatch.setattr(os, name, partial(killing, getattr(os, name)))
    return steps


@pytest.mark.parametrize("how", ["no log", "all but the log"])
def test_killed_at_any_step_it_can_be_begun_again(stores, tmp_path, monkeypatch, how):
    source = shutil.copytree(stores[how != "no log"], tmp_path / "source")
    if how == "no log":
        log, kept, lost = None, 15, range(1, 16)
        log_of(source).unlink()
    else:
        log, kept, lost = log_of(source), 17, [8]
        flip_row(source, 8)
        flip_row(source, 18, arrays=True)
        spoil(compaction(source))
        (source / "CURRENT").unlink()
    for interrupted in itertools.count():
        path = shutil.copytree(source, tmp_path / str(interrupted))
        with monkeypatch.context() as broken:
            steps = killed_at(broken, interrupted + 1)
            with suppress(KilledError):
                repair_store(path)
        if len(steps) <= interrupted:
            break
        # Whoever opens it now finds a store, or is told to repair it; and never another one.
        for mode in ("read", "write"):
            with suppress(DamageError), Store.open(path, mode=mode, identity={"for": "another"}) as opened:
                assert opened.identity == IDENTITY
                assert opened.last in (LAST, kept)
                found = sequences(opened.heads(opened.compacted))
                assert found == list(range(opened.compacted + 1, opened.last + 1))
        repair_store(path)
        assert agrees(path, kept=kept, compacted=15, latest=15, lost=lost)
        if log is not None:  # the damaged log is never lost on the way
            assert log.read_bytes() in [file.read_bytes() for file in path.glob("*.damaged*") if file.is_file()]
        shutil.rmtree(path)
    assert interrupted >= 7


def test_a_disk_that_does_not_keep_what_is_written_is_told_of(plain, monkeypatch):
    flip_row(plain, 18)
    real = scroll_tactile_store.repair.create_log

    def forgetful(path, header, frames):
        real(path, header, frames)
        flip(path, 400)

    before = log_of(plain).read_bytes()
    with monkeypatch.context() as broken, pytest.raises(DamageError):
        broken.setattr(scroll_tactile_store.repair, "create_log", forgetful)
        repair_store(plain)
    assert log_of(plain).read_bytes() == before
    assert repair_store(plain).kept == 17
    assert agrees(plain, kept=17, latest=15)

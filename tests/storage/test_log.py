"""The log on the disk: what was committed comes back, a torn tail is passed over, and damage is named.

Each harm is judged three times: by the store, by the second reader, and by the rows that were before it.
"""

import os
import random
import shutil
from contextlib import nullcontext

import numpy as np
import pytest
import second_reader
from forging import get_current, log_of, set_current
from scroll_tactile_store import DamageError, Store, StoreError, check_store, repair_store
from scroll_tactile_store import log as store_log
from store_builds import IDENTITY, as_after_a_crash, cut_rows, damage, fails, flip, flip_row, is_refused, sequences

BATCHES = (1, 2, 1, 3, 1)
ROW = second_reader.ROW_KIND


def put(opened, size=40):
    """Append a row of so many bytes that do not compress."""
    number = opened.last + 1
    noise = np.random.default_rng(number).integers(0, 256, size).astype(np.uint8)
    return opened.append("add", f"label {number}", bytes([number]), arrays={"x": noise} if size else None)


def put_batches(path, batches=BATCHES, sizes=(0, 30, 400, 90)):
    """Append batches; leave it as after a crash."""
    with Store.open(path, identity=IDENTITY) as opened:
        for count in batches:
            with opened.batch():
                for _ in range(count):
                    put(opened, sizes[opened.last % len(sizes)])
        crashed = as_after_a_crash(opened, path.with_name(f"{path.name} crashed"))
    os.truncate(log_of(crashed), max(frame.end for frame in Whole(crashed).frames))
    set_current(crashed, last=0)  # it knows of none of its rows
    return crashed


class Whole:
    """A sound log: its bytes, the frames behind the first (those that end batches, too), and where these begin."""

    def __init__(self, path):
        self.path, self.data = path, log_of(path).read_bytes()
        self.frames = second_reader.frames(self.data)[1]
        self.begin = self.frames[0].offset
        self.commits = [frame.end for frame in self.frames if frame.kind != ROW]

    def before(self, index):
        """How many rows are before a frame."""
        return sum(frame.kind == ROW for frame in self.frames[:index])

    def committed(self, size):
        """How many rows are in batches that end within so many bytes."""
        end = max((commit for commit in self.commits if commit <= size), default=0)
        return self.before(sum(frame.end <= end for frame in self.frames))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return Whole(put_batches(tmp_path_factory.mktemp("log") / "s"))


# Each yields what the log is then, how many rows can be kept, and the number and the byte of the frame that is damaged.


def cut(log):
    for size in range(0, len(log.data), 7):
        yield log.data[:size], log.committed(size), None if size >= log.begin else (0, 0)


def flipped(log):
    """But in the last batch, where it looks as after a power cut."""
    for place in range(0, len(log.data), 11):
        data = bytearray(log.data)
        data[place] ^= 1 << place % 8
        index = next(index for index, frame in enumerate(log.frames) if place < frame.end)
        if place < log.begin:
            yield data, 0, (0, 0)
        elif place < log.commits[-2]:
            yield data, log.before(index), (index + 1, log.frames[index].offset)
        else:
            yield data, log.committed(place), None


def moved(log):
    """A frame is taken out, doubled, exchanged with the next one, or put behind the last."""
    for index, frame in enumerate(log.frames):
        ahead, own, behind = log.data[: frame.offset], log.data[frame.offset : frame.end], log.data[frame.end :]
        yield ahead + own + own + behind, log.before(index + 1), (index + 2, frame.end)
        yield log.data + own, log.committed(len(log.data)), (len(log.frames) + 1, len(log.data))
        if not behind:
            yield ahead, log.committed(len(ahead)), None
            return
        following = log.frames[index + 1].end - frame.end
        for data in (ahead + behind, ahead + behind[:following] + own + behind[following:]):
            yield data, log.before(index), (index + 1, len(ahead))


def spliced(log):
    """With another log of the same rows; where nothing of this one follows, it may be old bytes of the disk."""
    theirs = Whole(put_batches(log.path.with_name("other"))).data
    for end in log.commits:
        yield log.data[:end] + theirs[end:], log.committed(end), None
    for index, frame in enumerate(log.frames[:-2]):
        own = slice(frame.offset, frame.end)
        yield log.data[: own.start] + theirs[own] + log.data[own.stop :], log.before(index), (index + 1, own.start)
    yield theirs[: log.begin] + log.data[log.begin :], None, None  # of another store, or another time


def of_two_histories(log):
    """A copy was gone on with: its frames have the same identity, numbers, batches and sizes."""
    copies = [shutil.copytree(log.path, log.path.with_name(name)) for name in ("mine", "theirs")]
    mine, theirs = (Whole(put_batches(copy, (1, 1, 1))) for copy in copies)
    assert mine.commits == theirs.commits and mine.data != theirs.data
    for i, end in enumerate(mine.commits[len(BATCHES) : -1], 1):
        number = len(log.frames) + 2 * i + 1
        yield mine.data[:end] + theirs.data[end:], log.before(len(log.frames)) + i, (number, end)


def torn(log):
    """Sectors of the last batch, in which one row is larger than one and one is empty, did not come."""
    last = Whole(put_batches(shutil.copytree(log.path, log.path.with_name("torn")), (3,), (0, 1200)))
    rng, sectors = random.Random(0), range(len(log.data) // 512, len(last.data) // 512 + 1)
    for _ in range(60):
        data = bytearray(last.data + bytes(600))
        lost = [sector for sector in sectors if rng.random() < 0.4]
        for sector in lost:
            begin, end = max(len(log.data), sector * 512), min(len(last.data), sector * 512 + 512)
            data[begin:end] = bytes(max(0, end - begin))
        yield data, last.committed(len(log.data) if lost else len(data)), None


def theirs(path):
    try:
        _, rows, found = second_reader.rows(log_of(path).read_bytes())
    except second_reader.Damaged:
        return [], (0, 0)
    return sequences(rows), found and (found.number, found.offset)


@pytest.mark.parametrize("harm", [cut, flipped, moved, spliced, of_two_histories, torn])
def test_a_harmed_log_has_the_rows_before_and_names_damage_and_no_torn_end(whole, tmp_path, harm):
    path, tried, looked = shutil.copytree(whole.path, tmp_path / "s"), 0, 0
    for tried, (data, rows, damaged) in enumerate(harm(whole), 1):
        log_of(path).write_bytes(data)
        if rows is None:
            is_refused(path, "another store")
            continue
        assert theirs(path) == (list(range(1, rows + 1)), damaged)
        if damaged is None:
            with Store.open(path, mode="read") as opened:
                assert sequences(opened.records()) == list(range(1, rows + 1))
        else:
            with pytest.raises(DamageError) as caught:
                Store.open(path, mode="read")
            assert (caught.value.frame, caught.value.offset, caught.value.path) == (*damaged, log_of(path))
        if damaged != (0, 0) and (looked < 2 or tried % 29 == 0):
            looked += 1
            is_row = damaged is not None and whole.frames[min(damaged[0], len(whole.frames)) - 1].kind == ROW
            goes_on(shutil.copytree(path, tmp_path / f"{tried}"), rows, damaged, exactly=is_row and harm is flipped)
    assert tried >= looked >= 2


def goes_on(path, rows, damaged, *, exactly):
    """What was torn is overwritten; a repair keeps the rows before damage, maybe more, and all of the file aside."""
    if damaged is not None:
        had, before = log_of(path), log_of(path).read_bytes()
        assert damage(path)
        done = repair_store(path)
        assert done.aside == had.with_name(f"{had.name}.damaged") and done.aside.read_bytes() == before
        assert done.kept == rows or (done.kept > rows and not exactly)
        rows = done.kept
    with Store.open(path) as opened:
        assert put(opened).sequence == rows + 1
        assert [(row.sequence, row.label) for row in opened.records()] == [
            (n, f"label {n}") for n in range(1, rows + 2)
        ]
    assert damage(path) == []


def test_a_row_of_another_log_in_the_place_of_one_is_damage(whole, tmp_path):
    path, other = shutil.copytree(whole.path, tmp_path / "s"), Whole(put_batches(tmp_path / "other"))
    with Store.open(path, mode="read") as reader:
        log_of(path).write_bytes(other.data)
        for sequence in range(1, reader.last + 1):
            with pytest.raises(DamageError):
                reader.record(sequence)


def test_damage_is_proven_by_a_frame_wherever_it_begins(tmp_path):
    """The search reads in parts: a frame may begin in one and end in the next."""
    path = put_batches(tmp_path / "s", (1, 1), (store_log.PART - 300, 0))
    (first, commit, second, _), data = Whole(path).frames, log_of(path).read_bytes()
    begin = first.offset + second_reader.HEAD.size
    for more in range(0, 400, 7):
        ahead = data[:begin] + b"?" + data[begin + 1 : commit.end] + bytes(more)
        log_of(path).write_bytes(ahead + data[second.offset :][: second_reader.HEAD.size])  # of it these are left
        with pytest.raises(DamageError, match="frame 1 is not"):
            Store.open(path, mode="read")


# What `CURRENT` or a checkpoint proves of the end of a log.


def left(path, how):
    """A store of three rows; or whose writer was killed behind its first row, or a checkpoint and one more."""
    with Store.open(path, identity=IDENTITY) as opened:
        with opened.batch() if how == "one batch, and a checkpoint" else nullcontext():
            for _ in range({"killed behind a checkpoint": 2, "killed": 1}.get(how, 3)):
                put(opened)
        if "checkpoint" in how:
            opened.commit({}, last_sequence=opened.last)
        if how.startswith("killed"):
            put(opened) if "checkpoint" in how else None
            return as_after_a_crash(opened, path.with_name("killed"))
    return path


def cut_before_place(by):
    return lambda path: os.truncate(log_of(path), get_current(path)["newest"]["place"][0] - by)


ENDS = [
    # how it is left; what is done; the last row that is kept, and those that are there
    ("closed", lambda path: cut_rows(path, 1), 0, []),
    ("closed", lambda path: cut_rows(path, 3), 2, [1, 2]),
    ("closed", lambda path: flip(log_of(path), -100), 2, [1, 2]),
    ("killed", lambda path: cut_rows(path, 1), 0, []),
    ("killed behind a checkpoint", cut_before_place(1), 2, [1, 2]),
    ("killed behind a checkpoint", cut_before_place(88), 2, [1, 2]),
    ("killed behind a checkpoint", cut_before_place(89), 2, [1]),
    ("one batch, and a checkpoint", lambda path: flip(log_of(path), -88 + 20), 3, [1, 2, 3]),
    ("one batch, and a checkpoint", lambda path: flip(log_of(path), -88 + 80), 3, [1, 2, 3]),
    ("one batch, and a checkpoint", lambda path: flip_row(path, 2), 3, [1, 3]),
]


@pytest.mark.parametrize(("how", "harm", "last", "there"), ENDS)
def test_what_is_known_to_have_been_at_its_end_is_missed_and_what_is_sound_kept(tmp_path, how, harm, last, there):
    path = left(tmp_path / "s", how)
    harm(path)
    if there != [1, 3]:  # a row's payload, which nobody has looked at
        is_refused(path, "repair|is missing")
    assert damage(path)
    assert (repair_store(path).kept, damage(path)) == (last, [])
    with Store.open(path) as opened:
        assert (sequences(opened.heads()), opened.compacted) == (there, 0 if len(there) == last else last)
        assert put(opened).sequence == last + 1


def test_a_store_whose_current_went_is_closed_with_a_warning_and_anothers_is_left_alone(tmp_path, caplog):
    put_batches(tmp_path / "other", (1,))
    other = (tmp_path / "other" / "CURRENT").read_bytes()
    for name in "st":
        with Store.open(tmp_path / name, identity=IDENTITY) as opened:
            put(opened), put(opened)
            (tmp_path / name / "CURRENT").unlink()
            if name == "s":
                (tmp_path / name / "CURRENT").write_bytes(other)
    assert (tmp_path / "s" / "CURRENT").read_bytes() == other and not (tmp_path / "t" / "CURRENT").exists()
    assert "CURRENT" in caplog.text


# Writing.


def test_an_append_is_one_write_and_one_sync_of_data_and_so_is_a_batch(opened, monkeypatch):
    put(opened)
    calls = []
    for name in ("write", "pwrite", "fdatasync", "fsync"):
        real = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *given, name=name, real=real: calls.append(name[-5:]) or real(*given))
    put(opened)
    with opened.batch():
        put(opened), put(opened)
    assert calls == ["write", "async"] * 2


def test_room_is_made_ahead_without_holes_and_given_back(opened):
    path = log_of(opened.path)
    put(opened)
    assert (
        path.stat().st_size == 2**20 <= path.stat().st_blocks * 512
    )  # or each sync waits for the file system's journal
    put(opened, 2**20)
    assert path.stat().st_size == 2 * 2**20
    opened.close()
    assert path.stat().st_size == Whole(opened.path).commits[-1]


def test_where_there_is_no_room_ahead_a_row_alone_is_written(small_disk):
    with Store.open(small_disk / "s", identity={}) as opened:
        (small_disk / "other").write_bytes(bytes(shutil.disk_usage(small_disk).free - 5 * 4096))
        assert [put(opened).sequence, put(opened).sequence] == [1, 2]
        assert log_of(opened.path).stat().st_size < 2**17
    assert damage(small_disk / "s") == []


def test_short_writes_are_gone_on_with(opened, monkeypatch):
    write = os.write
    monkeypatch.setattr(os, "write", lambda file, data: write(file, bytes(data)[:300]))
    put(opened, 2000)
    monkeypatch.undo()
    assert damage(opened.path) == [] and opened.record(1).arrays["x"].nbytes == 2000


def test_an_opening_cuts_off_a_torn_end_and_syncs_what_is_before_it(whole, tmp_path, monkeypatch):
    path, calls, sync = shutil.copytree(whole.path, tmp_path / "s"), [], os.fsync
    log_of(path).write_bytes(whole.data + b"torn")
    inode = log_of(path).stat().st_ino

    def noted(file):
        if (found := os.fstat(file)).st_ino == inode:
            calls.append(found.st_size)
        sync(file)

    monkeypatch.setattr(os, "fsync", noted)
    with Store.open(path):
        assert calls == [len(whole.data)] * 2


def test_of_a_batch_so_large_that_it_is_written_early_nothing_is_there_before_its_end(opened, tmp_path):
    put(opened)
    with opened.batch():
        put(opened, 2**23), put(opened)
        assert log_of(opened.path).stat().st_size > 2**23
        assert [opened.record(number).arrays["x"].nbytes for number in (2, 3)] == [2**23, 40]
        with Store.open(opened.path, mode="read") as reader:
            assert reader.last == 1
        killed = as_after_a_crash(opened, tmp_path / "killed")
    assert opened.last == 3
    with Store.open(killed) as again:
        assert log_of(killed).stat().st_size < 2**22
        assert put(again).sequence == 2
    assert check_store(killed) == []


def test_a_reader_learns_that_what_it_read_was_taken_back(opened, monkeypatch):
    """`tests/faults/each_call.py` has every call fail; here the file could not be cut off either."""
    put(opened)
    with Store.open(opened.path, mode="read") as reader:
        with monkeypatch.context() as broken:
            broken.setattr(os, "fdatasync", fails())
            broken.setattr(os, "ftruncate", fails())
            with pytest.raises(StoreError):
                put(opened, 300)
        assert (reader.state().last, opened.last) == (2, 1)
        put(opened, 80)
        assert reader.state().last == 2
        assert reader.record(2).arrays["x"].nbytes == 80

"""The log: what was committed comes back to the byte, a torn tail is passed over, and damage is named."""

import errno
import os
import shutil
from contextlib import suppress
from pathlib import Path

import pytest
from logs import BATCHES, HEADER, KIND, append, build, ends, payload, read, rest, writing
from scroll_tactile_store import DamageError
from scroll_tactile_store.framing import FRAME_BYTES
from scroll_tactile_store.log import AHEAD, LARGEST_STAGED, PART, Log, create_log, refuse


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return build(tmp_path_factory.mktemp("log") / "log")


@pytest.fixture
def copy(whole, tmp_path):
    return Path(shutil.copy(whole, tmp_path / "log"))


def before(frames, index):
    """What can be kept where the frame of this index is damaged: the batches before it, and of its own what it has."""
    batch = frames[index][0]
    within = sum(number == batch for number, _, _ in frames[:index])
    return [*BATCHES[:batch], *([BATCHES[batch][:within]] if within else [])]


def batches_and_damage(path):
    """What a scan yields up to the first damage, and that."""
    found, damaged = [], []
    with Log(path) as log:

        def stop(damage, before):
            found.extend([[log.read(frame.offset, frame.size) for frame in before]] if before else [])
            damaged.append(damage)
            raise damage

        with suppress(DamageError):
            for batch in log.scan(stop):
                found.append([log.read(frame.offset, frame.size) for frame in batch])
    return found, damaged[0] if damaged else None


def test_a_commit_is_one_write_and_one_sync_of_data(tmp_path, monkeypatch):
    path, calls = build(tmp_path / "log"), []
    write, sync = os.write, os.fdatasync
    with writing(path) as log:
        monkeypatch.setattr(os, "write", lambda *given: calls.append("write") or write(*given))
        monkeypatch.setattr(os, "fdatasync", lambda *given: calls.append("fdatasync") or sync(*given))
        monkeypatch.setattr(os, "fsync", lambda *given: calls.append("fsync"))
        append(log, [payload(2)])
        append(log, BATCHES[3])
        monkeypatch.undo()
    assert calls == ["write", "fdatasync"] * 2


def test_the_file_is_longer_than_the_log_while_it_is_written(tmp_path):
    path = build(tmp_path / "log", [])
    with writing(path) as log:
        append(log, [b"a"])
        assert path.stat().st_size == AHEAD
        assert path.stat().st_blocks * 512 >= AHEAD  # no holes, or each sync waits for the file system's own journal
        append(log, [bytes(AHEAD)])
        assert path.stat().st_size == 2 * AHEAD
        assert read(path) == [[b"a"], [bytes(AHEAD)]]
    assert path.stat().st_size == FRAME_BYTES * 5 + len(HEADER) + 1 + AHEAD


def test_cut_at_every_byte_it_holds_the_batches_before(whole, tmp_path):
    data, (_, _, commits) = whole.read_bytes(), ends(whole)
    path = tmp_path / "log"
    for cut in range(len(data)):
        path.write_bytes(data[:cut])
        if cut < FRAME_BYTES + len(HEADER):
            with pytest.raises(DamageError, match=r"begin as a log|payload of frame 0"):
                Log(path)
            continue
        expected = BATCHES[: sum(commit <= cut for commit in commits)]
        assert read(path) == expected, cut
        if cut % 97 == 0:
            with writing(path) as log:
                append(log, [b"after"])
            assert read(path) == [*expected, [b"after"]]


def test_a_flipped_bit_is_damage_but_in_the_last_batch(whole, tmp_path):
    data, (begin, frames, commits) = whole.read_bytes(), ends(whole)
    path = tmp_path / "log"
    for place in range(0, len(data), 3):
        flipped = bytearray(data)
        flipped[place] ^= 1 << place % 8
        path.write_bytes(flipped)
        if place < begin:
            with pytest.raises(DamageError) as raised:
                Log(path)
            assert (raised.value.offset, raised.value.frame, raised.value.path) == (0, 0, path)
            continue
        index = next(index for index, (_, _, end) in enumerate(frames) if place < end)
        found, damage = batches_and_damage(path)
        if place >= commits[-2]:
            assert (found, damage) == (BATCHES[:-1], None)  # as after a power cut
        else:
            assert found == before(frames, index), place
            assert (damage.frame, damage.offset) == (index + 1, frames[index][1])


def test_a_frame_taken_out_doubled_or_swapped_with_the_next_is_damage(whole, tmp_path):
    data, (_, frames, _) = whole.read_bytes(), ends(whole)
    path = tmp_path / "log"
    for index, (_, begin, end) in enumerate(frames):
        is_last = index + 1 == len(frames)
        ahead, frame, behind = data[:begin], data[begin:end], data[end:]
        path.write_bytes(ahead + behind)
        found, damage = batches_and_damage(path)
        # Without the last commit it is as after a power cut.
        assert found == (BATCHES[:-1] if is_last else before(frames, index)), index
        assert (damage is None) == is_last
        path.write_bytes(ahead + frame + frame + behind)
        found, damage = batches_and_damage(path)
        # Of the last, all is there: only what is behind it should not be.
        assert found == (BATCHES if is_last else before(frames, index + 1))
        assert (damage.frame, damage.offset) == (index + 2, end)
        if not is_last:
            following = data[end : frames[index + 1][2]]
            path.write_bytes(ahead + following + frame + data[frames[index + 1][2] :])
            found, damage = batches_and_damage(path)
            assert (found, damage.frame) == (before(frames, index), index + 1)


def test_two_logs_spliced_do_not_hold(whole, tmp_path):
    other = build(tmp_path / "other")  # the same rows, another identity
    begin, frames, commits = ends(whole)
    mine, theirs = whole.read_bytes(), other.read_bytes()
    path = tmp_path / "log"
    for commit in commits:
        path.write_bytes(mine[:commit] + theirs[commit:])
        found, damage = batches_and_damage(path)
        # Of this log nothing follows: then its end may be no more than old bytes of the disk.
        assert found == BATCHES[: commits.index(commit) + 1] and damage is None
    for batch, first, end in frames[:-2]:
        path.write_bytes(mine[:first] + theirs[first:end] + mine[end:])
        found, damage = batches_and_damage(path)
        assert found == before(frames, frames.index((batch, first, end))) and damage.offset == first
        with Log(path) as log, pytest.raises(DamageError, match="holds no frame"):
            log.read(first, end - first - FRAME_BYTES)
    path.write_bytes(theirs[:begin] + mine[begin:])
    assert batches_and_damage(path) == ([], None)


def test_two_histories_of_one_log_spliced_are_damage(whole, tmp_path):
    """A copy was gone on with: its frames have the same identity, numbers, batches and sizes."""
    paths = [Path(shutil.copy(whole, tmp_path / name)) for name in ("mine", "theirs")]
    for path, byte in zip(paths, (b"m", b"t"), strict=True):
        with writing(path) as log:
            for _ in range(3):
                append(log, [byte * 50])
    mine, theirs = (path.read_bytes() for path in paths)
    _, frames, commits = ends(paths[0])
    path = tmp_path / "spliced"
    for commit in commits[len(BATCHES) : -1]:
        path.write_bytes(mine[:commit] + theirs[commit:])
        found, damage = batches_and_damage(path)
        number = 1 + sum(end <= commit for _, _, end in frames)
        assert found == read(paths[0])[: commits.index(commit) + 1]
        assert (damage.offset, damage.frame) == (commit, number)


def test_damage_is_proven_by_a_frame_wherever_it_begins(tmp_path):
    """The search reads in parts: a frame may begin in one and end in the next."""
    path = tmp_path / "log"
    for beside in range(-100, 20, 7):
        size = PART - len(HEADER) - 2 * FRAME_BYTES + beside
        build(path, [[bytes(size)], [b"x"]])
        data = bytearray(path.read_bytes()[: -FRAME_BYTES - 1])  # of the second batch its first 88 bytes are left
        data[FRAME_BYTES + len(HEADER) + 60] ^= 1
        path.write_bytes(data)
        with pytest.raises(DamageError, match="frame 1 is not"):
            read(path)


def test_an_opening_cuts_off_a_torn_end_and_syncs_what_is_before_it(copy, monkeypatch):
    calls, sync = [], os.fsync
    copy.write_bytes(copy.read_bytes() + b"torn")
    size = copy.stat().st_size
    monkeypatch.setattr(os, "fsync", lambda file: calls.append(os.fstat(file).st_size) or sync(file))
    with writing(copy):
        assert calls == [size - 4, size - 4]


@pytest.mark.parametrize(("frame", "lost"), [(0, 0), (2, 1), (7, 4), (8, 5), (9, 6)])
@pytest.mark.parametrize("inserted", [False, True])
def test_all_rows_but_the_damaged_one_can_be_read(copy, frame, lost, inserted):
    _, frames, _ = ends(copy)
    begin, data = frames[frame][1], copy.read_bytes()
    # Something put in takes nothing away; a flipped bit takes its row.
    between = b"?" * 200 if inserted else bytes([data[begin] ^ 1])
    copy.write_bytes(data[:begin] + between + data[begin + (not inserted) :])
    found, damaged = [], []
    with Log(copy) as log:

        def note(damage, before):
            damaged.append(damage)
            found.extend(before)

        for batch in log.scan(note):
            found += batch
        found = [log.read(each.offset, each.size) for each in found]
    assert len(damaged) == 1
    assert found == [payload(index) for index in range(8) if inserted or index != lost]


def test_what_a_writer_does_while_a_reader_looks_for_proof_is_no_damage(copy, monkeypatch):
    with writing(copy) as writer, Log(copy) as log:
        frames = Log._frames_behind

        def later(log, offset):
            if writer.place.number == 14:
                append(writer, [b"1"])
                append(writer, [b"2"])
            return frames(log, offset)

        monkeypatch.setattr(Log, "_frames_behind", later)
        assert rest(log) == [*BATCHES, [b"1"], [b"2"]]


def test_a_batch_without_its_commit_is_not_there_and_the_next_writer_removes_it(copy):
    with writing(copy) as log:
        staged = log.stage(KIND, bytes(LARGEST_STAGED))  # so large that it is written before its commit
        assert copy.stat().st_size > LARGEST_STAGED
        waiting = log.stage(KIND, b"in memory")
        assert log.read(staged.offset, staged.size) == bytes(LARGEST_STAGED)
        assert log.read(waiting.offset, waiting.size) == b"in memory"
        assert read(copy) == BATCHES
        crashed = copy.read_bytes()
    assert copy.stat().st_size < LARGEST_STAGED  # closing forgets it
    copy.write_bytes(crashed)
    assert read(copy) == BATCHES
    with writing(copy) as log:
        assert copy.stat().st_size < LARGEST_STAGED
        append(log, [b"next"])
    assert read(copy) == [*BATCHES, [b"next"]]


def test_a_place_that_is_not_behind_a_commit_of_this_log_is_told(copy, tmp_path):
    with Log(copy) as log:
        places = [log.place] + [log.place for _ in log.scan(refuse)]
        assert all(map(log.has_place, places))
        place = places[2]
        wrong = [place._replace(offset=offset) for offset in (-1, 0, 1, place.offset + 1, 2**40, 2**70)]
        wrong += [place._replace(number=place.number + 1), place._replace(batch=1), place._replace(previous=bytes(16))]
        assert not any(map(log.has_place, wrong))
        for index, log.place in enumerate(places):
            assert rest(log) == BATCHES[index:]
    with Log(build(tmp_path / "other")) as other:
        assert not other.has_place(place)


def test_a_log_of_many_frames_replaces_another(tmp_path):
    many = [(KIND, b"%d" % i) for i in range(10_000)]
    path = tmp_path / "log"
    create_log(path, b"", iter(many))
    found = read(path)
    assert [len(batch) for batch in found] == [4096, 4096, 1808]
    assert [each for batch in found for each in batch] == [each for _, each in many]


def test_a_frame_is_read_by_its_place_and_verified(copy):
    with Log(copy) as log:
        frames = [frame for batch in log.scan(refuse) for frame in batch]
        for frame, expected in zip(frames, [each for batch in BATCHES for each in batch], strict=True):
            assert log.read(frame.offset, frame.size) == expected
            assert log.read(frame.offset, frame.size, first=20) == expected[:20]
            assert log.frame_at(frame.offset) == frame
        size = copy.stat().st_size
        for offset, length in (
            (-1, 5),
            (0, 1),
            (frames[1].offset, 29),
            (frames[1].offset, 2**62),
            (size, 0),
            (2**70, 1),
        ):
            with pytest.raises(DamageError):
                log.read(offset, length)
        with copy.open("r+b") as file:
            file.seek(frames[2].offset + FRAME_BYTES + 3)
            file.write(b"?")
        with pytest.raises(DamageError, match=f"payload of frame {frames[2].number}") as raised:
            log.read(frames[2].offset, frames[2].size)
        assert (raised.value.offset, raised.value.frame) == (frames[2].offset, frames[2].number)


def test_a_commit_of_nothing_writes_nothing_and_a_closed_log_is_told_of(tmp_path):
    path = build(tmp_path / "log", [])
    with writing(path) as log:
        log.stage(KIND, b"1")
        log.commit()
        log.commit()  # of nothing
    assert read(path) == [[b"1"]]
    with pytest.raises(OSError, match="descriptor"):
        append(log, [b""])


def test_a_log_of_holes_is_refused(copy):
    os.truncate(copy, 2**33)
    with pytest.raises(DamageError, match="are on the disk"):
        Log(copy)


# Full disks, short writes, errors of the disk.


def test_a_reader_learns_that_what_it_read_was_taken_back(tmp_path, monkeypatch):
    """`faults/each_call.py` has every call fail; here the file could not be cut off either."""

    def fails(*_):
        raise OSError(errno.EIO, "the disk")

    path = build(tmp_path / "log")
    with writing(path) as log, Log(path) as beside:
        with monkeypatch.context() as broken:
            broken.setattr(os, "fdatasync", fails)
            broken.setattr(os, "ftruncate", fails)
            with pytest.raises(OSError, match="the disk"):
                append(log, [b"not durable"])
            log.rollback()
        assert rest(beside) == [*BATCHES, [b"not durable"]]
        append(log, [b"in its place"])
        assert not beside.has_place(beside.place)
        with Log(path) as anew:
            assert rest(anew) == [*BATCHES, [b"in its place"]]


def test_short_writes_are_gone_on_with(tmp_path, monkeypatch):
    path, write = build(tmp_path / "log"), os.write
    with writing(path) as log:
        monkeypatch.setattr(os, "write", lambda file, data: write(file, bytes(data)[:300]))
        append(log, [b"a" * 2000, b"b"])
        monkeypatch.undo()
    assert read(path) == [*BATCHES, [b"a" * 2000, b"b"]]

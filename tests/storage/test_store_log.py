"""The write-ahead log after a crash: cut off anywhere it is sound, with a bit flipped it is not."""

import random
import shutil
import threading

import numpy as np
import pytest
from store.writeahead import FRAME_BYTES, HEADER_BYTES, damaged_frame, mend_log
from store_builds import as_after_a_crash, damage

from store import DamageError, Store, check_store, repair_store

ROWS = 40


def values(number):
    return np.arange(number, number + 300) * 7919 % 10007


@pytest.fixture(scope="module")
def crashed(tmp_path_factory):
    """A store as a killed writer left it, with all of its rows in the log; and the log's size after each."""
    home, sizes = tmp_path_factory.mktemp("crashed"), []
    with Store.open(home / "s", identity={}) as opened:
        for number in range(1, ROWS + 1):
            opened.append("a", f"row {number}", b"", arrays={"x": values(number)})
            sizes.append((home / "s" / "journal.sqlite-wal").stat().st_size)
            if number == 20:
                opened.commit({"x": np.arange(20)}, upto=20)
        as_after_a_crash(opened, home / "c")
    return home / "c", sizes


@pytest.fixture
def copy(crashed, tmp_path):
    return shutil.copytree(crashed[0], tmp_path / "s")


def log_of(path):
    return path / "journal.sqlite-wal"


def right(path):
    with Store.open(path) as opened:
        found = [(row.sequence, row.arrays["x"].tobytes()) for row in opened.records(opened.compacted)]
        assert found == [(n, values(n).tobytes()) for n in range(opened.compacted + 1, opened.last + 1)]
        return opened.last


def test_a_sound_log_is_sound_and_mending_it_changes_nothing(copy, tmp_path):
    assert damaged_frame(log_of(copy)) is None
    assert damaged_frame(tmp_path / "none") is None
    mend_log(log_of(copy), tmp_path / "mended")
    # But for the header, which counts checkpoints, and with it all checksums.
    (tmp_path / "again").mkdir()
    shutil.copytree(copy, tmp_path / "again", dirs_exist_ok=True)
    shutil.copy(tmp_path / "mended", log_of(tmp_path / "again"))
    assert right(tmp_path / "again") == ROWS
    assert right(copy) == ROWS


@pytest.mark.parametrize("seed", range(3))
def test_a_flipped_bit_is_found_before_sqlite_drops_the_rows_behind_it(crashed, tmp_path, seed):
    rng, sizes = random.Random(seed), crashed[1]
    places = [rng.randrange(sizes[-4]) for _ in range(3)]
    frame = HEADER_BYTES + rng.randrange(sizes[-4] // FRAME_BYTES) * FRAME_BYTES
    # The log's header, a frame's, and anywhere.
    for number, place in enumerate([rng.randrange(HEADER_BYTES), frame + rng.randrange(24), *places]):
        copy = shutil.copytree(crashed[0], tmp_path / str(number))
        data = bytearray(log_of(copy).read_bytes())
        data[place] ^= 1 << rng.randrange(8)
        log_of(copy).write_bytes(data)
        found = damaged_frame(log_of(copy))
        assert found is not None
        assert abs(found - (max(place - HEADER_BYTES, -1) // FRAME_BYTES + 1)) <= 1
        for mode in ("read", "write"):
            with pytest.raises(DamageError, match=r"frame|header") as caught:
                Store.open(copy, mode=mode)
            assert caught.value.path == log_of(copy)
        assert log_of(copy).read_bytes() == data
        assert "made durable" in check_store(copy)[0].what
        assert log_of(copy).read_bytes() == data
        done = repair_store(copy)
        assert (done.aside.parent / (done.aside.name + "-wal")).read_bytes() == data
        assert damage(copy) == []
        # All, but where the newest version of a row behind the generation was hit; of one before it, its arrays.
        assert right(copy) == done.kept >= 20
        assert (done.kept == ROWS) == all("retracted" in lost for lost in done.lost)


def test_the_last_commit_may_be_cut_anywhere_in_any_order(crashed, tmp_path):
    """As after a power cut: of the frames that were not yet made durable some are there, others not.

    What was acknowledged before is there, and the last whole or not at all.
    """
    path, sizes = crashed
    data = log_of(path).read_bytes()
    rng = random.Random(1)
    for number in range(20):
        last = rng.randrange(1, ROWS)
        cut = bytearray(data[: sizes[last]])
        for i in range(sizes[last - 1], sizes[last], 512):
            if rng.random() < 0.5:
                cut[i : i + 512] = bytes(len(cut[i : i + 512]))
        copy = shutil.copytree(path, tmp_path / str(number))
        log_of(copy).write_bytes(cut + rng.choice([b"", bytes(5000), b"\xa5" * 9000]))
        assert damaged_frame(log_of(copy)) is None
        assert right(copy) in (last, last + 1)


@pytest.mark.parametrize("header", [bytes(HEADER_BYTES), b"\xa5" * HEADER_BYTES, b"", b"short"])
@pytest.mark.parametrize("rest", [b"", bytes(3 * FRAME_BYTES), b"\xa5" * (3 * FRAME_BYTES)])
def test_what_was_never_written_is_not_damage(tmp_path, header, rest):
    (tmp_path / "log").write_bytes(header + rest)
    assert damaged_frame(tmp_path / "log") is None


def test_a_log_that_was_begun_anew_over_an_older_one_is_sound(tmp_path):
    with Store.open(tmp_path / "s", identity={}) as opened:
        for number in range(1, 200):
            opened.append("a", "b", b"", arrays={"x": values(number)})
            if number % 37 == 0:
                opened._journal._connection.execute("PRAGMA wal_checkpoint(PASSIVE)")
            if number % 10 == 0:
                assert damaged_frame(log_of(tmp_path / "s")) is None


def test_rows_that_were_retracted_leave_a_sound_log(tmp_path):
    with Store.open(tmp_path / "s", identity={}) as opened:
        opened._journal._connection.execute("PRAGMA cache_size = 5")
        for number in range(6):
            with pytest.raises(KeyError), opened.batch():
                for _ in range(30 - 4 * number):
                    opened.append("a", "b", b"", arrays={"x": np.random.default_rng(number).integers(0, 2**60, 2000)})
                raise KeyError
            assert opened.append("a", "b", b"", arrays={"x": values(1)}).sequence == number + 1
            assert damaged_frame(log_of(tmp_path / "s")) is None


def test_a_log_that_is_being_written_is_sound(tmp_path):
    stop, found = threading.Event(), []
    with Store.open(tmp_path / "s", identity={}) as opened:

        def look():
            while not stop.is_set():
                found.append(damaged_frame(log_of(tmp_path / "s")))
                Store.open(tmp_path / "s", mode="read").close()

        thread = threading.Thread(target=look)
        thread.start()
        for number in range(400):
            opened.append("a", "b", b"", arrays={"x": values(number)})
            if number % 50 == 0:
                opened._journal._connection.execute("PRAGMA wal_checkpoint(PASSIVE)")
        stop.set()
        thread.join()
    assert set(found) == {None}

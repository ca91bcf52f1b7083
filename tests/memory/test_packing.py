"""Packed memories: one file that holds what a memory learned, is merged like its folder, and tells any damage."""

import os
import struct
import time
import zipfile

import numpy as np
import pytest
from touches import OBSERVED, PAD, SETTINGS, contents, fed, filled, require_same, spoil, stream

from scroll_tactile import Kernels, TactileLearner
from scroll_tactile.errors import MismatchError, ObservationError
from scroll_tactile.memory.gate import MemoryStore, check_memory
from store import DamageError, NotAStoreError, ReadOnlyError, Store, StoreError, VersionError, archive, check_store
from store.framing import FRAME_BYTES

HALVES = OBSERVED[:6], OBSERVED[6:]


def packed(folder, observed, name="p", described=(), pack=None, **settings):
    """A packed memory that observed these touches."""
    learner, _ = filled(folder / f"{name}.memory", observed, **settings)
    with learner:
        for material, constituents in dict(described).items():
            learner.describe(material, constituents)
        learner.pack(folder / name, **pack or {})
    return folder / name


class TestMerging:
    @pytest.mark.parametrize("rows", [True, False])
    def test_what_was_packed_is_merged_to_the_same_bytes(self, tmp_path, rows):
        file = packed(tmp_path, HALVES[1], pack={"rows": rows})
        learner, _ = filled(tmp_path / "m", HALVES[0])
        with learner:
            done = learner.merge(file, shared="once")
            assert (done.observations, done.shared) == (6, 0)
            require_same(learner, OBSERVED)
            states = [row.state for row in learner.observations()]
            assert states == ["kept"] * 6 + ["kept" if rows else "compacted"] * 6
        with TactileLearner.open(tmp_path / "m") as again:
            require_same(again, OBSERVED)

    def test_rows_can_be_retracted_where_they_were_merged_and_after_a_checkpoint_was_lost(self, tmp_path):
        file = packed(tmp_path, OBSERVED)
        with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:
            learner.merge(file, shared="once")
            learner.retract(1)
            require_same(learner, OBSERVED[1:])
        spoil(tmp_path / "m", 1)
        with TactileLearner.open(tmp_path / "m") as again:
            require_same(again, OBSERVED[1:])

    def test_what_both_observed_counts_once_or_twice(self, tmp_path):
        file = packed(tmp_path, OBSERVED[3:9])
        for shared, expected in (("once", OBSERVED[:9]), ("twice", [*OBSERVED[:6], *OBSERVED[3:9]])):
            learner, _ = filled(tmp_path / shared, OBSERVED[:6])
            with learner:
                done = learner.merge(file, shared=shared)
                assert (done.observations, done.shared) == (3 if shared == "once" else 6, 3)
                assert learner.digest() == fed(expected, again=True).digest()

    def test_touches_without_rows_cannot_be_counted_once(self, tmp_path):
        file = packed(tmp_path, OBSERVED[3:9], pack={"rows": False})
        learner, _ = filled(tmp_path / "m", OBSERVED[:6])
        with learner:
            with pytest.raises(ObservationError, match="cannot be counted once"):
                learner.merge(file, shared="once")
            require_same(learner, OBSERVED[:6])

    def test_descriptions_sources_and_times_travel_and_what_was_retracted_stays(self, tmp_path):
        with TactileLearner.open(tmp_path / "robot", **SETTINGS) as robot:
            robot.observe("a", stream((0, 60)), source="félt.npy[0:60]")
            robot.observe("b", stream((1, 60)))
            robot.retract(robot.observe("c", stream((2, 60))))
            robot.describe("a", {"cotton": 1.0})
            robot.pack(tmp_path / "p", source="robot 7")
            before = [(row.material, row.time) for row in robot.observations()][:2]
        with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:
            assert learner.merge(tmp_path / "p", shared="once").described == 1
            rows = learner.observations()
            assert [(row.material, row.time) for row in rows] == before
            assert [row.source for row in rows] == ["félt.npy[0:60]", "robot 7"]
            assert learner.descriptions == {"a": {"cotton": 1.0}}

    def test_without_readings_nothing_shows_a_touch_as_it_was_read(self, tmp_path):
        file = packed(tmp_path, OBSERVED, pack={"readings": False})
        with MemoryStore.open(file, mode="read") as store:
            names = [name for head in store.heads() for name in head.attributes]
            held = {*store.latest().arrays, *names}
            assert store.compacted == store.last == 12
            assert not {name for name in held if name.startswith(("kept", "exemplar", "readings", "nbytes"))}
        shown = [stream(touch).astype(np.float32).tobytes()[:64] for _, touch in OBSERVED]
        assert not any(part in file.read_bytes() for part in shown)
        with TactileLearner.open(tmp_path / "m", **SETTINGS | {"exemplars": 0, "recall": 0}) as learner:
            learner.merge(file, shared="once")
            require_same(learner, OBSERVED, exemplars=False, recall=0)
        with TactileLearner.open(tmp_path / "other", **SETTINGS) as learner:
            with pytest.raises(MismatchError, match="keeps exemplars"):
                learner.merge(file, shared="once")
            assert learner.materials == {}

    def test_a_compacted_memory_is_packed_as_its_sums(self, tmp_path):
        learner, _ = filled(tmp_path / "robot", HALVES[1])
        with learner:
            learner.compact(keep=2)
            learner.pack(tmp_path / "p")
        with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:
            learner.merge(tmp_path / "p", shared="once")
            require_same(learner, HALVES[1])
            assert [row.state for row in learner.observations()] == ["compacted"] * 6

    @pytest.mark.parametrize(
        "settings", [{"sensor": PAD.model_copy(update={"name": "q"})}, {"embedding": Kernels(seed=3)}]
    )
    def test_another_making_is_refused_by_name(self, tmp_path, settings):
        file = packed(tmp_path, OBSERVED[:2], **settings)
        with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:
            with pytest.raises(MismatchError, match=r"(sensor|embedding)s differ"):
                learner.merge(file, shared="once")
            assert learner.materials == {}

    def test_a_memory_of_codes_alone_is_packed_with_them(self, tmp_path):
        settings = {"exemplars": 0, "recall": 0}
        file = packed(tmp_path, HALVES[1], **settings)
        learner, _ = filled(tmp_path / "m", HALVES[0], **settings)
        with learner:
            learner.merge(file, shared="once")
            assert contents(learner) == contents(fed(OBSERVED, **settings))


class TestReading:
    @pytest.mark.parametrize("pack", [{}, {"rows": False}, {"readings": False}])
    def test_it_is_opened_to_read_where_it_lies_and_left_as_it_is(self, tmp_path, pack):
        file = packed(tmp_path, OBSERVED, described={"a": {"cotton": 1.0}}, pack=pack)
        before = file.read_bytes()
        with TactileLearner.open(file, mode="read") as learner:
            if pack.get("readings", True):
                assert contents(learner) == contents(fed(OBSERVED))
            assert learner.digest() == fed(OBSERVED).digest()
            assert learner.descriptions == {"a": {"cotton": 1.0}}
            assert [row.material for row in learner.observations()] == [name for name, _ in OBSERVED]
            assert not learner.refresh()
            with pytest.raises(ReadOnlyError, match="mode"):
                learner.observe("a", stream((80, 60)))
        assert check_memory(file) == []
        assert file.read_bytes() == before and sorted(path.name for path in tmp_path.iterdir()) == ["p", "p.memory"]

    def test_it_is_not_opened_to_write(self, tmp_path):
        file = packed(tmp_path, OBSERVED[:2])
        with pytest.raises(NotAStoreError, match=r"opened with mode=\"read\", or merged"):
            TactileLearner.open(file)

    def test_packing_what_was_packed_gives_the_same_memory(self, tmp_path):
        file = packed(tmp_path, OBSERVED)
        with TactileLearner.open(file, mode="read") as learner:
            learner.pack(tmp_path / "again")
        with TactileLearner.open(tmp_path / "again", mode="read") as learner:
            require_same(learner, OBSERVED)

    def test_names_that_a_file_has_in_its_folder_lead_nowhere_else(self, tmp_path):
        file = packed(tmp_path, OBSERVED[:2])
        with zipfile.ZipFile(file) as listed:
            names = listed.namelist()
        assert names[0] == "CURRENT" and names[1].startswith("log-")
        assert all(name.startswith("checkpoints/") for name in names[2:])


@pytest.fixture
def other(tmp_path):
    """A memory that observed another touch."""
    with TactileLearner.open(tmp_path / "other", **SETTINGS) as learner:
        learner.observe("z", stream((50, 60)))
        yield learner


REFUSED = DamageError, NotAStoreError, MismatchError, VersionError


def require_refused(learner, file, match=None):
    """Merging and opening a file are refused by its name, within seconds, and change nothing."""
    before, begun = learner.digest(), time.monotonic()
    for use in (lambda: learner.merge(file, shared="once"), lambda: TactileLearner.open(file, mode="read").close()):
        with pytest.raises(REFUSED, match=match) as raised:
            use()
        assert str(file) in str(raised.value)
    assert (learner.digest(), len(learner.observations())) == (before, 1)
    assert time.monotonic() - begun < 20


class TestDamage:
    @pytest.mark.parametrize("pack", [{}, {"rows": False}])
    def test_a_flipped_bit_anywhere_is_refused_by_name_or_changes_nothing(self, tmp_path, other, pack):
        """Dates and the like are not verified; where there are rows they say all that a checkpoint says."""
        file = packed(tmp_path, OBSERVED[:3], pack=pack)
        whole, draw, digest, refused = file.read_bytes(), np.random.default_rng(7), fed(OBSERVED[:3]).digest(), 0
        listed = archive.Archive(file)
        listed.close()
        inside = listed._ranges
        described = [name for name in inside if name.count("/") == 3 and name.endswith("/zarr.json")]  # not read whole
        spare = described if pack else [name for name in inside if name.startswith("checkpoints")]
        # The frame that ends a log proves what is before it, and nothing proves that.
        shorter = {name: FRAME_BYTES for name in inside if name.startswith("log-")}
        needed = [(begin, size - shorter.get(name, 0)) for name, (begin, size) in inside.items() if name not in spare]
        within = [begin + int(draw.integers(size)) for begin, size in needed for _ in range(2 if pack else 20)]
        outside = [*range(30), *range(len(whole) - 60, len(whole)), *(begin - 30 for begin, _ in inside.values())]
        places = [*within, *outside, *draw.integers(0, len(whole), size=40).tolist()]
        for place in places:
            flipped = bytearray(whole)
            flipped[place] ^= 1 << int(draw.integers(8))
            file.write_bytes(bytes(flipped))
            try:
                with TactileLearner.open(tmp_path / f"m{place}", **SETTINGS) as learner:
                    learner.merge(file, shared="once")
                    assert learner.digest() == digest, place
                    assert place not in within, place
            except REFUSED as error:
                refused += 1
                assert str(file) in str(error)
        assert refused >= len(within)
        file.write_bytes(whole)
        assert other.merge(file, shared="once").observations == 3

    def test_a_file_that_was_cut_off_anywhere(self, tmp_path, other):
        file = packed(tmp_path, OBSERVED[:2])
        whole = file.read_bytes()
        for size in [0, 1, 10, 37, 100, *range(1000, len(whole), len(whole) // 20), len(whole) - 22, len(whole) - 1]:
            file.write_bytes(whole[:size])
            require_refused(other, file, "fetch it again from where it was packed")

    def test_a_newer_version_is_refused_by_its_number(self, tmp_path, other, monkeypatch):
        monkeypatch.setattr("store.layout.FORMAT_VERSION", 9)
        file = packed(tmp_path, OBSERVED[:2])
        monkeypatch.undo()
        require_refused(other, file, "format 9; this release reads format 1: upgrade it")

    def test_sums_of_other_touches_than_its_rows(self, tmp_path, other):
        """Rows of one memory, the checkpoint of another, and right checksums."""
        one, two = packed(tmp_path, OBSERVED[:4], "one"), packed(tmp_path, OBSERVED[1:5], "two")
        del one, two
        with Store.open(tmp_path / "two.memory", mode="read") as store:
            newest = store.latest()
        with Store.open(tmp_path / "one.memory") as store:
            store.commit(newest.arrays, upto=newest.upto, attributes=newest.attributes)
        archive.write_archive(tmp_path / "one.memory", tmp_path / "forged")
        before = other.digest()
        with pytest.raises(DamageError, match=r"forged counts other touches than it names|forged counts \d touches of"):
            other.merge(tmp_path / "forged", shared="once")
        assert other.digest() == before

    def test_a_full_disk_leaves_nothing_behind(self, tmp_path, monkeypatch):
        learner, _ = filled(tmp_path / "m", OBSERVED[:2])

        def full(*_):
            raise OSError(28, "No space left on device")

        with learner:
            monkeypatch.setattr("store.archive.os.fsync", full)
            with pytest.raises(StoreError, match="no space left"):
                learner.pack(tmp_path / "p")
            monkeypatch.undo()
        assert sorted(path.name for path in tmp_path.iterdir()) == ["m"]


def entries(file):
    """The names and contents of a zip."""
    with zipfile.ZipFile(file) as listed:
        return [(entry.filename, listed.read(entry)) for entry in listed.infolist()]


def zipped(file, files, compress=zipfile.ZIP_STORED, links=()):
    """Write a zip of these names and contents, whatever they are."""
    with zipfile.ZipFile(file, "w", compress) as made:
        for name, content in files:
            entry = zipfile.ZipInfo(name)
            entry.compress_type = compress
            entry.external_attr = (0o120777 if name in links else 0o100644) << 16
            made.writestr(entry, content)


def patched(file, mark, offset, value):
    """Change bytes behind each mark of a zip."""
    data = bytearray(file.read_bytes())
    place = data.find(mark)
    while place >= 0:
        data[place + offset : place + offset + len(value)] = value
        place = data.find(mark, place + 4)
    file.write_bytes(bytes(data))


LISTED, LOCAL = b"PK\1\2", b"PK\3\4"


@pytest.mark.filterwarnings("ignore:Duplicate name")
class TestMadeToHarm:
    @pytest.fixture
    def file(self, tmp_path):
        return packed(tmp_path, OBSERVED[:3])

    @pytest.mark.parametrize(
        "name",
        [
            "../outside",
            "checkpoints/../../outside",
            "/tmp/outside",
            "C:\\outside",
            "checkpoints\\00000001\\zarr.json",
            "current",
            "Log-00000001",
            "log-00000001/",
            "lock",
            "log-٠٠٠٠٠٠٠١",
            "checkpoints/00000001/a/c/" + "0/" * 70 + "0",
            "CURRENT",
            "log-00000001",
            "x" * 60_000,
        ],
    )
    def test_a_name_that_is_none_of_a_stores_or_there_already(self, file, other, tmp_path, name):
        before = sorted(tmp_path.iterdir())
        zipped(file, [*entries(file), (name, b"any")])
        require_refused(other, file, "(?i)fetch it again")
        assert sorted(tmp_path.iterdir()) == before

    def test_links(self, file, other):
        zipped(file, entries(file), links=["log-00000001"])
        require_refused(other, file, "as a link")

    @pytest.mark.parametrize("compress", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
    def test_compressed_files_and_a_bomb(self, file, other, compress):
        zipped(file, [*entries(file), ("log-00000002", bytes(2**26))], compress)
        require_refused(other, file, "as compressed or encrypted")

    def test_encrypted_files(self, file, other):
        patched(file, LISTED, 8, struct.pack("<H", 1))
        require_refused(other, file, "as compressed or encrypted")

    def test_a_list_that_disagrees_with_what_lies_there(self, file, other):
        files = entries(file)
        patched(file, b"CURRENT", 0, b"CURRENS")
        require_refused(other, file)
        zipped(file, files)
        patched(file, LISTED, 42, struct.pack("<I", 7))
        require_refused(other, file, "where another file begins, or none")
        zipped(file, files)
        patched(file, LISTED, 42, struct.pack("<I", 0))
        require_refused(other, file, "where another file begins, or none")

    @pytest.mark.parametrize("size", [0, 1, 10**6, 2**32 - 2])
    def test_sizes_that_are_none(self, file, other, size):
        zipped(file, entries(file))
        patched(file, LISTED, 20, struct.pack("<II", size, size))
        require_refused(other, file)

    def test_files_that_overlap(self, file, other):
        files = [("CURRENT", b"{}"), ("log-00000001", b"x" * 100), ("log-00000002", b"y" * 100)]
        zipped(file, files)
        data = file.read_bytes()
        third = data.rfind(LISTED)
        second = data.rfind(LISTED, 0, third)
        changed = bytearray(data)
        changed[second + 20 : second + 28] = struct.pack("<II", 200, 200)
        file.write_bytes(bytes(changed))
        require_refused(other, file, "files that overlap")

    @pytest.mark.parametrize("more", [b"x", b"#!/bin/sh\n", bytes(1000)])
    def test_bytes_before_and_behind(self, file, other, more):
        whole = file.read_bytes()
        for changed in (more + whole, whole + more):
            file.write_bytes(changed)
            require_refused(other, file, "cut off or added to")

    def test_a_zip_of_nothing_of_other_things_and_of_a_zip(self, file, other):
        inner = file.read_bytes()
        for files in ([], [("readme.txt", b"any")], [("memory.zip", inner)], [("m/" + n, c) for n, c in entries(file)]):
            zipped(file, files)
            require_refused(other, file, "no packed store")
        zipped(file, [("CURRENT", inner)])
        require_refused(other, file)

    def test_a_list_that_would_fill_the_memory(self, file, other):
        zipped(file, entries(file))
        patched(file, b"PK\5\6", 12, struct.pack("<I", 2**31))
        require_refused(other, file, "its list of files takes 2147483648 bytes")

    def test_more_files_than_a_store_has(self, file, other):
        with zipfile.ZipFile(file, "a") as many:
            for number in range(2, 10**5):
                many.writestr(f"log-{number:08d}", b"")
        require_refused(other, file, "(?i)fetch it again")

    @pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes")
    def test_what_is_no_file(self, tmp_path, other, file):
        os.mkfifo(tmp_path / "pipe")
        (tmp_path / "link").symlink_to(file)
        (tmp_path / "empty").mkdir()
        for name in ("pipe", "link", "empty"):
            require_refused(other, tmp_path / name)

    def test_one_full_of_holes(self, file, other):
        with file.open("r+b") as written:
            written.truncate(2**40)
        require_refused(other, file, "nothing of it was read")

    def test_rows_that_no_memory_packs(self, tmp_path, other):
        """A retraction of all rows that there could ever be, in a file with right checksums."""
        with Store.open(tmp_path / "m", identity=dict(other._ledger.store.identity)) as store:
            store.append("retract", "", b"", attributes={"sequences": [[1, 2**60]]})
            store.commit({}, upto=1, attributes={})
        archive.write_archive(tmp_path / "m", tmp_path / "forged")
        require_refused(other, tmp_path / "forged", "row 1|checkpoint")
        assert check_memory(tmp_path / "forged")

    def test_checking_one(self, file):
        assert check_store(file) == [] == check_memory(file)
        begin, size = archive.Archive(file)._ranges["log-00000001"]
        whole = bytearray(file.read_bytes())
        whole[begin + size // 2] ^= 1
        file.write_bytes(bytes(whole))
        assert check_store(file)

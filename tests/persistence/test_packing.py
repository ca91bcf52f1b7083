"""Packed memories: one file that holds what a memory learned, is merged like its folder, and tells any damage."""

import os
import struct
import time
import zipfile

import numpy as np
import pytest
from scroll_tactile_store import DamageError, NotAStoreError, ReadOnlyError, StoreError, VersionError, check_store
from touches import OBSERVED, SETTINGS, fed, filled, held, require_same, stream

from scroll_tactile import TactileLearner
from scroll_tactile.errors import MismatchError
from scroll_tactile.memory.gate import MemoryStore, check_memory


def packed(folder, observed, pack=None, cotton=()):
    """A packed memory that observed these touches. cotton: materials that are described as that."""
    with filled(folder / "p.memory", observed)[0] as learner:
        for material in cotton:
            learner.describe(material, {"cotton": 1.0})
        learner.pack(folder / "p", **pack or {})
    return folder / "p"


class TestMerging:
    def test_descriptions_sources_and_times_travel_and_what_was_retracted_stays(self, tmp_path):
        with TactileLearner.open(tmp_path / "robot", **SETTINGS) as robot:
            robot.observe("a", stream((0, 60)), source="félt.npy[0:60]")
            robot.observe("b", stream((1, 60)))
            robot.retract(robot.observe("c", stream((2, 60))))
            robot.describe("a", {"cotton": 1.0})
            robot.pack(tmp_path / "p", source="robot 7")
            before = [(row.material, row.time) for row in robot.observations()][:2]
        with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:
            assert learner.merge(tmp_path / "p").described == 1
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
        with TactileLearner.open(tmp_path / "m", **SETTINGS | {"exemplars": 0, "kept_touches": 0}) as learner:
            learner.merge(file)
            require_same(learner, OBSERVED, exemplars=False, kept_touches=0)
        with TactileLearner.open(tmp_path / "other", **SETTINGS) as learner:
            with pytest.raises(MismatchError, match="keeps exemplars"):
                learner.merge(file)
            assert learner.materials == {}


class TestReading:
    @pytest.mark.parametrize("pack", [{}, {"readings": False}])
    def test_it_is_opened_to_read_and_left_as_it_is(self, tmp_path, pack):
        file = packed(tmp_path, OBSERVED, pack, cotton=["a"])
        before = file.read_bytes()
        with TactileLearner.open(file, mode="read") as learner:
            if pack.get("readings", True):
                assert held(learner)[:4] == held(fed(OBSERVED))[:4]
            assert learner.digest() == fed(OBSERVED).digest()
            assert learner.descriptions == {"a": {"cotton": 1.0}}
            assert [row.material for row in learner.observations()] == [name for name, _ in OBSERVED]
            assert not learner.refresh()
            with pytest.raises(ReadOnlyError, match="mode"):
                learner.observe("a", stream((80, 60)))
        with pytest.raises(NotAStoreError, match=r"opened with mode=\"read\", or merged"):
            TactileLearner.open(file)
        assert check_memory(file) == []
        assert file.read_bytes() == before and sorted(path.name for path in tmp_path.iterdir()) == ["p", "p.memory"]


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    """A memory that observed another touch, and that takes nothing in."""
    with TactileLearner.open(tmp_path_factory.mktemp("other") / "m", **SETTINGS) as learner:
        learner.observe("z", stream((50, 60)))
        yield learner


REFUSED = DamageError, NotAStoreError, MismatchError, VersionError


def require_refused(learner, file, match=None):
    """Merging and opening a file are refused by its name, within seconds, and change nothing."""
    before, begun = learner.digest(), time.monotonic()
    for use in (lambda: learner.merge(file), lambda: TactileLearner.open(file, mode="read").close()):
        with pytest.raises(REFUSED, match=match) as raised:
            use()
        assert str(file) in str(raised.value)
    assert (learner.digest(), len(learner.observations())) == (before, 1)
    assert time.monotonic() - begun < 20


class TestDamage:
    @pytest.mark.parametrize("pack", [{}, {"rows": False}])
    def test_a_flipped_bit_anywhere_is_refused_by_name_or_changes_nothing(self, tmp_path, pack):
        """Dates and the like are not verified; each file is."""
        file = packed(tmp_path, OBSERVED[:3], pack=pack)
        whole, draw, digest, refused = file.read_bytes(), np.random.default_rng(7), fed(OBSERVED[:3]).digest(), 0
        inside = ranges(file)
        within = [begin + int(draw.integers(size)) for begin, size in inside for _ in range(1 if pack else 2)]
        outside = [*range(0, 30, 9), *range(len(whole) - 60, len(whole), 17), *(begin - 30 for begin, _ in inside)]
        for place in [*within, *outside, *draw.integers(0, len(whole), size=3).tolist()]:
            flipped = bytearray(whole)
            flipped[place] ^= 1 << int(draw.integers(8))
            file.write_bytes(bytes(flipped))
            try:
                with TactileLearner.open(tmp_path / f"m{place}", **SETTINGS) as learner:
                    learner.merge(file)
                    assert learner.digest() == digest, place
                    assert place not in within, place
            except REFUSED as error:
                refused += 1
                assert str(file) in str(error)
        assert refused >= len(within)

    def test_a_file_that_was_cut_off_anywhere(self, tmp_path, other):
        file = packed(tmp_path, OBSERVED[:2])
        whole = file.read_bytes()
        for size in [0, 1, 10, 37, 100, *range(1000, len(whole), len(whole) // 4), len(whole) - 22, len(whole) - 1]:
            file.write_bytes(whole[:size])
            require_refused(other, file, "fetch it again from where it was packed")

    def test_a_full_disk_leaves_nothing_behind(self, tmp_path, monkeypatch):
        learner, _ = filled(tmp_path / "m", OBSERVED[:2])

        def full(*_):
            raise OSError(28, "No space left on device")

        with learner:
            monkeypatch.setattr("scroll_tactile_store.archive.os.fsync", full)
            with pytest.raises(StoreError, match="no space left"):
                learner.pack(tmp_path / "p")
            monkeypatch.undo()
        assert sorted(path.name for path in tmp_path.iterdir()) == ["m"]


def ranges(file):
    """Where in a zip the bytes of each file begin, and how many there are; of files without any, nothing."""
    data, found = file.read_bytes(), []
    with zipfile.ZipFile(file) as listed:
        for entry in listed.infolist():
            name, more = struct.unpack_from("<HH", data, entry.header_offset + 26)
            found.append((entry.header_offset + 30 + name + more, entry.file_size))
    return [each for each in found if each[1]]


def holding(make, compress=zipfile.ZIP_STORED):
    """Put other names and contents than there are into a zip."""

    def change(file):
        with zipfile.ZipFile(file) as listed:
            files = make([(entry.filename, listed.read(entry)) for entry in listed.infolist()])
        with zipfile.ZipFile(file, "w", compress) as made:
            for name, content in files:
                made.writestr(name, content)

    return change


HARMS = {
    # what is done to a packed memory, and what is said of it; tests/test_strangers.py has what leads outside
    "a file more": (holding(lambda own: [*own, ("current", b"any")]), "(?i)fetch it again"),
    "deflated": (holding(lambda own: own, zipfile.ZIP_DEFLATED), None),
    "a script before it": (lambda file: file.write_bytes(b"#!/bin/sh\n" + file.read_bytes()), "no packed store"),
    "all in a folder": (holding(lambda own: [("m/" + name, data) for name, data in own]), "no packed store"),
    "holes": (lambda file: os.truncate(file, 2**40), "nothing of it was read"),
}


@pytest.mark.parametrize(("harm", "match"), HARMS.values(), ids=HARMS)
def test_one_that_was_made_to_harm(other, tmp_path, harm, match):
    file = packed(tmp_path, OBSERVED[:3])
    assert check_store(file) == [] == check_memory(file)
    harm(file)
    before = sorted(tmp_path.iterdir())
    require_refused(other, file, match)
    assert sorted(tmp_path.iterdir()) == before

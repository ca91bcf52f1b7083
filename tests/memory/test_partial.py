"""Packed memories: one file that holds what a memory learned, is merged like its folder, and tells any damage."""

import numpy as np
import pytest
from scroll_tactile.memory.partial import Joint, Partial
from touches import OBSERVED, PAD, SETTINGS, SMALL, contents, fed, filled, require_same, spoil, stream

from scroll_tactile import Kernels, TactileLearner
from scroll_tactile.embeddings.protocol import window_plan
from scroll_tactile.errors import MismatchError, ObservationError
from scroll_tactile.memory.packing import reduce_partials
from scroll_tactile.memory.state import Memory
from store import DamageError, NotAStoreError, StoreError, VersionError

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
        with Partial(file) as partial:
            partial.read_with(window_plan(PAD, SMALL))
            held = {*partial.sums().arrays, *(name for head in partial.heads() for name in head.attributes)}
            assert not partial.has_rows
            assert not {name for name in held if name.startswith(("kept", "exemplar", "readings", "nbytes"))}
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


class TestDamage:
    def test_every_flipped_bit_is_refused_by_name_and_nothing_is_merged(self, tmp_path):
        file = packed(tmp_path, OBSERVED[:3])
        whole = file.read_bytes()
        draw = np.random.default_rng(7)
        ends = [*range(8), *range(len(whole) - 48, len(whole))]
        with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:
            learner.observe("z", stream((50, 60)))
            before = learner.digest()
            for place in [*ends, *draw.integers(0, len(whole), size=60).tolist()]:
                flipped = bytearray(whole)
                flipped[place] ^= 1 << int(draw.integers(8))
                file.write_bytes(bytes(flipped))
                with pytest.raises(DamageError, match=r"/p is not as it was written"):
                    learner.merge(file, shared="once")
                assert (learner.digest(), len(learner.observations())) == (before, 1)
            file.write_bytes(whole)
            assert learner.merge(file, shared="once").observations == 3

    @pytest.mark.parametrize("size", [0, 10, 100, 0.5, -1])
    def test_a_file_that_was_cut_off(self, tmp_path, size):
        file = packed(tmp_path, OBSERVED[:2])
        whole = file.read_bytes()
        file.write_bytes(whole[: int(size * len(whole)) if isinstance(size, float) else size])
        with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:  # noqa: SIM117
            with pytest.raises((DamageError, NotAStoreError), match=r"/p is no"):
                learner.merge(file, shared="once")

    def test_a_newer_version_is_refused_by_its_number(self, tmp_path, monkeypatch):
        monkeypatch.setattr("store.packed.VERSION", 9)
        file = packed(tmp_path, OBSERVED[:2])
        monkeypatch.undo()
        with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:  # noqa: SIM117
            with pytest.raises(VersionError, match="format 9; this release reads 1"):
                learner.merge(file, shared="once")

    def test_sums_of_other_touches_than_the_file_names(self, tmp_path):
        parts = []
        for name, part in (("one", OBSERVED[:4]), ("two", OBSERVED[4:])):
            parts.append(packed(tmp_path, part, name))
        plan = window_plan(PAD, SMALL)
        with Partial(parts[0]) as one, Partial(parts[1]) as two:
            joint = Joint([(one, ())], two, {})
            joint.read_with(plan)
            with pytest.raises(DamageError, match="sums up 8 touches of 4"):
                joint.sums()

    def test_a_full_disk_leaves_nothing_behind(self, tmp_path, monkeypatch):
        learner, _ = filled(tmp_path / "m", OBSERVED[:2])

        def full(*_):
            raise OSError(28, "No space left on device")

        with learner:
            monkeypatch.setattr("store.packed.os.fsync", full)
            with pytest.raises(StoreError, match="no space left"):
                learner.pack(tmp_path / "p")
            monkeypatch.undo()
        assert sorted(path.name for path in tmp_path.iterdir()) == ["m"]


class TestSums:
    def test_partials_add_up_in_any_tree_to_one(self, tmp_path):
        files = [packed(tmp_path, OBSERVED[i : i + 3], f"p{i}", pack={"rows": False}) for i in range(0, 12, 3)]

        def added(paths, name):
            reduce_partials(
                [(path, ()) for path in paths], tmp_path / name, Memory(64, window_plan(PAD, SMALL), 4, None, keeping)
            )
            return tmp_path / name

        with TactileLearner.open(tmp_path / "p0.memory", **SETTINGS) as learner:
            keeping = learner.memory.keeping
        left = added([added(files[2:], "x"), added([files[1]], "y"), files[0]], "left")
        right = added(files, "right")
        assert left.read_bytes()[:8] == right.read_bytes()[:8]
        for path in (left, right):
            with TactileLearner.open(tmp_path / f"{path.name}.m", **SETTINGS) as learner:
                learner.merge(path, shared="once")
                require_same(learner, OBSERVED)

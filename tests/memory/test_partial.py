"""Packed memories: one file that holds what a memory learned, is merged like its folder, and tells any damage."""

import numpy as np
import pytest
from touches import OBSERVED, PAD, SETTINGS, SMALL, contents, fed, filled, require_same, stream

from scroll_tactile import Kernels, TactileLearner
from scroll_tactile.errors import MismatchError, ObservationError
from scroll_tactile.memory.packing import reduce_partials
from scroll_tactile.memory.partial import Joint, Partial
from scroll_tactile.memory.state import Memory
from scroll_tactile.embeddings.protocol import window_plan
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

    def test_rows_can_be_retracted_where_they_were_merged_and_after_a_generation_was_lost(self, tmp_path):
        file = packed(tmp_path, OBSERVED)
        with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:
            learner.merge(file, shared="once")
            learner.retract(1)
            require_same(learner, OBSERVED[1:])
        for array in (tmp_path / "m" / "generations").rglob("c/0"):
            array.unlink()
        with TactileLearner.open(tmp_path / "m") as again:
            require_same(again, OBSERVED[1:])

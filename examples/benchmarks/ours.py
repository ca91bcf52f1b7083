"""What a memory does with feature vectors, without streams, embedding and store: to stand beside other learners."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.readout import Readout
from scroll_tactile.readouts.recursive import WoodburyReadout
from scroll_tactile.readouts.shrinkage import select
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.grid import in_units, to_codes
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.statistics import Statistics, fold_of

__all__ = ["Ours"]

FloatArray = npt.NDArray[np.float64]
WHOLE = Scale("window", 1)  # features of a touch as a whole: one row each


class Ours:
    """The statistics and the readout of a memory, fed feature vectors as the peers are (`peers.Peer`).

    dimension: d, of vectors in [-bound, bound]. λ is chosen again where there is a new class or the rows have grown
    by the share `refit`; in between the readout follows, as a learner's does.
    """

    def __init__(self, dimension: int, refit: float, bound: float = 1.0) -> None:
        self.bound = bound
        self.statistics = Statistics(dimension, [WHOLE])
        self.refit = refit
        self._waiting: list[tuple[str, npt.NDArray[np.int32]]] = []
        self._fitted_at = self._seen = 0
        self._names: dict[str, int] = {}
        self._tracked: WoodburyReadout | None = None
        self._readout: Readout | None = None

    def observe(self, place: int, row: FloatArray) -> None:
        """Learn one vector of the class at a place."""
        name, codes = f"{place:03d}", to_codes(row[None], self.bound)
        self.statistics.add(name, fold_of(codes.tobytes()), {WHOLE: codes})
        self._seen += 1
        self._waiting.append((name, codes))

    def predict(self, row: FloatArray) -> int:
        """The place of the class that a vector is most like."""
        if self._waiting:
            with one_thread():
                self._take_in()
        assert self._readout is not None
        z = self._readout.project(in_units(row[None], self.bound))
        return int(list(self._names)[int(self._readout.scores(z, "lda").argmax())])

    def _take_in(self) -> None:
        new = any(name not in self._names for name, _ in self._waiting)
        if new or self._readout is None or self._seen > (1 + self.refit) * self._fitted_at:
            selection = select(self.statistics, WHOLE, "lda")
            assert selection is not None
            self._names, self._readout = selection.places, selection.readout
            self._fitted_at, self._tracked = self._seen, None
        else:
            if self._tracked is None:
                self._tracked = WoodburyReadout(self.statistics, WHOLE, self._readout)
            elif not all(self._tracked.add(codes, self._names[name]) for name, codes in self._waiting):
                self._tracked.anchor(self.statistics)
            self._readout = self._tracked.readout()
        self._waiting.clear()

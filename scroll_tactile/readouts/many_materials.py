"""Scores of more materials than a readout holds: bounds of all, and exact scores of few."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.pruning import Compared, PruningTable, principal_directions
from scroll_tactile.statistics.moments import one_thread

if TYPE_CHECKING:
    from scroll_tactile.readouts.readout import Readout

__all__ = ["ManyMaterials"]

FloatArray = npt.NDArray[np.float64]
Places = npt.NDArray[np.intp]

TABLED_AT_ONCE = 1024  # materials whose coarse copies are made at once
AT_ONCE = 64  # materials whose means are read at once: they stay in the processor's cache


class ManyMaterials:
    """All materials of one readout in coarse copies, with the touch that was compared with them last."""

    def __init__(self, readout: Readout, table: PruningTable | None = None) -> None:
        self._readout, self._table = readout, table
        self._most_lost: float | None = None
        self._compared: tuple[FloatArray, Compared] | None = None

    def copy(self, readout: Readout) -> ManyMaterials:
        """The materials of a copy of the readout."""
        return ManyMaterials(readout, None if self._table is None else self._table.copy())

    def forget(self) -> None:
        """The readout changes: bounds are found again."""
        self._compared = self._most_lost = None

    def put(self, places: Places, whitened: FloatArray) -> None:
        """The materials at some places have other means, L⁻¹ m of shape (k, d), or are new there."""
        if self._table is not None:
            self._table.put(places, whitened)

    def bounds(self, codes: FloatArray, places: Places, *, fine: bool = False) -> tuple[FloatArray, FloatArray]:
        """Guesses of the scores "lda" of some materials, and what they are at most, each of shape (k,)."""
        compared = self._beside(codes)
        if fine:
            compared.refine(places)
        return compared.guess[places], compared.most[places]

    def exact(self, codes: FloatArray, places: Places) -> FloatArray:
        """The scores "lda" of any materials, which are not held for it, for codes of shape (d,), shape (k,)."""
        compared, readout = self._beside(codes), self._readout
        unknown = places[~compared.known[places]]
        with one_thread():
            for first in range(0, len(unknown), AT_ONCE):
                some = unknown[first : first + AT_ONCE]
                means, sizes = readout.read_means(some), compared.table.sizes[some]
                if readout.system.rank:
                    sizes = sizes - readout.system.lost(readout.system.whiten(means))
                compared.take(some, readout.gamma * (means @ compared.solved - sizes / 2))
        return compared.guess[places]

    def _beside(self, codes: FloatArray) -> Compared:
        """Codes (d,) beside all materials; the latest are kept."""
        readout = self._readout
        if self._compared is None or self._compared[0] is not codes:
            with one_thread():
                if self._table is None:
                    self._table = self._tabled()
                if self._most_lost is None:
                    self._most_lost = readout.system.most_lost
                white = readout.system.towards((codes - readout.origin)[None])
                solved = readout.system.solve_whitened(white)[0]
                compared = self._table.compared(white[0], self._most_lost, readout.gamma, solved)
            compared.take(readout.reference, readout.scores(codes, readout.reference, "lda"))  # they are held
            self._compared = codes, compared
        return self._compared[1]

    def _tabled(self) -> PruningTable:
        readout, whiten = self._readout, self._readout.system.whiten
        count = len(readout.names)
        blocks = (range(first, min(first + TABLED_AT_ONCE, count)) for first in range(0, count, TABLED_AT_ONCE))
        directions = principal_directions(whiten(readout.means_solved()[0]))
        return PruningTable(directions, (whiten(readout.read_means(block)) for block in blocks), count)

"""Many materials in two coarse copies: bounds of all scores select the few whose exact scores are computed.

With K = L Lᵀ, u_y = L⁻¹ m_y and v = L⁻¹ x a score is u_y·v − |u_y|² / 2. P, of r orthonormal rows, keeps the directions
in which the materials differ most. The residuals of u_y and v beyond these, a_y and b, are first bounded by their
lengths; then, for materials that this does not exclude, a_y is approximated by bytes q_y in steps of h_y:

    u_y·v = (P u_y)·(P v) + a_y·b,    |a_y·b| ≤ |a_y| |b|,    |a_y·b − h_y q_y·b| ≤ |a_y − h_y q_y| |b|.

After touches that came since K was inverted, K⁻¹ = L⁻ᵀ (I − B) L⁻¹ (see `system`): then v is (I − B) L⁻¹ x, the size of
a material is |u_y|² − u_yᵀ B u_y, and no eigenvalue of B is larger than a bound β: the score rises by β |u_y|² / 2 at
most. Only the copies of materials that changed are made again.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

from scroll_tactile.readouts.system import System
from scroll_tactile.statistics.moments import one_thread

__all__ = ["ManyMaterials", "PruningTable", "likeliest"]

FloatArray = npt.NDArray[np.float64]
Places = npt.NDArray[np.intp]

DIRECTIONS = 192  # of 1008: they hold four fifths of how ten thousand materials differ; with 128 a third more is read
STEPS = 127  # of a byte
UNIT = 2.0**-24  # of a rounding in single precision
FIRST = 4  # materials, of the highest guesses: the best of them excludes others
AT_ONCE = 64  # materials whose bytes are floats at once: they stay in the processor's cache
TABLED_AT_ONCE = 1024  # materials whose coarse copies are made at once
READ_AT_ONCE = 64  # materials whose means are read at once: they stay in the processor's cache


class PruningTable:
    """The materials of one readout, by place.

    near: P u, single precision, (C, r). sizes: |u|², (C,). far: |a|, (C,). bytes: q, (C, d). steps: h, (C,).
    lost: |a − h q|, (C,). directions: P, (r, d).
    """

    def __init__(self, directions: FloatArray, whitened: Iterable[FloatArray], count: int) -> None:
        """whitened: u of all C materials in order, in blocks (k, d)."""
        self.directions = directions
        self.near = np.empty((count, len(directions)), np.float32)
        self.bytes = np.empty((count, directions.shape[1]), np.int8)
        self.sizes, self.far, self.steps, self.lost = np.empty((4, count))
        first = 0
        for block in whitened:
            self._put(slice(first, first + len(block)), block)
            first += len(block)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]]) -> PruningTable:
        """The table of which `to_arrays` gave the arrays, which are taken over."""
        table = cls.__new__(cls)
        for name in cls.parts(0, 0):
            setattr(table, name, arrays[name])
        return table

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """The arrays by name."""
        return {name: getattr(self, name) for name in self.parts(0, 0)}

    @staticmethod
    def parts(count: int, dimension: int, directions: int = 0) -> dict[str, tuple[str, tuple[int, ...]]]:
        """The dtypes and shapes of the arrays of so many materials."""
        near, numbers = (count, directions), ("float64", (count,))
        found = {"directions": ("float64", (directions, dimension)), "near": ("float32", near)}
        return (
            found | {"bytes": ("int8", (count, dimension))} | dict.fromkeys(("sizes", "far", "steps", "lost"), numbers)
        )

    def _put(self, places: slice | Places, whitened: FloatArray) -> None:
        near = whitened @ self.directions.T
        rest = whitened - near @ self.directions
        steps = np.maximum(np.abs(rest).max(axis=1), np.finfo(float).tiny) / STEPS
        self.near[places], self.sizes[places] = near, _lengths(whitened) ** 2
        self.far[places], self.steps[places] = _lengths(rest), steps
        self.bytes[places] = quantised = np.rint(rest / steps[:, None])
        self.lost[places] = _lengths(rest - steps[:, None] * quantised)

    def copy(self) -> PruningTable:
        """A copy that changes independently."""
        other = copy.copy(self)
        for name in ("near", "bytes", "sizes", "far", "steps", "lost"):
            setattr(other, name, getattr(self, name).copy())
        return other

    def put(self, places: Places, whitened: FloatArray) -> None:
        """Replace the means of the materials at some places, or append them; whitened: u, (k, d)."""
        if (more := int(places.max()) + 1 - len(self.sizes)) > 0:
            for name in ("near", "bytes", "sizes", "far", "steps", "lost"):
                array = getattr(self, name)
                setattr(self, name, np.concatenate([array, np.zeros((more, *array.shape[1:]), array.dtype)]))
        self._put(places, whitened)

    def compared(self, white: FloatArray, most_lost: float, gamma: float, solved: FloatArray) -> Compared:
        """All materials beside v of shape (d,). most_lost: β. gamma: by which scores are multiplied."""
        near = self.directions @ white
        rest = white - near @ self.directions
        size, length = np.sqrt(white @ white), np.sqrt(rest @ rest)
        # Rounding errors of the products in single precision, and of the exact scores in double precision.
        rounded = np.sqrt(self.sizes) * ((len(near) + 16) * UNIT * size) + self.sizes * (most_lost / 2)
        with np.errstate(invalid="ignore"):  # some BLAS report a NaN that is not there, for few columns
            products = self.near @ near.astype(np.float32)
        guess = products.astype(np.float64) - self.sizes / 2
        most = gamma * (guess + self.far * length + rounded)
        return Compared(self, rest, float(length), rounded, gamma, solved, gamma * guess, most)


@dataclass
class Compared:
    """The bounds of one touch's scores for all materials, by place.

    solved: K⁻¹ x, (d,). guess: estimates of the scores, (C,). most: their upper bounds, (C,). rest: b; length: its own.
    known: which estimates are exact, (C,). rounded: the part of `most`, over γ, for rounding and for columns that came
    since K was inverted, (C,).
    """

    table: PruningTable
    rest: FloatArray
    length: float
    rounded: FloatArray
    gamma: float
    solved: FloatArray
    guess: FloatArray
    most: FloatArray

    def __post_init__(self) -> None:
        self.known, self._fine = np.zeros((2, len(self.guess)), dtype=np.bool_)
        self.nearest: tuple[Places, int, float] | None = None  # of some materials, which novelty asks for again

    def take(self, places: Places, scores: FloatArray) -> None:
        """Replace the estimates of some materials by their exact scores."""
        self.guess[places], self.known[places], self._fine[places] = scores, True, True
        self.most[places] = scores + UNIT * (np.abs(scores) + self.gamma * self.table.sizes[places])

    def refine(self, places: Places) -> None:
        """Bound the scores of some materials by their bytes as well."""
        places, table = places[~self._fine[places]], self.table
        rest, products = self.rest.astype(np.float32), np.empty(len(places), np.float32)
        floats = np.empty((min(AT_ONCE, len(places)), len(rest)), np.float32)
        for first in range(0, len(places), AT_ONCE):
            some = places[first : first + AT_ONCE]
            np.copyto(floats[: len(some)], table.bytes.take(some, axis=0))
            np.matmul(floats[: len(some)], rest, out=products[first : first + AT_ONCE])
        slack = table.lost[places] + (len(rest) + 16) * UNIT * table.far[places]
        self.guess[places] += self.gamma * (table.steps[places] * products)
        self.most[places] = self.guess[places] + self.gamma * (slack * self.length + self.rounded[places])
        self._fine[places] = True


class _Materials(Protocol):
    """The part of `readout.Readout` that the bounds of many materials need."""

    names: list[str]
    reference: Places
    origin: FloatArray
    system: System

    @property
    def gamma(self) -> float: ...

    def means_solved(self) -> tuple[FloatArray, FloatArray]: ...

    def read_means(self, places: Iterable[int]) -> FloatArray: ...

    def scores(self, features: FloatArray, places: Places, kind: Literal["lda"]) -> FloatArray: ...


class ManyMaterials:
    """All materials of one readout in coarse copies, with the bounds of the last touch."""

    def __init__(self, readout: _Materials, table: PruningTable | None = None) -> None:
        self._readout, self._table = readout, table
        self._most_lost: float | None = None
        self._compared: tuple[FloatArray, Compared] | None = None

    def copy(self, readout: _Materials) -> ManyMaterials:
        """The materials of a copy of the readout."""
        return ManyMaterials(readout, None if self._table is None else self._table.copy())

    def forget(self) -> None:
        """Drop the bounds: the readout changes."""
        self._compared = self._most_lost = None

    def put(self, places: Places, whitened: FloatArray) -> None:
        """Replace the means of the materials at some places, or append them; whitened: L⁻¹ m, (k, d)."""
        if self._table is not None:
            self._table.put(places, whitened)

    def bounds(self, features: FloatArray, places: Places, *, fine: bool = False) -> tuple[FloatArray, FloatArray]:
        """Estimates of the scores "lda" of some materials, and their upper bounds, (k,) each."""
        compared = self._beside(features)
        if fine:
            compared.refine(places)
        return compared.guess[places], compared.most[places]

    def nearest(self, features: FloatArray, places: Places) -> tuple[int, float]:
        """Of some materials the one of the highest score "lda", by its place, and that score."""
        compared = self._beside(features)
        if compared.nearest is None or compared.nearest[0] is not places:
            chosen, scores = likeliest(
                places,
                lambda some, fine: self.bounds(features, some, fine=fine > 0),
                lambda some: self.exact(features, some),
            )
            best = int(scores.argmax())
            compared.nearest = places, int(chosen[best]), float(scores[best])
        return compared.nearest[1:]

    def exact(self, features: FloatArray, places: Places) -> FloatArray:
        """The scores "lda" of any materials for features (d,), shape (k,), without holding these materials."""
        compared, readout = self._beside(features), self._readout
        unknown = places[~compared.known[places]]
        with one_thread():
            for first in range(0, len(unknown), READ_AT_ONCE):
                some = unknown[first : first + READ_AT_ONCE]
                means, sizes = readout.read_means(some), compared.table.sizes[some]
                if readout.system.rank:
                    sizes = sizes - readout.system.lost(readout.system.whiten(means))
                compared.take(some, readout.gamma * (means @ compared.solved - sizes / 2))
        return compared.guess[places]

    def _beside(self, features: FloatArray) -> Compared:
        """The bounds for features (d,); those of the last features are cached."""
        readout = self._readout
        if self._compared is None or self._compared[0] is not features:
            with one_thread():
                table = self.table
                if self._most_lost is None:
                    self._most_lost = readout.system.most_lost
                white = readout.system.towards((features - readout.origin)[None])
                solved = readout.system.solve_whitened(white)[0]
                compared = table.compared(white[0], self._most_lost, readout.gamma, solved)
            compared.take(readout.reference, readout.scores(features, readout.reference, "lda"))  # they are held
            self._compared = features, compared
        return self._compared[1]

    @property
    def table(self) -> PruningTable:
        """The coarse copies, made when they are first needed."""
        if self._table is None:
            with one_thread():
                self._table = self._tabled()
        return self._table

    def _tabled(self) -> PruningTable:
        readout, whiten = self._readout, self._readout.system.whiten
        count = len(readout.names)
        blocks = (range(first, min(first + TABLED_AT_ONCE, count)) for first in range(0, count, TABLED_AT_ONCE))
        directions = principal_directions(whiten(readout.means_solved()[0]))
        return PruningTable(directions, (whiten(readout.read_means(block)) for block in blocks), count)


def principal_directions(whitened: FloatArray) -> FloatArray:
    """Orthonormal rows (r, d), the directions in which some u, (k, d), are longest."""
    _, vectors = np.linalg.eigh(whitened @ whitened.T)
    return np.linalg.qr((vectors[:, ::-1][:, :DIRECTIONS].T @ whitened).T)[0].T


def likeliest(
    places: Places,
    bounds: Callable[[Places, int], tuple[FloatArray, FloatArray]],
    exact: Callable[[Places], FloatArray],
    margin: float = 0.0,
    finest: int = 1,
) -> tuple[Places, FloatArray]:
    """The materials that may come within a margin of the highest score, in their order, and their exact scores.

    bounds: (places, level) → estimates of their scores and upper bounds, finer with each level from 0 to `finest`.
    exact: places → their scores.
    """
    guess, most = bounds(places, 0)
    first = np.argpartition(-guess, min(FIRST, len(guess)) - 1)[:FIRST]
    least = exact(places[first]).max() - margin
    most[first] = np.inf  # the table of another's memory may say what is false: then something is left all the same
    places = places[~(most < least)]
    for fine in range(1, finest + 1):
        places = places[~(bounds(places, fine)[1] < least)]
    return places, exact(places)


def _lengths(rows: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.einsum("kd,kd->k", rows, rows)))

"""Banks of convolution kernels, and their responses to an image, by numpy's whole passes over all kernels.

Weights and readings are small integers, so a response is an integer below 2²⁴ and float32 arithmetic is exact:
no thread count, batch, instruction set or machine changes a bit of it.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["HEAVY", "ROUND", "TAPS", "Bank", "Floats", "workspace"]

TAPS = 9
ROUND = 84  # each position of the three heavy taps once

# Those positions, in an order in which kernels that follow each other have them a place later: rows of a matrix that
# follow each other, read with one step more, are then added at once; see `Workspace`.
HEAVY = [(i, i + p, i + q) for q in range(2, TAPS) for p in range(1, q) for i in range(TAPS - q)]
TOGETHER = 2**18  # responses: so many stay in the processor's cache
MOST_STEPS = 64  # of dilations and lengths of images

Floats = npt.NDArray[np.float32]
Step = tuple[np.ufunc, Floats, Floats | float, Floats]  # what is done with two arrays, and where to


@dataclass(frozen=True, eq=False)
class Bank:
    """The kernels of one dilation.

    dilation: readings between two taps.
    channels: 0 or 1, float32 of shape (rows, C): which channels a kernel sums. Rows come in rounds of 84, each with
        all positions of the heavy taps in the order of HEAVY; in the last round some may belong to no kernel.
    rows: the row of each kernel, shape (K,).
    thresholds: float32 of shape (THRESHOLDS, K), halves of odd integers, so that no response equals one.
    """

    dilation: int
    channels: Floats
    rows: npt.NDArray[np.intp]
    thresholds: Floats

    def __len__(self) -> int:
        return len(self.rows)


class Workspace(threading.local):
    """The arrays of a thread that every image is convolved in, and the steps of it.

    To get their pages from the system anew takes as long as to convolve, and to make views of them a tenth of it.
    """

    def __init__(self) -> None:
        self._arrays: dict[str, Floats] = {}
        self._steps: dict[tuple[int, int, int, int], tuple[list[Step], Floats]] = {}

    def array(self, name: str, rows: int, columns: int) -> Floats:
        """The array of a name, shape (rows, columns), of whatever values."""
        size = rows * columns
        if name not in self._arrays or len(self._arrays[name]) < size:
            self._arrays[name] = np.empty(size, dtype=np.float32)
            self._steps.clear()  # they keep those before
        return self._arrays[name][:size].reshape(rows, columns)

    def respond(self, rows: slice, readings: int, dilation: int) -> Floats:
        """Responses of whole rounds of kernels to sums of channels: the array "sums" has these, in so many rows.

        Exact integers of shape (rows, readings − 8·dilation): three times the heavy taps less the sum of all nine.
        The sums are lost, the responses stay until the next are made.
        """
        key = rows.start, rows.stop, readings, dilation
        if key not in self._steps:
            if len(self._steps) >= MOST_STEPS:
                self._steps.clear()
            self._steps[key] = self._planned(rows, readings, dilation)
        steps, responses = self._steps[key]
        for put, left, right, into in steps:
            put(left, right, into)
        return responses

    def _planned(self, rows: slice, readings: int, dilation: int) -> tuple[list[Step], Floats]:
        sums, count = self.array("sums", rows.stop, readings)[rows], rows.stop - rows.start
        responses = self.array("responses", count, readings + dilation)
        block = ROUND * max(1, TOGETHER // (ROUND * readings))
        first, second = (self.array(name, min(block, count), readings) for name in ("first", "second"))
        steps: list[Step] = []
        for i in range(0, count, block):
            some = slice(i, min(i + block, count))
            steps += _steps(sums[some], responses[some], first, second, dilation)
        return steps, responses[:, : readings - (TAPS - 1) * dilation]


workspace = Workspace()


def _steps(sums: Floats, responses: Floats, first: Floats, second: Floats, dilation: int) -> Iterator[Step]:
    """How sums of channels become responses; two arrays like the sums are between."""
    (rows, readings), flat = sums.shape, sums.reshape(-1)
    one, two = first.reshape(-1), second.reshape(-1)
    # The sum of nine by doubling, of all rows as one: what runs over into the next lies behind the places of its own.
    size = len(flat) - dilation
    yield np.add, flat[:size], flat[dilation:], one[:size]
    size -= 2 * dilation
    yield np.add, one[:size], one[2 * dilation :][:size], two[:size]
    size -= 4 * dilation
    yield np.add, two[:size], two[4 * dilation :][:size], one[:size]
    size -= dilation
    yield np.add, one[:size], flat[8 * dilation :], one[:size]
    yield np.multiply, flat, 3.0, flat
    yield from _heavy_steps(flat, responses.reshape(-1), readings, dilation)
    places = readings - (TAPS - 1) * dilation
    own = responses[:, :places]
    yield np.subtract, own, first[:rows, :places], own


def _heavy_steps(sums: Floats, responses: Floats, readings: int, dilation: int) -> Iterator[Step]:
    """How the sums at the three heavy taps of each row are added; both flat, a row of sums as long as the readings.

    A row of responses is longer by the dilation: where the taps of the next row lie one place later, the rows of both
    are one run.
    """
    longer, row = readings + dilation, 0
    for outer in range(2, TAPS):  # places between the first tap and the last
        runs, each = outer - 1, TAPS - outer  # one for each place of the tap between; rows in each
        # The responses of the last row end the array: what lies behind them is left out.
        width = each * longer - (TAPS * dilation if each == 1 else 0)
        shape = len(responses) // (ROUND * longer), runs, width
        into = _runs(responses, row * longer, shape, (ROUND * longer, each * longer))
        taps = [
            _runs(sums, row * readings + tap * dilation, shape, (ROUND * readings, each * readings + later * dilation))
            for tap, later in ((0, 0), (1, 1), (outer, 0))
        ]
        yield np.add, taps[0], taps[1], into
        yield np.add, into, taps[2], into
        row += runs * each


def _runs(flat: Floats, first: int, shape: tuple[int, int, int], steps: tuple[int, int]) -> Floats:
    """A view of a flat array, of runs so many places apart."""
    size = flat.itemsize
    return np.ndarray(shape, np.float32, flat, first * size, (steps[0] * size, steps[1] * size, size))

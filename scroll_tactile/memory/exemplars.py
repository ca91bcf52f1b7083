"""Exemplars: the bounded set of raw streams for fine-tuning, a function of what was observed and not of the order.

S. Rebuffi et al. (iCaRL, CVPR 2017, algorithm 4) herd: they pick streams whose mean stays next to the class mean.
Herding at every observation, as SCROLL does, makes the choice depend on the order. Here content hashes alone choose
candidates, a few for each place in the buffer. When the buffer is needed, these are herded towards the exact mean that
the statistics hold.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError, MismatchError
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.grid import BITS, mean_code
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.sample import Sample
from scroll_tactile.statistics.statistics import Statistics

__all__ = ["CANDIDATES", "Exemplar", "ExemplarSample", "herd", "quotas", "rank", "ranked_exemplars"]

IntArray = npt.NDArray[np.int64]

# Kept for each place in the buffer. With 3 the gap to the class mean is at most 1.08 times that of herding from every
# touch (BioTac and RoboSkin, five folds, 5 to 20 exemplars a material); with 2 it reaches 1.24, with 4 it is 1.06.
CANDIDATES = 3
MOST_FEATURES = 2 ** (53 - 2 * BITS)  # of codes: a product of two rows is then exact in float64
LIMB = 32  # bits


def herd(candidates: npt.NDArray[np.integer], keys: Sequence[bytes], mean: IntArray, count: int) -> list[int]:
    """Places of the first `count` candidates (of all where there are fewer) in herding order.

    Step k takes argmin_x ‖μ − (x + Σ_{j<k} x_j) / k‖ of those not yet taken (iCaRL, algorithm 4; features as they
    are, not brought to unit norm); of equal ones that with the smallest key. What is compared is the exact integer
    ‖x‖² − 2 x·(kμ − Σ_{j<k} x_j), so the order is the same on every machine and whatever the order of the candidates,
    and fewer are a beginning of more.

    candidates: codes of shape (N, d), of magnitude at most 2²⁰, d at most 8192. keys: N different content hashes.
    mean: μ, codes of shape (d,). Raises InputError for anything else.
    """
    _require_codes(candidates, keys, mean, count)
    order = sorted(range(len(keys)), key=keys.__getitem__)
    rows, target = candidates[order].astype(np.float64), mean.astype(np.float64)
    with one_thread():
        # Each product of rows is below 2⁵³, exact in any order. The score is kept in two limbs: at step k it may
        # reach (4k − 1)·d·2⁴⁰, which from d·k = 2²¹ on would not fit 64 bits.
        norms, towards = _exact(np.einsum("nd,nd->n", rows, rows)), _exact(rows @ target)
        high, low = _carried(np.zeros_like(norms), norms - 2 * towards)
        free = np.ones(len(rows), dtype=bool)
        chosen: list[int] = []
        while len(chosen) < min(count, len(rows)):
            places = np.flatnonzero(free)
            places = places[high[places] == high[places].min()]
            pick = int(places[low[places].argmin()])  # the first of equal ones: by key
            free[pick] = False
            chosen.append(order[pick])
            change = 2 * (_exact(rows @ rows[pick]) - towards)
            more, low = _carried(high, low + (change & (2**LIMB - 1)))
            high = more + (change >> LIMB)
    return chosen


def _exact(values: npt.NDArray[np.float64]) -> IntArray:
    return values.astype(np.int64)


def _carried(high: IntArray, low: IntArray) -> tuple[IntArray, IntArray]:
    return high + (low >> LIMB), low & (2**LIMB - 1)


def _require_codes(
    candidates: npt.NDArray[np.integer], keys: Sequence[bytes], mean: npt.NDArray[np.integer], count: int
) -> None:
    integers = candidates.dtype.kind in "iu" and mean.dtype.kind in "iu"
    fits = candidates.ndim == 2 and mean.shape == candidates.shape[1:] and candidates.shape[1] <= MOST_FEATURES
    if not integers or not fits or len(set(keys)) != len(candidates) or len(keys) != len(candidates) or count < 0:
        raise InputError(
            f"expected integer codes of shape (N, d), d at most {MOST_FEATURES}, a mean of shape (d,), N different "
            f"keys and a count of 0 or more; came codes of {candidates.dtype} {candidates.shape}, a mean of "
            f"{mean.dtype} {mean.shape}, {len(keys)} keys of which {len(set(keys))} differ, and {count}"
        )
    largest = max(max(int(array.max(initial=0)), -int(array.min(initial=0))) for array in (candidates, mean))
    if largest > 2**BITS:
        raise InputError(f"expected codes of magnitude at most {2**BITS}; came {largest}. Round features by to_codes")


def quotas(available: Mapping[str, int], capacity: int) -> dict[str, int]:
    """Places of each material in a buffer: as even as can be, spare ones to the materials that have more.

    available: streams that there are of each. The sum is min(capacity, Σ available); a larger buffer takes a place
    from nobody. Of materials with as many streams the first by name come first. Raises InputError for negative
    numbers.
    """
    if capacity < 0 or min(available.values(), default=0) < 0:
        raise InputError(f"expected numbers of streams, 0 or more; came capacity {capacity} and {dict(available)}")
    places, left = {}, capacity
    ascending = sorted(available, key=lambda name: (available[name], name))
    for i, name in enumerate(ascending):
        places[name] = min(-(-left // (len(ascending) - i)), available[name])
        left -= places[name]
    return {name: places[name] for name in sorted(places)}


@dataclass(frozen=True, eq=False)
class Exemplar:
    """A stream kept raw, with what herding needs of it.

    readings: float32 of shape (T, n), for a camera (T, height, width, 3), in the sensor's unit.
    code: mean code of its windows at its widest scale, rounded: int32 of shape (d,). scale: their width in columns.
    """

    material: str
    key: bytes
    readings: npt.NDArray[np.float32]
    code: npt.NDArray[np.int32]
    scale: Scale

    @classmethod
    def of(
        cls,
        material: str,
        key: bytes,
        readings: npt.NDArray[np.float32],
        codes: Mapping[Scale, npt.NDArray[np.int32]],
    ) -> Exemplar:
        """The exemplar of a stream; codes: for each scale those of its windows, shape (windows, d)."""
        scale = max(scale for scale, rows in codes.items() if len(rows))
        code = mean_code(codes[scale].sum(axis=0, dtype=np.int64), len(codes[scale]))
        return cls(material, key, readings, code.astype(np.int32), scale)


class ExemplarSample:
    """The candidates for the buffer: a function of the set of streams observed (see `Sample`).

    capacity: streams in the buffer; `ratio` times as many candidates are kept.
    ratio: at 1 the buffer is a random choice; more candidates come nearer to the class mean.

    Raises InputError for a capacity or ratio below 1.
    """

    def __init__(self, capacity: int, *, ratio: int = CANDIDATES) -> None:
        if min(capacity, ratio) < 1:
            raise InputError(
                f"expected a capacity and a ratio of candidates to exemplars of 1 or more; came {capacity} and {ratio}"
            )
        self.capacity = capacity
        self.ratio = ratio
        self._sample: Sample[Exemplar] = Sample(ratio * capacity)

    def __len__(self) -> int:
        return len(self._sample)

    def __iter__(self) -> Iterator[Exemplar]:
        """The candidates, by material and key."""
        for *_, exemplar in self._sample:
            yield exemplar

    def holds(self, material: str, key: bytes) -> bool:
        """Whether a stream is a candidate; if not, it can be retracted without a change here."""
        return self._sample.holds(material, key)

    def wants(self, material: str, key: bytes) -> bool:
        """Whether `add` would keep a stream."""
        return self._sample.wants(material, key)

    def add(self, exemplar: Exemplar) -> None:
        """Add a stream where it belongs in, and drop what falls out."""
        self._sample.add(exemplar.material, exemplar.key, exemplar)

    def refill(self, streams: Iterable[tuple[str, bytes, int]], make: Callable[[str, bytes, int], Exemplar]) -> None:
        """Add all streams; see `Sample.refill`."""
        self._sample.refill(streams, make)

    def update(self, other: ExemplarSample) -> None:
        """Add all candidates of another sample: this one is then as if it had observed what both did.

        Raises MismatchError where their capacities differ.
        """
        if (self.capacity, self.ratio) != (other.capacity, other.ratio):
            raise MismatchError(
                f"expected candidates for {self.capacity} exemplars at ratio {self.ratio}; came those for "
                f"{other.capacity} at {other.ratio}. Open both with one capacity"
            )
        self._sample.update(other._sample)

    def to_arrays(self) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """What a store keeps: arrays by name, and JSON beside them.

        The readings lie one behind another on the time axis, exemplar-lengths many of each.
        """
        exemplars = list(self)
        codes, readings = [exemplar.code for exemplar in exemplars], [exemplar.readings for exemplar in exemplars]
        arrays: dict[str, npt.NDArray[Any]] = {
            "exemplar-keys": np.array([list(exemplar.key) for exemplar in exemplars] or [[]], np.uint8)[: len(self)],
            "exemplar-lengths": np.array([len(stream) for stream in readings], np.int64),
            "exemplar-scales": np.array([int(exemplar.scale) for exemplar in exemplars], np.int64),
            "exemplar-codes": np.stack(codes) if codes else np.zeros((0, 0), np.int32),
            "exemplar-readings": np.concatenate(readings) if readings else np.zeros((0, 0), np.float32),
        }
        # Version 0.1 expects "felt": what a limit in bytes had dropped.
        return arrays, {"materials": [exemplar.material for exemplar in exemplars], "felt": {}}

    @classmethod
    def from_arrays(
        cls,
        arrays: Mapping[str, npt.NDArray[Any]],
        attributes: Mapping[str, Any],
        capacity: int,
        *,
        ratio: int = CANDIDATES,
    ) -> ExemplarSample:
        """The sample that `to_arrays` gave, or one of less capacity; one of more lacks what was dropped before."""
        sample = cls(capacity, ratio=ratio)
        readings = np.split(arrays["exemplar-readings"], np.cumsum(arrays["exemplar-lengths"])[:-1])
        rows = zip(arrays["exemplar-keys"], arrays["exemplar-codes"], arrays["exemplar-scales"], strict=True)
        for i, (material, (key, code, scale)) in enumerate(zip(attributes["materials"], rows, strict=True)):
            sample.add(Exemplar(material, key.tobytes(), readings[i].copy(), code, Scale.numbered(int(scale))))
        return sample


def rank(sample: ExemplarSample, means: Callable[[str, Scale], IntArray]) -> dict[str, list[Exemplar]]:
    """The buffer: each material's exemplars, in herding order, cut to its quota; materials in alphabetical order.

    means: (material, scale) → the exact mean code there, rounded, int64 of shape (d,); see `mean_code`.
    The candidates of the material's widest scale are herded; briefer ones come after them, by scale and key. A smaller
    buffer is the beginning of a larger one.
    """
    candidates: dict[str, list[Exemplar]] = {}
    for exemplar in sample:
        candidates.setdefault(exemplar.material, []).append(exemplar)
    places = quotas({material: len(exemplars) for material, exemplars in candidates.items()}, sample.capacity)
    return {material: _herded(candidates[material], means, count) for material, count in places.items() if count}


def _herded(candidates: list[Exemplar], means: Callable[[str, Scale], IntArray], count: int) -> list[Exemplar]:
    widest = max(exemplar.scale for exemplar in candidates)
    wide = [exemplar for exemplar in candidates if exemplar.scale == widest]
    brief = [exemplar for exemplar in candidates if exemplar.scale != widest]
    brief.sort(key=lambda exemplar: (-int(exemplar.scale), exemplar.key))
    codes, keys = np.stack([exemplar.code for exemplar in wide]), [exemplar.key for exemplar in wide]
    order = herd(codes, keys, means(candidates[0].material, widest), count)
    return ([wide[place] for place in order] + brief)[:count]


def ranked_exemplars(sample: ExemplarSample, statistics: Statistics) -> dict[str, list[Exemplar]]:
    """The buffer, as `rank`, against the exact means of all that was observed."""

    def mean(material: str, scale: Scale) -> IntArray:
        return mean_code(statistics.sums(scale, [material])[0], int(statistics.counts(scale, [material])[0]))

    return rank(sample, mean)

"""Exemplars: the bounded set of raw streams for fine-tuning, a function of what was observed and not of the order.

S. Rebuffi et al. (iCaRL, CVPR 2017, algorithm 4) herd: they pick streams whose mean stays next to the class mean.
Herding at every observation, as SCROLL does, makes the choice depend on the order. Here content hashes alone choose
candidates, a few for each place in the buffer. When the buffer is needed, these are herded towards the exact mean that
the statistics hold.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
import numpy.typing as npt

from scroll_tactile.memory.touch_rows import Codes, Readings
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.fields import Ints, Must, key_rows
from scroll_tactile.statistics.grid import BITS
from scroll_tactile.statistics.sample import Sample, SampledTouch, Stages, TouchFields
from scroll_tactile.statistics.statistics import LONGEST_TOUCH

__all__ = ["CANDIDATES", "Exemplar", "ExemplarFields", "herd", "quotas", "rank"]

# Kept for each place in the buffer. With 3 the gap to the class mean is at most 1.08 times that of herding from every
# touch (BioTac and RoboSkin, five folds, 5 to 20 exemplars a material); with 2 it reaches 1.24, with 4 it is 1.06.
CANDIDATES = 3


def herd(candidates: npt.NDArray[np.integer], keys: Sequence[bytes], mean: Ints, count: int) -> list[int]:
    """Places of the first `count` candidates (of all where there are fewer) in herding order.

    Step k takes argmin_x ‖μ − (x + Σ_{j<k} x_j) / k‖ of those not yet taken (iCaRL, algorithm 4; features as they
    are, not brought to unit norm); of equal ones that with the smallest key. What is compared is the exact integer
    ‖x‖² − 2 x·(kμ − Σ_{j<k} x_j), so the order is the same on every machine and whatever the order of the candidates,
    and fewer are a beginning of more.

    candidates: codes of shape (N, d). keys: N different content hashes. mean: μ, codes of shape (d,).
    """
    order = sorted(range(len(keys)), key=keys.__getitem__)
    rows, left, chosen = candidates[order].astype(np.int64), list(range(len(keys))), list[int]()
    # A product of two rows fits 64 bits. Scores are Python's integers: at step k they reach (4k − 1)·d·2⁴⁰.
    towards = (rows @ mean.astype(np.int64)).astype(object)
    scores = np.einsum("nd,nd->n", rows, rows).astype(object) - 2 * towards
    while left and len(chosen) < count:
        pick = min(left, key=scores.__getitem__)  # the first of equal ones: by key
        left.remove(pick)
        chosen.append(order[pick])
        scores = scores + 2 * ((rows @ rows[pick]).astype(object) - towards)
    return chosen


def quotas(available: Mapping[str, int], capacity: int) -> dict[str, int]:
    """Places of each material in a buffer: as even as can be, spare ones to the materials that have more.

    available: streams that there are of each. The sum is min(capacity, Σ available); a larger buffer takes a place
    from nobody. Of materials with as many streams the first by name come first.
    """
    places, left = {}, capacity
    ascending = sorted(available, key=lambda name: (available[name], name))
    for i, name in enumerate(ascending):
        places[name] = min(-(-left // (len(ascending) - i)), available[name])
        left -= places[name]
    return {name: places[name] for name in sorted(places)}


@dataclass(frozen=True, eq=False)
class Exemplar:
    """A stream with its readings, and what herding needs of it.

    readings: float32 of shape (T, n), for a camera (T, height, width, 3), in the sensor's unit. code: its mean row of
    codes at its last stage and widest windows, int32 of shape (d,). scale: theirs.
    """

    material: str
    key: bytes
    readings: Readings
    code: npt.NDArray[np.int32]
    scale: Scale

    @classmethod
    def of(cls, material: str, key: bytes, readings: Readings, stages: Stages, codes: Codes) -> Self:
        """The exemplar of a stream; stages: those that it reached. codes: its rows by scale, its own first."""
        # Not by a view: the tuned model is trained on windows.
        windows = [{scale: rows for scale, rows in stage.items() if scale.kind == "window"} for stage in stages]
        return cls(material, key, readings, SampledTouch.of(windows, codes).rows[-1], max(windows[-1]))


@dataclass
class HeldFields:
    """What a store keeps of n touches whose rows it left behind.

    lengths: in readings, (n,). scales: the numbers of the scales of their codes, (n,). codes: see `Exemplar`, (n, d).
    readings: one touch behind another in time, (Σ lengths, ...).
    """

    lengths: Annotated[Ints, Must("int64", "n", 0, LONGEST_TOUCH)]
    scales: Annotated[Ints, Must("int64", "n", 1)]
    codes: Annotated[npt.NDArray[np.int32], Must("int32", "n *", -(2**BITS), 2**BITS)]
    readings: Annotated[npt.NDArray[np.float32], Must("float32", "* ...")]


@dataclass
class ExemplarFields(TouchFields):
    """What a store keeps of the candidates for the buffer, a sample of rows of the journal.

    sources: the row in which the readings of each lie; 0 or a compacted row: the compaction checkpoint, (n,). held:
    their touches, where no row has them.
    """

    sources: Annotated[Ints, Must("int64", "n", 0)]
    held: HeldFields | None = None

    @classmethod
    def of(cls, sample: Sample[int], candidates: Sequence[Exemplar] | None = None) -> Self:
        """What is kept; candidates: with their readings, for what leaves the rows of the journal behind."""
        if candidates is None:
            return cls(*sample.named(), np.array(sample.touches(), np.int64))
        readings = [candidate.readings for candidate in candidates]
        held = HeldFields(
            np.array([len(touch) for touch in readings], np.int64),
            np.array([int(candidate.scale) for candidate in candidates], np.int64),
            np.stack([candidate.code for candidate in candidates]) if readings else np.zeros((0, 0), np.int32),
            np.concatenate(readings) if readings else np.zeros((0, 0), np.float32),
        )
        names, keys = [one.material for one in candidates], key_rows([one.key for one in candidates])
        return cls(names, [], keys, np.zeros(len(names), np.int64), held)

    def rows(self, source: int) -> list[tuple[str, bytes, int]]:
        """The sample as it was, of which one of fewer keeps the first. source: the row of those with readings."""
        sources = self.sources.tolist() if self.held is None else [source] * len(self.materials)
        return [(name, key, row) for (name, key, _), row in zip(self.named(), sources, strict=True)]

    def exemplars(self) -> list[Exemplar]:
        """The exemplars that came with their readings."""
        if self.held is None:
            return []
        parts = np.split(self.held.readings, np.cumsum(self.held.lengths)[:-1])
        scales = [Scale.numbered(number) for number in self.held.scales.tolist()]
        own = zip(self.named(), parts, self.held.codes, scales, strict=False)
        return [Exemplar(name, key, readings, code, scale) for (name, key, _), readings, code, scale in own]


def rank(candidates: Iterable[Exemplar], count: int, means: Callable[[str, Scale], Ints]) -> dict[str, list[Exemplar]]:
    """The buffer: each material's exemplars, in herding order, cut to its quota; materials in alphabetical order.

    count: exemplars in the buffer. means: (material, scale) → the exact mean code there, rounded, int64 of shape (d,);
    see `mean_code`. The candidates of the material's widest scale are herded; briefer ones come after them, by scale
    and key. A smaller buffer is the beginning of a larger one.
    """
    by_material: dict[str, list[Exemplar]] = {}
    for exemplar in candidates:
        by_material.setdefault(exemplar.material, []).append(exemplar)
    places = quotas({material: len(exemplars) for material, exemplars in by_material.items()}, count)
    return {material: _herded(by_material[material], means, share) for material, share in places.items() if share}


def _herded(candidates: list[Exemplar], means: Callable[[str, Scale], Ints], count: int) -> list[Exemplar]:
    widest = max(exemplar.scale for exemplar in candidates)
    wide = [exemplar for exemplar in candidates if exemplar.scale == widest]
    brief = sorted((one for one in candidates if one.scale != widest), key=lambda one: (-int(one.scale), one.key))
    codes, keys = np.stack([exemplar.code for exemplar in wide]), [exemplar.key for exemplar in wide]
    order = herd(codes, keys, means(candidates[0].material, widest), count)
    return ([wide[place] for place in order] + brief)[:count]

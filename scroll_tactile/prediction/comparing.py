"""A touch beside kept ones: compared in one way or two, and judged again with its stuck channels filled in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scroll_tactile.prediction.features import Encoded, FeatureExtractor
from scroll_tactile.prediction.model import Judgement, Model
from scroll_tactile.readouts.likelihood import CLEAN, LevelArray, levels_of
from scroll_tactile.readouts.pooled import Pooled
from scroll_tactile.readouts.recollection import Recollection
from scroll_tactile.signals.stream import Stream

__all__ = ["Compared", "compared", "levels_seen"]

FloatArray = npt.NDArray[np.float64]

TINY = 1e-300


@dataclass(frozen=True)
class Compared:
    """A touch compared in one way.

    judgement: the model's, of the touch as filled in. recollection: the kept touches'. own_time: whether it was
    compared with beginnings, and not with whole touches brought to its length.
    """

    judgement: Judgement
    recollection: Recollection
    own_time: bool

    @property
    def logs(self) -> FloatArray:
        """What the model says of the candidates, less what noise takes from it, (C,)."""
        return np.asarray((1 - self.recollection.trust) * np.log(np.maximum(self.judgement.probability, TINY)))

    def scores(self, pooled: Pooled, candidates: Sequence[str]) -> FloatArray:
        """What the kept touches say of the candidates, (C,); the least of those of which none is kept."""
        places = {name: i for i, name in enumerate(pooled.recall.materials)}
        least, said = float(self.recollection.scores.min()), self.recollection.scores
        return np.array([said[places[name]] if name in places else least for name in candidates])

    def novelty(self, pooled: Pooled) -> float:
        """How unlike the candidates it is by both, each as far as noise lets it be believed."""
        trust = self.recollection.trust
        return float((1 - trust) * self.judgement.novelty + trust * pooled.novelty(self.recollection))


def compared(
    model: Model,
    extractor: FeatureExtractor,
    candidates: Sequence[str],
    encoded: Encoded,
    judgement: Judgement,
    pooled: Pooled,
    *,
    left_out: int | None = None,
) -> list[Compared]:
    """Compare an encoded touch, of which the model alone says `judgement`, in its own time and as a whole one.

    left_out: the row of a kept touch that it is the beginning of: then in its own time only, and nothing came over it.
    """
    levels = levels_seen(encoded.stream)
    noise = None if left_out is None else CLEAN
    ways = [(pooled.recall.recollect(levels, left_out=left_out, noise=noise), True)]
    if left_out is None and levels.shape[1] != pooled.recall.longest and levels.shape[1] > 1:
        ways.append((pooled.recall.recollect(levels, whole=True), False))
    filled = _filled(model, extractor, encoded, max((way for way, _ in ways), key=lambda way: way.evidence))
    usual = encoded.columns >= model.least
    said = {usual: judgement} if filled is encoded else {}  # by the model, by whether the touch counts as a whole one
    for whole in {usual or not own_time for _, own_time in ways} - set(said):
        said[whole] = model.judge(candidates, filled.means, filled.columns, whole=whole)
    return [Compared(said[usual or not own_time], way, own_time) for way, own_time in ways]


def levels_seen(stream: Stream) -> LevelArray:
    """The levels of a touch, (C, T), MISSING where a reading was."""
    readings = stream.readings if stream.mask is None else np.where(stream.mask, np.nan, stream.readings)
    return levels_of(readings, stream.sensor)


def _filled(model: Model, extractor: FeatureExtractor, encoded: Encoded, recollection: Recollection) -> Encoded:
    """The touch with its stuck channels as kept touches have them, where that changes any of its levels."""
    stream = encoded.stream
    readings = recollection.filled(stream.readings, stream.sensor)
    if np.array_equal(levels_of(readings, stream.sensor), levels_of(stream.readings, stream.sensor)):
        return encoded
    readings.setflags(write=False)
    needed = [*encoded.means]
    return extractor.encode(Stream(stream.sensor, readings), model.longest, lambda columns: needed)

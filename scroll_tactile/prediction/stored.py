"""The fitted model as arrays beside its checkpoint, so that the next opening needs no fit.

It has all that predictions read, with the banks of kernels, but not the sample, the held-out touches or K: a stored
model cannot follow, and is renewed when touches come or go (see `prediction.current`). The levels of kept touches are
the memory's.

A file may come from elsewhere. Types, shapes and bounds of its arrays are checked against the memory, so that no
prediction fails or takes more memory because of it. Whether its numbers are the fitted ones cannot be checked. Models
of another release, readout or memory are not read.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scroll_tactile_store import Checkpoint

from scroll_tactile import __version__
from scroll_tactile.embeddings.convolution import MOST_CHANNELS, ROUND, THRESHOLDS, Bank, bank_size
from scroll_tactile.embeddings.kernels import Kernels
from scroll_tactile.embeddings.protocol import Embedding
from scroll_tactile.matching.conformal import Conformal
from scroll_tactile.matching.kept_arrays import KeptArrays
from scroll_tactile.matching.likelihood import LEVELS, Likelihood
from scroll_tactile.matching.match import KeptTouch, NaturalDeviation
from scroll_tactile.matching.matcher import TouchMatcher
from scroll_tactile.memory.state import Memory
from scroll_tactile.prediction.model import Model
from scroll_tactile.prediction.moment_table import Fusion, Moment, Trajectories
from scroll_tactile.readouts.calibration import Calibration
from scroll_tactile.readouts.dependence import Dependence
from scroll_tactile.readouts.readout import Readout, ReadoutName
from scroll_tactile.readouts.task import readout_to_arrays
from scroll_tactile.signals.windows import Scale, measuring
from scroll_tactile.statistics.moments import MOST_ROWS
from scroll_tactile.validation.expected import KEY_BYTES, Unexpected, array, counts, expect, whole
from scroll_tactile.validation.stored_readouts import ArrayReader, stored_readout

__all__ = ["NAME", "banks_to_arrays", "model_from", "model_to_arrays", "with_banks"]

Arrays = Mapping[str, npt.NDArray[Any]]
FloatArray = npt.NDArray[np.float64]

NAME = "model"
MADE_BY = f"{__version__}, 5"  # the release, in which judging may differ, and the version of these arrays
MOST_BANKS = 64
OF_MOMENT = (
    "steps",
    "stage",
    "model_weight",
    "match_weight",
    "lone_match_weight",
    "outlier_rate",
    "model_outlier_rate",
    "distance_limit",
    "mean_excess_loss",
    "loss_spread",
)
# Arrays that are mapped: they may be large. Places are never mapped: they are checked once, and another process could
# change a mapped file after that.
MAPPED = "others-means", "others-solved"
OF_CALIBRATION = ("weights", "scale_novelty", "median_distances", "novelties", "novelties_if_new")


def model_to_arrays(model: Model) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any], list[str]] | None:
    """Arrays and attributes of a model, and the arrays to be mapped; None if nothing was fitted."""
    fusion = model.fusion
    if fusion is None:
        return None
    places = {name: place for place, name in enumerate(model.names)}
    rows = [*fusion.moments, *fusion.paced]
    calibrations = [*model.calibrations, *(row.calibration for row in rows)]
    arrays: dict[str, npt.NDArray[Any]] = {
        "moments": np.array([[getattr(row, name) for name in OF_MOMENT] for row in rows], dtype=np.float64),
        "novelty-counts": np.array([len(each.novelties) for each in calibrations], dtype=np.int64),
        "dependence": np.array([model.dependence.log_probability, model.dependence.novelty]),
        "chances": fusion.trajectories.chances,
        "novelty": fusion.trajectories.novelty,
        "targets": fusion.trajectories.targets.astype(np.int64),
    }
    arrays |= {name: np.concatenate([getattr(each, name) for each in calibrations]) for name in OF_CALIBRATION}
    for scale, readout in model.readouts.items():
        arrays[f"names-{scale}"] = np.array([places[name] for name in readout.names], dtype=np.int64)
        arrays |= {f"{name}-{scale}": part for name, part in readout_to_arrays(readout).items()}
    if model.matcher is not None and model.conformal is not None:
        arrays |= _kept_to_arrays(model.matcher, model.conformal, places)
    attributes = {
        "made_by": MADE_BY,
        "readout": model.kind,
        "names": model.names,
        "scales": [int(scale) for scale in model.readouts],
        "calibrations": len(model.calibrations),
        "moments": len(fusion.moments),
        "least": model.least,
        "longest": model.longest,
        "fitted_to": model.fitted_to,
    }
    return (
        {name: np.ascontiguousarray(part) for name, part in arrays.items()},
        attributes,
        [f"{name}-{scale}" for name in MAPPED for scale in model.readouts],
    )


def banks_to_arrays(embedding: Embedding) -> dict[str, npt.NDArray[Any]]:
    """The banks that an embedding of kernels has used; empty for other embeddings."""
    if not isinstance(embedding, Kernels):
        return {}
    found = embedding.banks()
    arrays = {"banks": np.array(list(found), dtype=np.int64).reshape(-1, 2)}
    for i, each in enumerate(found.values()):
        arrays |= {f"bank-{name}-{i}": getattr(each, name) for name in ("channels", "rows", "thresholds")}
    return arrays


def with_banks(embedding: Embedding, arrays: Arrays) -> Embedding:
    """An embedding with stored banks in place of making them, for predictions alone; raises Unexpected for invalid
    ones.

    Observations are never embedded with it: a forged bank can mislead predictions, but cannot change a memory.
    """
    if not isinstance(embedding, Kernels) or "banks" not in arrays:
        return embedding
    kinds = counts("banks", array(arrays, "banks", ("int64",), (None, 2)), 1, 2**12).tolist()
    expect(len(kinds) <= MOST_BANKS, "banks", f"{MOST_BANKS} or fewer", len(kinds))
    banks = {}
    for i, (channels, dilation) in enumerate(kinds):
        size = bank_size(channels, dilation)
        rounds = -(-size // ROUND) * ROUND
        summed = array(arrays, f"bank-channels-{i}", ("float32",), (rounds, channels))
        expect(bool(((summed == 0) | (summed == 1)).all()), f"bank-channels-{i}", "0 and 1", "others")
        expect(bool((summed.sum(axis=1) <= MOST_CHANNELS).all()), f"bank-channels-{i}", "fewer channels", "others")
        rows = counts(f"bank-rows-{i}", array(arrays, f"bank-rows-{i}", ("int64",), (size,)), 0, rounds - 1)
        thresholds = array(arrays, f"bank-thresholds-{i}", ("float32",), (THRESHOLDS, size))
        expect(bool(np.isfinite(thresholds).all()), f"bank-thresholds-{i}", "finite numbers", "others")
        banks[channels, dilation] = Bank(dilation, summed, rows.astype(np.intp, copy=False), thresholds)
    return embedding.with_banks(banks)


def _kept_to_arrays(
    matcher: TouchMatcher, conformal: Conformal, places: Mapping[str, int]
) -> dict[str, npt.NDArray[Any]]:
    deviation, rows = matcher.deviation, {touch: row for row, touch in enumerate(matcher.kept.touches)}
    return {
        "kept-keys": np.array([list(key) for _, key in matcher.kept.touches], dtype=np.uint8),
        "kept-materials": np.array([places[material] for material, _ in matcher.kept.touches], dtype=np.int64),
        "kept-order": np.array([rows[touch] for touch in conformal.touches], dtype=np.int64),
        "kept-longest": np.array([matcher.kept.longest], dtype=np.int64),
        "deviation": np.array([deviation.coherence, deviation.energy, deviation.most]),
        "spread": deviation.likelihood.spread,
        "read": deviation.likelihood.weights,
        **{f"matcher-{name}": part for name, part in matcher.kept.to_arrays().items()},
        **{f"conformal-{name}": part for name, part in conformal.to_arrays().items()},
    }


def model_from(kept: Checkpoint, memory: Memory, kind: ReadoutName) -> Model:
    """The model that was kept of a memory as it is or was at a checkpoint. Raises Unexpected for any other."""
    about, arrays = kept.attributes, kept.arrays
    for field, expected in (("made_by", MADE_BY), ("readout", kind)):
        expect(about.get(field) == expected, field, expected, about.get(field))
    names: Any = about.get("names")
    # Rows after the checkpoint may have added materials or removed some: then the model is renewed.
    now = list(memory.statistics.materials)
    same = kept.last_sequence == memory.sequence
    expect(isinstance(names, list) and bool(names), "names", "materials", names)
    expect(all(isinstance(name, str) for name in names) and names == sorted(set(names)), "names", "in order", names)
    expect(names == now if same else bool(set(names) & set(now)), "names", f"{now}", names)
    reader = _ModelReader(arrays, about, memory, names, same)
    readouts = reader.readouts()
    stages = [memory.plan.judging(length) for length in memory.plan.milestones()]
    views = [view for view in memory.plan.views if view in readouts]
    reached = whole("calibrations", about.get("calibrations"), 1, len(stages))
    expect(all(scale in readouts for stage in stages[:reached] for scale in stage), "scales", "of stages", [*readouts])
    matcher, conformal = reader.kept() if "kept-keys" in arrays else (None, None)
    expect(matcher is None or bool(views), "kept-keys", "none without views", "some")
    calibrations, fusion = reader.table(stages[:reached], views, matcher)
    dependence = reader.floats("dependence", (2,), 0.0, 1.0).tolist()
    return Model(
        kind=kind,
        plan=memory.plan,
        names=names,
        stages=stages,
        views=views,
        readouts=readouts,
        calibrations=calibrations,
        held_out={},
        sample=[],
        fusion=fusion,
        dependence=Dependence(*dependence),
        conformal=conformal,
        least=whole("least", about.get("least"), 0, 2**53),
        longest=whole("longest", about.get("longest"), 1, 2**53),
        fitted_to=whole("fitted_to", about.get("fitted_to"), 1, MOST_ROWS),
    )


class _ModelReader(ArrayReader):
    """Reads the parts of a model from arrays; raises Unexpected for invalid ones.

    same: whether the memory has not changed since the model was stored.
    """

    def __init__(
        self, arrays: Arrays, about: Mapping[str, Any], memory: Memory, names: Sequence[str], same: bool
    ) -> None:
        super().__init__(arrays)
        self._about, self._memory, self._names, self._same = about, memory, names, same

    def readouts(self) -> dict[Scale, Readout]:
        """The readout of each scale at which touches have rows."""
        scales: Any = self._about.get("scales")
        able = {int(scale): scale for scale in self._memory.plan.scales}
        fits = isinstance(scales, list) and len(set(map(str, scales))) == len(scales)
        expect(fits and all(type(scale) is int and scale in able for scale in scales), "scales", f"{able}", scales)
        return {able[scale]: self._readout(able[scale]) for scale in sorted(scales)}

    def _readout(self, scale: Scale) -> Readout:
        count = self.length(f"names-{scale}", len(self._names))
        names = [self._names[place] for place in self.places(f"names-{scale}", count, len(self._names))]
        if self._same:
            there = self._memory.statistics.names(scale)
            expect(sorted(names) == there, f"names-{scale}", "the materials there", names)
        return stored_readout(self, scale, names, self._memory.statistics.dimension)

    def kept(self) -> tuple[TouchMatcher, Conformal]:
        """Matcher and conformal sets of the kept touches that the memory still has."""
        memory = self._memory.kept
        if memory is None:
            raise Unexpected("kept-keys: expected none; there are some")
        levels, channels = {(touch.material, touch.key): touch.levels for touch in memory.touches()}, 0
        count = self.length("kept-materials", memory.capacity)
        keys = array(self.arrays, "kept-keys", ("uint8",), (count, KEY_BYTES))
        materials = counts("kept-materials", self.arrays["kept-materials"], 0, len(self._names) - 1)
        touches = [(self._names[place], key.tobytes()) for place, key in zip(materials.tolist(), keys, strict=True)]
        expect(len(set(touches)) == count, "kept-keys", "different touches", count)
        there = [row for row, touch in enumerate(touches) if touch in levels]
        expect(len(there) == len(levels) if self._same else bool(there), "kept-keys", "those that are kept", len(there))
        expect(len(there) == count or not self._same, "kept-keys", "no others than are kept", count)
        kept = {row: KeptTouch(*touches[row], levels[touches[row]]) for row in there}
        channels, most = memory.sensor.channels, memory.most_columns
        longest = int(counts("kept-longest", array(self.arrays, "kept-longest", ("int64",), (1,)), 1, most)[0])
        lengths = {row: touch.levels.shape[1] for row, touch in kept.items()}
        expect(max(lengths.values()) <= longest, "kept-longest", "the longest", longest)
        parts = self._parts("matcher", KeptArrays.parts(count, channels, longest))
        columns = parts["columns"][there].tolist()
        expect(columns == list(lengths.values()), "matcher-columns", "their lengths", "others")
        spread, read = self.floats("spread", (LEVELS,), 1.0, LEVELS), self.floats("read", (LEVELS,), 0.0, 1.0)
        expect(read.sum() > 0, "read", "a level or more", "none")
        coherence, energy, most_energy = self.floats("deviation", (3,), 1e-9).tolist()
        expect(max(coherence, energy) < 1e300, "deviation", "finite numbers", [coherence, energy])
        deviation = NaturalDeviation(Likelihood.of(spread, read), coherence, energy, most_energy)
        own = {name: part[there] for name, part in parts.items()}
        matcher = TouchMatcher(KeptArrays.from_arrays(list(kept.values()), own, longest), deviation)
        order = self.places("kept-order", count, count).tolist()
        standing = [place for place, row in enumerate(order) if row in kept]
        parts = self._parts("conformal", Conformal.parts(count, channels, longest))
        for name in ("own", "other"):
            expect(bool((parts[name] >= 0).all()), f"conformal-{name}", "squared distances", "others")
        conformal = Conformal.from_arrays(
            [kept[order[place]] for place in standing], {name: part[standing] for name, part in parts.items()}, longest
        )
        return matcher, conformal

    def _parts(self, what: str, expected: Mapping[str, tuple[str, tuple[int, ...]]]) -> dict[str, npt.NDArray[Any]]:
        return {
            name: array(self.arrays, f"{what}-{name}", (dtype,), shape) for name, (dtype, shape) in expected.items()
        }

    def table(
        self, stages: Sequence[Sequence[Scale]], views: Sequence[Scale], matcher: TouchMatcher | None
    ) -> tuple[list[Calibration], Fusion]:
        """The calibration of each stage that touches reached, and the table of moments."""
        rows = array(self.arrays, "moments", ("float64",), (None, len(OF_MOMENT)))
        least = np.array([1, 0, 0, 1e-300, 1e-300, 0, 0, 0, -1e300, 1e-300])
        most = np.array([2**53, len(stages) - 1, 1e300, 1, 1, 1, 1, np.inf, 1e300, 1e300])
        expect(bool(((rows >= least) & (rows <= most)).all()), "moments", "rows of a table", "others")
        expect(bool((rows[:, :2] == np.rint(rows[:, :2])).all()), "moments", "whole columns and stages", "others")
        count = whole("moments", self._about.get("moments"), 1, len(rows) - 1)
        for part in (rows[:count, 0], rows[count:, 0]):
            expect(bool((np.diff(part) >= 0).all()), "moments", "columns in order", part)
        of_rows = [list(stages[int(stage)]) for stage in rows[:count, 1]]
        of_rows[-1] = [*stages[-1], *views]
        expect(rows[count - 1, 1] == len(stages) - 1, "moments", "the last stage, of a complete touch", rows[:, 1])
        of_rows += [of_rows[-1] if matcher is None else list(views)] * (len(rows) - count)
        found = list(self._calibrations([*stages, *of_rows]))
        moments = [
            Moment(int(steps), int(stage), calibration, *rest)
            for (steps, stage, *rest), calibration in zip(rows.tolist(), found[len(stages) :], strict=True)
        ]
        trajectories = self._trajectories(count - 1)
        fusion = Fusion(tuple(moments[:count]), tuple(moments[count:]), matcher, trajectories)
        return found[: len(stages)], fusion

    def _calibrations(self, scales: Sequence[Sequence[Scale]]) -> Iterator[Calibration]:
        """A calibration of each of some lists of scales."""
        sizes = [(len(own), len(measuring(own))) for own in scales]
        edges = np.cumsum([(0, 0), *sizes], axis=0).tolist()
        total, novel = edges[-1]
        lengths = array(self.arrays, "novelty-counts", ("int64",), (len(scales),))
        counts("novelty-counts", lengths, 0, MOST_ROWS)
        weights, medians = self.floats("weights", (total,), 0.0, 1e300), self.floats("median_distances", (total,), 0.0)
        shapes = self.floats("scale_novelty", (novel, 2))
        expect(bool((shapes[:, 1] > 0).all()), "scale_novelty", "spreads above 0", "others")
        novelties = [self.floats(name, (int(lengths.sum()),)) for name in ("novelties", "novelties_if_new")]
        ends = np.cumsum([0, *lengths.tolist()]).tolist()
        for i in range(len(scales)):
            own, measured = (slice(edges[i][j], edges[i + 1][j]) for j in (0, 1))
            known, if_new = (each[ends[i] : ends[i + 1]] for each in novelties)
            for each in (known, if_new):
                expect(bool((np.diff(each) >= 0).all()), "novelties", "ascending", "others")
            yield Calibration(weights[own], shapes[measured], medians[own], known, if_new)

    def _trajectories(self, moments: int) -> Trajectories:
        chances = array(self.arrays, "chances", ("float64",), (None, moments, None))
        touches, _, materials = chances.shape
        novelty = array(self.arrays, "novelty", ("float64",), (touches, moments))
        targets = counts("targets", array(self.arrays, "targets", ("int64",), (touches,)), 0, max(materials - 1, 0))
        return Trajectories(chances, novelty, targets.astype(np.intp, copy=False))

"""The weighing of a model as text in a checkpoint, so that the next opening only solves the readouts.

It is some thousand numbers, and says nothing of any single touch. A file may come from elsewhere: fields, lengths and
bounds are checked against the memory, so that no prediction fails because of it. Whether the numbers are the fitted ones
cannot be checked. What another release or readout wrote is not used, and the weighing is fitted anew.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scroll_tactile import __version__
from scroll_tactile.matching.likelihood import LEVELS, Likelihood
from scroll_tactile.matching.match import NaturalDeviation
from scroll_tactile.matching.matcher import TouchMatcher
from scroll_tactile.memory.state import Memory
from scroll_tactile.prediction.model import Model, Paces, Row, Weighing
from scroll_tactile.readouts.calibration import Calibration
from scroll_tactile.readouts.dependence import Dependence
from scroll_tactile.signals.windows import Scale, measuring
from scroll_tactile.validation.expected import expect

__all__ = ["read_weighing", "weighing_text"]

MADE_BY = f"{__version__}, 1"  # the release, in which judging may differ, and the version of these fields
Share = Annotated[float, Field(ge=0, le=1)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Above = Annotated[float, Field(gt=0)]
Weight = Annotated[float, Field(ge=0, allow_inf_nan=False)]
MeanAndSpread = tuple[Number, Above]


class _Stored(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, ser_json_inf_nan="constants")


class StoredRow(_Stored):
    """A `Row`, its calibration among its fields."""

    steps: Annotated[int, Field(ge=1)]
    scales: list[int]
    weights: list[Weight]
    scale_novelty: list[MeanAndSpread]
    median_distances: list[Annotated[float, Field(ge=0)]]
    novelties: list[Number]
    novelties_if_new: list[Number]
    readout_outliers: Share
    outliers: Share
    distance_limit: Annotated[float, Field(ge=0)]
    excess: MeanAndSpread

    @classmethod
    def of(cls, row: Row) -> StoredRow:
        """What is stored of a row."""
        arrays = {name: values.tolist() for name, values in vars(row.calibration).items()}
        own = {name: value for name, value in vars(row).items() if name not in ("calibration", "scales", "excess")}
        arrays["scale_novelty"] = [tuple(pair) for pair in arrays["scale_novelty"]]
        return cls(scales=list(map(int, row.scales)), excess=tuple(map(float, row.excess)), **own, **arrays)

    def row(self, scales: tuple[Scale, ...]) -> Row:
        """The row, if it is of these scales. Raises Unexpected."""
        expect(self.scales == list(map(int, scales)), "scales", list(map(int, scales)), self.scales)
        lengths = len(self.weights), len(self.median_distances), len(self.scale_novelty)
        expected = len(scales), len(scales), len(measuring(scales))
        expect(lengths == expected, "weights", expected, lengths)
        for name in ("novelties", "novelties_if_new"):
            expect(getattr(self, name) == sorted(getattr(self, name)), name, "ascending", "others")
        expect(len(self.novelties) == len(self.novelties_if_new), "novelties", "as many", "others")
        calibration = Calibration(
            np.array(self.weights),
            np.array(self.scale_novelty).reshape(-1, 2),
            np.array(self.median_distances),
            np.array(self.novelties),
            np.array(self.novelties_if_new),
        )
        rates = self.readout_outliers, self.outliers, self.distance_limit
        return Row(self.steps, scales, calibration, *rates, excess=self.excess)


class StoredDeviation(_Stored):
    """A `NaturalDeviation`."""

    spread: Annotated[list[Annotated[float, Field(ge=1, le=LEVELS)]], Field(min_length=LEVELS, max_length=LEVELS)]
    weights: Annotated[list[Above], Field(min_length=LEVELS, max_length=LEVELS)]
    coherence: Annotated[Number, Field(gt=0)]
    energy: Annotated[Number, Field(gt=0)]
    most: Above


class StoredPaces(_Stored):
    """A `Paces`."""

    own: list[MeanAndSpread]
    others: tuple[list[MeanAndSpread], list[MeanAndSpread]]


class StoredWeighing(_Stored):
    """A `Weighing`, and how the kept touches deviate, where any are kept."""

    made_by: str
    kind: str
    rows: Annotated[list[StoredRow], Field(min_length=1)]
    complete: StoredRow
    paced: StoredRow
    tau: Annotated[float, Field(gt=0, le=1)]
    dependence: tuple[Share, Share]
    least: Annotated[int, Field(ge=1)]
    touches: Annotated[int, Field(ge=1)]
    deviation: StoredDeviation | None
    paces: StoredPaces | None


def weighing_text(model: Model) -> str | None:
    """The weighing of a model as JSON; None where it has none."""
    weighing, matcher, paces = model.weighing, model.matcher, None
    if weighing is None:
        return None
    deviation = None
    if matcher is not None:
        own = matcher.deviation
        deviation = StoredDeviation(
            spread=own.likelihood.spread.tolist(),
            weights=own.likelihood.weights.tolist(),
            coherence=own.coherence,
            energy=own.energy,
            most=own.most,
        )
    if weighing.paces is not None:
        pairs = [
            [tuple(pair) for pair in part] for part in (weighing.paces.own.tolist(), *weighing.paces.others.tolist())
        ]
        paces = StoredPaces(own=pairs[0], others=(pairs[1], pairs[2]))
    return StoredWeighing(
        made_by=MADE_BY,
        kind=model.kind,
        rows=[StoredRow.of(row) for row in weighing.rows],
        complete=StoredRow.of(weighing.complete),
        paced=StoredRow.of(weighing.paced),
        tau=weighing.tau,
        dependence=(weighing.dependence.log_probability, weighing.dependence.novelty),
        least=weighing.least,
        touches=weighing.touches,
        deviation=deviation,
        paces=paces,
    ).model_dump_json()


def read_weighing(text: str, model: Model, memory: Memory) -> Model:
    """A model that was only solved, with the weighing of a text. Raises ValueError for any that does not fit it."""
    found = StoredWeighing.model_validate_json(text)
    for field, expected in (("made_by", MADE_BY), ("kind", model.kind)):
        expect(getattr(found, field) == expected, field, expected, getattr(found, field))
    reached = model.stages[: len(found.rows)]
    expect(all(scale in model.readouts for stage in reached for scale in stage), "rows", "reached stages", len(reached))
    expect(len(reached) == len(found.rows), "rows", len(model.stages), len(found.rows))
    complete = (*reached[-1], *model.views)
    paces, matcher = None, model.matcher
    if found.paces is not None:
        arrays = np.array(found.paces.own), np.array(found.paces.others)
        shape = len(measuring(model.views)) + 1, 2
        expect(bool(model.views) and [each.shape for each in arrays] == [shape, (2, *shape)], "paces", shape, "others")
        paces = Paces(*arrays)
    if matcher is not None:
        expect(found.deviation is not None, "deviation", "one", None)
        assert found.deviation is not None
        likelihood = Likelihood(np.array(found.deviation.spread), np.array(found.deviation.weights))
        own = NaturalDeviation(likelihood, found.deviation.coherence, found.deviation.energy, found.deviation.most)
        matcher = TouchMatcher(matcher.kept, own)
    weighing = Weighing(
        rows=tuple(row.row(tuple(stage)) for row, stage in zip(found.rows, reached, strict=True)),
        complete=found.complete.row(complete),
        paced=found.paced.row(tuple(model.views) or complete),
        tau=found.tau,
        dependence=Dependence(*found.dependence),
        least=found.least,
        touches=found.touches,
        sample=list(memory.sample),
        paces=paces,
    )
    return replace(model, weighing=weighing, matcher=matcher)

"""Estimates of a touch's quantities, such as its force, by heads over the sampled touches (see `regression`).

A touch is estimated by the heads of the length that it reached: before it is complete as it was at its last milestone,
by the sampled touches as they were then; complete by complete ones, views among them. So a residual that calibrates an
interval is of a touch like the one that is asked for. Heads are functions of the set of sampled touches and values.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import AnnotationError
from scroll_tactile.quantities import Quantity
from scroll_tactile.readouts.regression import RegressionHead, Spectrum, fit_head
from scroll_tactile.results import Estimate
from scroll_tactile.signals.windows import Scale, WindowPlan
from scroll_tactile.statistics.moments import one_thread
from scroll_tactile.statistics.sample import SampledTouch

__all__ = ["Estimator", "Heads"]

FloatArray = npt.NDArray[np.float64]
Sampled = tuple[str, bytes, SampledTouch]
LEAST_TOUCHES = 3  # of which one is held out, and two have a slope
LEAST_MATERIALS = 2


@dataclass(frozen=True)
class Heads:
    """The heads of one quantity at one length of touch: for known materials, and for new ones.

    materials: of the touches that they rest on, in the order of the heads' residuals. targets: their values, (n,).
    """

    known: RegressionHead
    new: RegressionHead
    materials: tuple[str, ...]
    targets: FloatArray


@dataclass
class Estimator:
    """Estimates the quantities of touches from sampled ones, in one state of a memory.

    sample: the touches that carry a value, in the sample's order. least: the steps from which on a touch is complete.
    Any number of threads may use it: one that comes second fits the same heads again.
    """

    plan: WindowPlan
    sample: list[Sampled]
    quantities: Mapping[str, Quantity]
    least: int
    _fitted: dict[int, tuple[list[Scale], dict[str, Heads | str]]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        plan: WindowPlan,
        sample: Iterable[Sampled],
        quantities: Mapping[str, Quantity],
        least: int,
        before: Estimator | None = None,
    ) -> Estimator:
        """The estimator of a sample. before: an earlier one, whose heads it takes where they last."""
        made = cls(plan, [each for each in sample if each[2].annotation.values], dict(quantities), least)
        return made if before is None or made._state != before._state else replace(made, _fitted=before._fitted)

    @property
    def _state(self) -> tuple[object, ...]:
        """What heads are a function of, beside the touches' content."""
        return [(name, key, touch.annotation) for name, key, touch in self.sample], self.quantities, self.last

    @cached_property
    def last(self) -> int:
        """The stage of complete touches."""
        return len(self.plan.stages(max(self.least, self.plan.milestones()[0]))) - 1

    def stage(self, steps: int) -> int:
        """By whose heads a touch of so many steps is estimated: the stage that it reached last, `last` if complete."""
        return self.last if steps >= self.least else max(0, min(len(self.plan.stages(steps)), self.last) - 1)

    def length(self, steps: int) -> int:
        """How many steps are read of a touch of so many: those to its last milestone, all of a complete one.

        Read further than the sampled touches were, a simulated slide's mean features were those of a settled contact,
        and an interval of 90 % covered 1 %.
        """
        return steps if self.stage(steps) == self.last else self.plan.milestones()[self.stage(steps)]

    def scales_for(self, steps: int) -> list[Scale]:
        """The scales that are read of a touch of so many steps, cut to its `length`: all that sampled ones have."""
        return self._at(self.stage(steps))[0]

    def wanted(self, names: Sequence[str] | None) -> list[str]:
        """The quantities that are asked for, all where it is None. Raises AnnotationError for one not declared."""
        if not self.quantities:
            raise AnnotationError(
                "no quantity was declared: declare one (learner.declare), and observe touches with it"
            )
        if undeclared := sorted(set(names or ()) - self.quantities.keys()):
            raise AnnotationError(f"expected quantities out of {sorted(self.quantities)}; came {undeclared[:5]}")
        return sorted(self.quantities) if names is None else list(dict.fromkeys(names))

    def estimate(
        self, wanted: Sequence[str], means: Mapping[Scale, FloatArray], steps: int, risk: float, *, known: bool
    ) -> dict[str, Estimate]:
        """The estimates of some quantities. known: whether the material is a learned one.

        means: mean features in grid units, (d,), of a touch of so many steps cut to its `length`, at `scales_for`.
        """
        scales, heads = self._at(self.stage(steps))
        features = [means[scale] for scale in scales if scale in means]  # of an empty memory none
        return {name: _estimate(heads[name], self.quantities[name], features, risk, known=known) for name in wanted}

    def heads(self, stage: int) -> dict[str, Heads | str]:
        """The heads of a stage, by quantity, or in words why there are none."""
        return self._at(stage)[1]

    def _at(self, stage: int) -> tuple[list[Scale], dict[str, Heads | str]]:
        """The scales and the heads of a stage, fitted when they are first asked for."""
        if stage not in self._fitted:
            with one_thread():
                self._fitted[stage] = self._fit(stage)
        return self._fitted[stage]

    def _fit(self, stage: int) -> tuple[list[Scale], dict[str, Heads | str]]:
        found = [(material, touch, self._rows(touch, stage)) for material, _, touch in self.sample]
        there = [(material, dict(touch.annotation.values), rows) for material, touch, rows in found if rows]
        had = [set(rows) for *_, rows in there] or [set(self.plan.judging(self.plan.milestones()[stage]))]
        scales = sorted(set.intersection(*had))
        fitted, spectra = dict[str, Heads | str](), dict[tuple[int, ...], list[Spectrum]]()
        for name, quantity in self.quantities.items():
            carrying = tuple(i for i, (_, values, _) in enumerate(there) if name in values)
            targets = np.array([quantity.value(there[i][1][name]) for i in carrying])
            materials = tuple(there[i][0] for i in carrying)
            if reason := _lacking(targets, materials):
                fitted[name] = reason
                continue
            if carrying not in spectra:  # quantities that the same touches carry share them
                spectra[carrying] = [Spectrum.of(np.stack([there[i][2][scale] for i in carrying])) for scale in scales]
            groups = np.unique(materials, return_inverse=True)[1]
            known, new = fit_head(spectra[carrying], targets), fit_head(spectra[carrying], targets, groups)
            fitted[name] = Heads(known, new, materials, targets)
        return scales, fitted

    def _rows(self, touch: SampledTouch, stage: int) -> dict[Scale, npt.NDArray[np.int32]]:
        """The rows of a sampled touch as it was at a stage, by scale; none where it was not there at that length."""
        own = int(touch.pairs[:, 0].max())  # the touch's last stage, at which its length is its own
        at = own if stage == self.last else stage
        if own < self.last or (own > self.last and self.plan.judged == "widest"):
            return {}
        scales = sorted([*self.plan.judging(self.plan.milestones()[at]), *(self.plan.views if at == own else ())])
        places = zip(touch.pairs.tolist(), touch.rows, strict=True)
        return {scales[place]: row for (number, place, _), row in places if number == at}


def _lacking(targets: FloatArray, materials: Sequence[str]) -> str:
    """What is missing for a head, in words; empty where nothing is."""
    if len(targets) < LEAST_TOUCHES:
        return f"{len(targets)} sampled touches as long as this carry a value; it takes {LEAST_TOUCHES} or more"
    if len(set(materials)) < LEAST_MATERIALS:
        return f"the sampled touches that carry a value are all of {materials[0]!r}; it takes two materials or more"
    if np.ptp(targets) == 0:
        return f"every sampled touch has the same value, {targets[0]:g}; it takes values that differ"
    return ""


def _estimate(
    heads: Heads | str, quantity: Quantity, features: Sequence[FloatArray], risk: float, *, known: bool
) -> Estimate:
    if not isinstance(heads, str) and len(features) < len(heads.known.weights):
        heads = "the sampled touches that carry a value are longer than this one; observe some as short, with a value"
    none = Estimate(value=None, low=None, high=None, unit=quantity.unit, risk=risk, known=known)
    if isinstance(heads, str):
        return replace(none, missing=heads)
    head = heads.known if known else heads.new
    said, half = head(features), head.half_width(risk)
    value, low, high = (min(max(one, quantity.low), quantity.high) for one in (said, said - half, said + half))
    missing = ""
    if math.isinf(half):
        missing = f"the interval is the range: one of risk {risk:g} takes {math.ceil(1 / risk - 1e-9) - 1} touches"
    touches, materials = len(heads.targets), len(set(heads.materials))
    return replace(none, value=value, low=low, high=high, touches=touches, materials=materials, missing=missing)

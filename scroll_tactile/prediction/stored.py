"""The weighing of a model as text in a checkpoint, so that the next opening only solves the readouts.

It is some thousand numbers, that have to fit the memory's scales and materials; whether they are the fitted ones cannot
be told. What is damaged, or was written by another release or readout, is not used: the weighing is fitted anew.
"""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass, replace
from functools import cache
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np

from scroll_tactile import __version__
from scroll_tactile.matching.likelihood import LEVELS, Likelihood
from scroll_tactile.matching.matcher import NaturalDeviation
from scroll_tactile.memory.state import Memory
from scroll_tactile.prediction.model import Model, Row, Weighing
from scroll_tactile.signals.windows import Scale, measuring

__all__ = ["read_weighing", "weighing_text"]

MADE_BY = f"{__version__}, 1"  # the release, in which judging may differ, and the version of these fields
# Of a weighing: made again from the memory where they are asked for.
NOT_STORED = "sample", "held_out", "neighbours", "trajectories"
LATER: dict[str, Any] = {"held_out": None, "neighbours": {}, "trajectories": None}
LARGEST, LEAST_SPREAD = 1e12, 1e-30  # of a number that was fitted, and of a spread: no answer is NaN by those within


def weighing_text(model: Model) -> str | None:
    """The weighing of a model as JSON; None where it has none."""
    if model.weighing is None:
        return None
    found = {"made_by": MADE_BY, "kind": model.kind, "weighing": _plain(model.weighing), "kept": None}
    if model.matcher is not None:
        own = model.matcher.deviation
        tables = [own.likelihood.spread.tolist(), own.likelihood.weights.tolist()]
        found["kept"] = [*tables, own.coherence, own.energy, own.most]
    return json.dumps(found)


def read_weighing(text: str, model: Model, memory: Memory) -> Model:
    """A model that was only solved, with the weighing of a text. Raises ValueError for any that does not fit it."""
    try:
        found = json.loads(text)
        if (found["made_by"], found["kind"]) != (MADE_BY, model.kind):
            raise ValueError(f"expected one of {MADE_BY} for {model.kind}; came {found['made_by']} for {found['kind']}")
        weighing: Weighing = _made(Weighing, found["weighing"] | {"sample": []} | LATER)
        weighing.sample, weighing.neighbours = list(memory.sample), {}
        reached = model.stages[: len(weighing.rows)]
        whole = [*reached[-1], *model.views]
        scales = [*reached, whole, model.views or whole]
        for i, (row, own) in enumerate(zip([*weighing.rows, weighing.complete, weighing.paced], scales, strict=True)):
            _require_fitting(row, own, model)
            _require(row.stage == min(i, len(reached) - 1), "the stage of each row")
        _require_sound(weighing, model)
        matcher = model.matcher
        if matcher is not None:
            spread, weights, *natural = found["kept"]
            tables = Likelihood(_numbers(spread, (LEVELS,)), _numbers(weights, (LEVELS,)))
            coherence, energy, most = _numbers(natural, (3,)).tolist()
            _require(min(*spread, *weights, *natural) > 0, "numbers above 0")
            matcher = replace(matcher, deviation=NaturalDeviation(tables, coherence, energy, most))
    except (KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"it is no weighing ({type(error).__name__}: {error})") from error
    return replace(model, weighing=weighing, matcher=matcher)


def _require_fitting(row: Row, scales: list[Scale], model: Model) -> None:
    calibration, count = row.calibration, len(scales)
    if list(row.scales) != scales or not set(scales) <= model.readouts.keys():
        raise ValueError(f"expected a row of the scales {scales}; came {row.scales}")
    weights = _numbers(calibration.weights, (count,))
    away = _numbers(calibration.median_distances, (count,))
    measures = len(measuring(scales))
    if len(calibration.thresholds.novelties):
        measures += sum(1 for scale in scales if scale.width)
    spreads = [*_numbers(calibration.scale_novelty, (measures, 2))[:, 1], _numbers(row.excess, (2,))[1]]
    held = calibration.thresholds
    for values in (held.targets, held.novelties, held.if_new):
        _numbers(values, (len(held.novelties),))
    _require(isinstance(held.names, list) and all(isinstance(name, str) for name in held.names), "names")
    _require(all(0 <= place < len(held.names) for place in held.targets), "places of names")
    _require(np.isfinite(weights).all() and min(0, *weights, *away, row.distance_limit) == 0, "numbers that are >= 0")
    _require(min(spreads) >= LEAST_SPREAD, "spreads")
    _require(0 <= row.readout_outliers <= 1 and 0 <= row.outliers <= 1, "shares")
    _require(1 <= row.steps <= LARGEST, "a length")


def _require_sound(weighing: Weighing, model: Model) -> None:
    dependence, paces = weighing.dependence, weighing.paces
    _require(0 < weighing.tau <= 1 and 0 <= min(vars(dependence).values()) <= max(vars(dependence).values()) <= 1, "τ")
    _require(1 <= weighing.least <= LARGEST and 1 <= weighing.touches <= LARGEST, "a length and a count")
    if paces is not None:
        measures = len(measuring(model.views)) + 1
        own, others = _numbers(paces.own, (measures, 2)), _numbers(paces.others, (2, measures, 2))
        _require(min(own[:, 1].min(), others[..., 1].min()) >= LEAST_SPREAD and 0 <= paces.power <= LARGEST, "paces")


def _require(holds: bool | np.bool, expected: str) -> None:
    if not holds:
        raise ValueError(f"expected {expected}; came others")


def _numbers(values: Any, shape: tuple[int, ...]) -> np.ndarray[Any, np.dtype[np.float64]]:
    found = np.array(values, dtype=np.float64)
    if found.shape != shape or np.isnan(found).any() or (np.abs(found[np.isfinite(found)]) > LARGEST).any():
        raise ValueError(f"expected {shape} numbers; came {found.shape}")
    return found


def _plain(value: Any) -> Any:
    """A weighing, or a part of one, in JSON's types."""
    if is_dataclass(value) and not isinstance(value, Scale):
        return {one.name: _plain(getattr(value, one.name)) for one in fields(value) if one.name not in NOT_STORED}
    if isinstance(value, tuple):
        return list(map(_plain, value))
    if isinstance(value, Scale):
        return int(value)
    return value.tolist() if isinstance(value, np.ndarray) else value


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _made(kind: Any, plain: Any) -> Any:
    """What `_plain` gave, of a type, again. Raises TypeError, KeyError or ValueError for anything else."""
    if get_origin(kind) is UnionType:  # one type or None
        return None if plain is None else _made(get_args(kind)[0], plain)
    if kind is Scale:
        return Scale.numbered(plain)
    if is_dataclass(kind):
        hints = _hints(kind)  # type: ignore[arg-type]
        return kind(**{one.name: _made(hints[one.name], plain[one.name]) for one in fields(kind)})  # type: ignore[operator]
    if get_origin(kind) is tuple:
        first, *more = get_args(kind)
        kinds = [first] * len(plain) if more == [...] else [first, *more]
        return tuple(_made(own, each) for own, each in zip(kinds, plain, strict=True))
    if get_origin(kind) is np.ndarray:
        return np.array(plain, dtype=get_args(get_args(kind)[1])[0])
    if kind in (int, float) and (isinstance(plain, bool) or not isinstance(plain, (int, float))):
        raise TypeError(f"expected a number; came {plain!r:.50}")
    return kind(plain) if kind in (int, float) else plain

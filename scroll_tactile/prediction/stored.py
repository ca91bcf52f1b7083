"""The weighing of a model as text in a checkpoint, so that the next opening only solves the readouts.

The checkpoint is checked as a whole, so a text is as it was written. What another release, readout or plan wrote is not
used: the weighing is fitted anew.
"""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass, replace
from functools import cache
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np

from scroll_tactile import __version__
from scroll_tactile.matching.matcher import NaturalDeviation
from scroll_tactile.prediction.model import Model, Weighing
from scroll_tactile.signals.windows import Scale

__all__ = ["read_weighing", "weighing_text"]

MADE_BY = f"{__version__}, 4"  # the release, in which judging may differ, and the version of these fields


def weighing_text(model: Model) -> str | None:
    """The weighing of a model as JSON; None where it has none."""
    if model.weighing is None:
        return None
    found = {"made_by": MADE_BY, "kind": model.kind, "weighing": _plain(model.weighing)}
    return json.dumps(found | ({} if model.matcher is None else {"deviation": _plain(model.matcher.deviation)}))


def read_weighing(text: str, model: Model) -> Model:
    """A model that was only solved, with the weighing of a text. Raises ValueError for one that is not of its like."""
    try:
        found = json.loads(text)
        if (found["made_by"], found["kind"]) != (MADE_BY, model.kind):
            raise ValueError(f"expected one of {MADE_BY} for {model.kind}; came {found['made_by']} for {found['kind']}")
        weighing: Weighing = _made(Weighing, found["weighing"])
        for row in (*weighing.rows, weighing.complete, weighing.paced):
            if not set(row.scales) <= model.readouts.keys():
                raise ValueError(f"expected rows of the scales {sorted(model.readouts)}; came {row.scales}")
        matcher = model.matcher
        if matcher is not None:
            matcher = replace(matcher, deviation=_made(NaturalDeviation, found["deviation"]))
    except (KeyError, TypeError, IndexError, RecursionError) as error:
        raise ValueError(f"it is no weighing ({type(error).__name__}: {error})") from error
    return replace(model, weighing=weighing, matcher=matcher)


def _plain(value: Any) -> Any:
    """A weighing, or a part of one, in JSON's types."""
    if isinstance(value, Scale):
        return int(value)
    if is_dataclass(value):
        return {one.name: _plain(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, tuple):
        return list(map(_plain, value))
    return value.tolist() if isinstance(value, np.ndarray) else value


_hints = cache(get_type_hints)


def _made(kind: Any, plain: Any) -> Any:
    """What `_plain` gave, of a type, again. Raises TypeError, KeyError or ValueError for anything else."""
    if get_origin(kind) is UnionType:  # one type or None
        return None if plain is None else _made(get_args(kind)[0], plain)
    if kind is Scale:
        return Scale.numbered(plain)
    if isinstance(kind, type) and is_dataclass(kind):
        hints = _hints(kind)
        return kind(**{one.name: _made(hints[one.name], plain[one.name]) for one in fields(kind)})
    if get_origin(kind) is tuple:
        first, *more = get_args(kind)
        kinds = [first] * len(plain) if more == [...] else [first, *more]
        return tuple(_made(own, each) for own, each in zip(kinds, plain, strict=True))
    if get_origin(kind) is np.ndarray:
        return np.array(plain, dtype=get_args(get_args(kind)[1])[0])
    return plain

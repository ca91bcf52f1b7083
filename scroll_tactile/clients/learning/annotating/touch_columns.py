"""Answers as columns of a LeRobot data set: their types, what its metadata say of them, and their statistics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.clients.learning.annotating.frame_answers import EVENT, FrameAnswers
from scroll_tactile.errors import FieldError, InputError
from scroll_tactile.quantities import Quantity

__all__ = ["EVENTS", "FORMS", "PREFIX", "TouchColumns", "is_written", "statistics_of", "together"]

PREFIX = "observation.touch."
EVENTS = "language_events"
FORMS = ("numbers", "language", "mcap")
_WRITER = "scroll-tactile"  # the value under "written by" in a feature's info; only these may be replaced
_ROLE, _STYLE = "tool", "interjection"  # of LeRobot's styles of events the one that no camera belongs to
_FIELDS = ("role", "content", "style", "camera", "tool_calls")
_SHARES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


class TouchColumns:
    """The columns that answers become, and the features that describe them.

    names: the materials, in the order of their numbers. quantities: that were declared. forms: some of `FORMS`, of
    which "mcap" makes no column. about: what is kept with each feature, such as the memory's digest.

    Raises InputError for other forms, and for a quantity that has the name of another column.
    """

    def __init__(
        self, names: Sequence[str], quantities: Mapping[str, Quantity], forms: Sequence[str], about: Mapping[str, Any]
    ) -> None:
        if not forms or set(forms) - {*FORMS}:
            raise InputError(f"expected forms among {', '.join(FORMS)}; came {', '.join(map(repr, forms))!s:.80}")
        numbers, made = "numbers" in forms, {"written by": _WRITER, **about}
        self.names, self.language = tuple(names), "language" in forms
        self.quantities: dict[str, Quantity] = {}
        self.features: dict[str, dict[str, Any]] = {}
        if numbers:
            known = {"1": "learned", "0": "never observed", "-1": "cannot be told, or nothing is touched"}
            self._add("material", "int64", {"materials": list(names), "-1": "no answer", **made})
            self._add("probability", "float32", made)
            self._add("known", "int64", {"values": known, **made})
            for one in quantities.values():
                self._measure(one, made)
        if self.language:
            self.features[EVENTS] = {"dtype": "language", "shape": [1], "names": None, "info": made}

    def _measure(self, one: Quantity, made: Mapping[str, Any]) -> None:
        name = PREFIX + one.name.replace("/", "_")  # which LeRobot takes for a folder's
        if name in self.features:
            raise InputError(f"the quantity {one.name!r} would be column {name!r}, as another is: leave numbers out")
        about = {"quantity": one.name, "unit": one.unit, "range": [one.low, one.high], **made}
        self.features[name] = {"dtype": "float32", "shape": [3], "names": ["value", "low", "high"], "info": about}
        self.quantities[name] = one

    def _add(self, name: str, kind: str, info: Mapping[str, Any]) -> None:
        self.features[PREFIX + name] = {"dtype": kind, "shape": [1], "names": [name], "info": dict(info)}

    @property
    def numbers(self) -> list[str]:
        """The columns of numbers."""
        return [name for name in self.features if name != EVENTS]

    def arrays(self, found: FrameAnswers, begin: int, end: int) -> dict[str, Any]:
        """The columns of numbers of frames [begin, end), as pyarrow's arrays."""
        import pyarrow as pa

        named: dict[str, Any] = {"material": found.material, "probability": found.probability, "known": found.known}
        whole: dict[str, Any] = {PREFIX + name: pa.array(array[begin:end]) for name, array in named.items()}
        for name, one in self.quantities.items():
            flat = pa.array(found.quantities[one.name][begin:end].reshape(-1))
            whole[name] = pa.FixedSizeListArray.from_arrays(flat, 3)
        return {name: whole[name] for name in self.numbers}

    def events(self, found: FrameAnswers, begin: int, end: int, others: Any = None) -> Any:
        """The column of events of frames [begin, end): lists of rows, null where there are none.

        others: the column as it was, whose rows stay, all but those of an earlier annotation.

        Raises FieldError where it is no column of events.
        """
        import pyarrow as pa

        kind = events_type() if others is None else _checked(others.type)
        rows: list[Any] = [None] * (end - begin) if others is None else others.to_pylist()
        for place, row in enumerate(rows):
            kept = None if row is None else [each for each in row if not _is_ours(each)]
            ours = [_row(text) for text in found.events.get(begin + place, ())]
            rows[place] = [*(kept or ()), *ours] if ours else kept if kept or not row else None
        return pa.array(rows, kind)


def events_type() -> Any:
    """The type of `language_events`: lists of role, content, style, camera and tool calls."""
    import pyarrow as pa

    texts = [pa.field(name, pa.string(), nullable=name != "role") for name in _FIELDS[:-1]]
    return pa.list_(pa.struct([*texts, pa.field(_FIELDS[-1], pa.list_(pa.string()))]))


def _row(text: str) -> dict[str, Any]:
    return {"role": _ROLE, "content": text, "style": _STYLE, "camera": None, "tool_calls": None}


def _is_ours(row: Any) -> bool:
    return bool(row and row["role"] == _ROLE and row["style"] == _STYLE and str(row["content"]).startswith(EVENT))


def _checked(kind: Any) -> Any:
    """The type of a column of events that is there. Raises FieldError for another."""
    inner = getattr(kind, "value_type", kind)
    names = tuple(inner.field(place).name for place in range(inner.num_fields))
    if names != _FIELDS:
        raise FieldError(
            f"column {EVENTS!r} has lists of {', '.join(names) or inner!s:.80}; expected {', '.join(_FIELDS)}: forms= "
            "without language leaves it alone"
        )
    return kind


def is_written(name: str, about: Any) -> bool:
    """Whether an annotation wrote a feature, by its name, which is one that it gives, and what meta/info.json says."""
    if name != EVENTS and not name.startswith(PREFIX):
        return False
    info = about.get("info") if isinstance(about, dict) else None
    return isinstance(info, dict) and info.get("written by") == _WRITER


def statistics_of(values: npt.NDArray[Any], wanted: Sequence[str]) -> dict[str, list[Any]]:
    """The statistics of a column (T, n) over an episode, by LeRobot's names, each a list of n; count is of frames."""
    exact = {"min": values.min(axis=0), "max": values.max(axis=0), "mean": values.mean(axis=0, dtype=np.float64)}
    exact |= {"std": values.std(axis=0, dtype=np.float64), "count": np.array([len(values)])}
    exact |= {name: np.quantile(values.astype(np.float64), share, axis=0) for name, share in _SHARES.items()}
    return {name: exact[name].tolist() for name in wanted if name in exact}


def together(parts: Sequence[Mapping[str, Sequence[Any]]]) -> dict[str, list[Any]]:
    """The statistics of a column over all episodes, from those of each.

    Quantiles are means of the episodes', weighted by their frames, as LeRobot's own are.
    """
    counts = np.array([part["count"] for part in parts], np.float64)
    stacked = {name: np.array([part[name] for part in parts]) for name in parts[0]}
    whole: dict[str, list[Any]] = {}
    for name, each in stacked.items():
        if name in ("min", "max"):
            whole[name] = getattr(each, name)(axis=0).tolist()
        elif name == "count":
            whole[name] = each.sum(axis=0).tolist()
        elif name == "std":
            mean = (stacked["mean"] * counts).sum(axis=0) / counts.sum()
            spread = (each**2 + (stacked["mean"] - mean) ** 2) * counts
            whole[name] = np.sqrt(spread.sum(axis=0) / counts.sum()).tolist()
        else:
            whole[name] = ((each * counts).sum(axis=0) / counts.sum()).tolist()
    return whole

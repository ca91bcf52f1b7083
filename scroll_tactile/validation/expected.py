"""What rows and checkpoints must be; whether their numbers fit each other is not asked.

What a disk damages fails its checksum in the store. Here stands what nobody's file may do: claim more than it holds,
lead sums beyond int64, carry names that no memory takes, or end in an error that names no place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from reprlib import repr as shortened
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from scroll_tactile_store import Checkpoint, Head, Record
from scroll_tactile_store.records import from_json

from scroll_tactile.errors import MismatchError
from scroll_tactile.memory.descriptions import checked
from scroll_tactile.memory.identity import Identity
from scroll_tactile.memory.state import ANNOTATED, MOST_CORRECTIONS, WEIGHINGS
from scroll_tactile.memory.touch_rows import (
    ADAPT,
    CODES,
    CORRECTION,
    DECLARE,
    DESCRIBE,
    KINDS,
    LABELS,
    MEMBER,
    MERGE,
    MOST_BYTES,
    OBSERVE,
    PACKED_SHAPE,
    PACKED_ZERO,
    RETRACT,
    RETRACTS,
    SENSE,
    SOURCE,
    VALUES,
    Arrays,
    declared_by,
    only_readings,
    unpack_readings,
)
from scroll_tactile.quantities import MOST_QUANTITIES, MOST_STEPS, Quantity
from scroll_tactile.settings import require_name, require_source
from scroll_tactile.signals.correction import Correction
from scroll_tactile.signals.stream import Stream, fewest_readings
from scroll_tactile.signals.windows import WindowPlan
from scroll_tactile.statistics.annotations import MOST_AXES, axis_arrays
from scroll_tactile.statistics.grid import BITS
from scroll_tactile.statistics.moments import MOST_ROWS
from scroll_tactile.statistics.statistics import SECOND

__all__ = ["Expected", "Unexpected", "array", "expect", "quantities_of", "whole"]

KEY_BYTES = 32  # of a stream's content hash, see `Stream.key`
ITEM = np.dtype(np.float32).itemsize
LONGEST_TOUCH = 2**28  # columns: 256 MiB of the smallest readings
MOST_STAGES = 2**10  # and scales that judge at one
LAST_ROW = 2**63 - 1
LARGEST_CODE = 2**BITS
FINITE = float(np.finfo(np.float64).max)
MODES = ("head", "adapters", "network")
NAMED = (OBSERVE, MEMBER, DECLARE, DESCRIBE)  # rows whose label is a name; that of others may be empty
Bound = float | Sequence[int] | npt.NDArray[np.float32]


class Unexpected(ValueError):
    """A value from a disk is not what is written there; the message names its field."""


def expect(holds: bool | np.bool, field: str, expected: str, came: object) -> None:
    """Raise Unexpected unless it holds."""
    if not holds:
        raise Unexpected(f"{field}: expected {expected}; came {shortened(came)}")


def whole(field: str, value: Any, least: int, most: int) -> int:
    """A whole number within bounds; Unexpected for anything else."""
    expect(type(value) is int and least <= value <= most, field, f"a whole number from {least} to {most}", value)
    return int(value)


def names(field: str, values: Any, among: Sequence[str] | None = None) -> list[str]:
    """Names of materials or labels: some of those given or, where none are, all different."""
    expect(isinstance(values, list), field, "names", values)
    found = [require_name(value) for value in values]
    known = len(set(found)) == len(found) if among is None else set(found) <= set(among)
    expect(known, field, "different names" if among is None else "materials that were observed", found)
    return found


def array(
    arrays: Mapping[str, Any],
    field: str,
    dtype: str,
    shape: tuple[int | None, ...],
    least: Bound = -FINITE,
    most: Bound = FINITE,
) -> npt.NDArray[Any]:
    """The array of that name; Unexpected where there is none, or it is of another dtype or shape, or out of bounds.

    shape: None for an axis of any length. least, most: finite; of all, or one for each place along the last axis.
    """
    found: Any = arrays.get(field)
    came = "none" if found is None else f"{found.dtype} {found.shape}"
    fits = found is not None and found.dtype.name == dtype and len(found.shape) == len(shape)
    fits = fits and all(own in (None, axis) for own, axis in zip(shape, found.shape, strict=True))
    expect(fits, field, f"{dtype} of shape {shape}".replace("None", "any"), came)
    _within(field, least, most, found)
    return cast("npt.NDArray[Any]", found)


def _within(field: str, least: Bound, most: Bound, values: npt.NDArray[Any]) -> None:
    if values.size:
        low, high = values.min(axis=0), values.max(axis=0)  # NaN, which is in no bounds, if any is
        if values.dtype.kind == "f":  # a bound of doubles is no single float
            low, high = np.float64(low), np.float64(high)
        inside = bool(np.all(low >= least) and np.all(high <= most))
        expect(inside, field, f"values from {least} to {most}", (low.min(), high.max()))


def quantities_of(attributes: Mapping[str, Any]) -> dict[str, Quantity]:
    """The quantities that a checkpoint's attributes declare. Raises InputError for what is none."""
    return {name: Quantity(name=name, **fields) for name, fields in attributes.get("quantities", {}).items()}


class Expected:
    """What the rows and checkpoints of one memory must be, read with a plan of windows.

    Each method raises Unexpected, InputError or what reading values of wrong types raises; `head` and `record` raise
    MismatchError for kinds and arrays that this version does not know.
    """

    def __init__(self, identity: Identity, plan: WindowPlan) -> None:
        self._sensor, self._dimension, self._plan = identity.sensor, identity.embedding.dimension, plan
        self._keeps = bool(identity.kept_touches)
        self._expected = lru_cache(256)(self._rows_of)

    def head(self, head: Head, most_rows: Callable[[], int]) -> None:
        """Check a row without its arrays; most_rows: gives how many the journal can hold."""
        told: Mapping[str, Any] = head.attributes
        if head.kind not in KINDS:
            raise MismatchError(f"is of kind {head.kind!r}, which this version does not know")
        if head.label or head.kind in NAMED:
            require_name(head.label)
        if head.kind in (OBSERVE, MEMBER):
            expect(len(head.key) == KEY_BYTES, "key", f"{KEY_BYTES} bytes", head.key)
            if SOURCE in told:
                require_source(told[SOURCE])
            _check_annotation(told)
        if head.kind in (OBSERVE, SENSE):
            columns = whole("columns", told.get("columns"), 1, LONGEST_TOUCH)
            if "nbytes" in told:
                self._check_size(columns, told["nbytes"])
        elif head.kind == RETRACT:
            _check_spans(told["sequences"], head.sequence, most_rows())
        elif head.kind == ADAPT and RETRACTS in told:
            whole(RETRACTS, told[RETRACTS], 1, head.sequence - 1)
        elif head.kind == ADAPT:
            Correction.from_text(told.get(CORRECTION), self._sensor)
        elif head.kind == DECLARE:
            declared_by(head)
        elif head.kind == DESCRIBE and told.get("constituents") is not None:
            checked(head.label, told["constituents"])

    def _check_size(self, columns: int, nbytes: Any) -> None:
        each = ITEM * self._sensor.channels
        readings = whole("nbytes", nbytes, each * fewest_readings(self._sensor), MOST_BYTES) // each
        frame = self._plan.widths[0]
        # Of a camera's frames the first may be its resting image, which is no column.
        fitting = (readings * frame, (readings - 1) * frame) if self._sensor.camera else (readings,)
        expect(nbytes % each == 0 and columns in fitting, "columns", f"those of {nbytes} bytes of readings", columns)

    def record(self, record: Record) -> None:
        """Check the arrays of a row, whose head was checked."""
        if record.kind == MERGE:
            self._check_contents(record.arrays, record.attributes, None)
        if record.kind != OBSERVE:
            return
        arrays, size = record.arrays, cast("int | None", record.attributes.get("nbytes"))
        if unknown := [field for field in arrays if not field.startswith((CODES, "readings-"))]:
            raise MismatchError(f"has arrays {unknown[:5]}, which this version does not know")
        packed = only_readings(arrays)
        expect((size is None) == (not packed), "nbytes", "the size of the row's readings", size)
        codes = {int(field.removeprefix(CODES)): field for field in arrays if field not in packed}
        expect(bool(codes or packed), "arrays", "codes or readings", sorted(arrays))
        if size is not None:
            key = Stream(self._sensor, self._readings(packed, size // (ITEM * self._sensor.channels))).key
            expect(key == record.key, "key", "the content hash of its readings", record.key)
        if codes:
            own = self._expected(cast(int, record.attributes["columns"]))
            expect(codes.keys() == own.keys(), "scales", f"{sorted(own)}", sorted(codes))
            for scale, rows in own.items():
                array(arrays, codes[scale], "int32", (rows, self._dimension), -LARGEST_CODE, LARGEST_CODE)

    def _readings(self, packed: Arrays, count: int) -> npt.NDArray[np.float32]:
        """So many readings of a row; what it claims is compared with what it has before anything is made of it."""
        shape = (count, *self._sensor.shape)
        if PACKED_SHAPE in packed:
            claimed = packed[PACKED_SHAPE].tolist()
            expect(claimed == list(shape), PACKED_SHAPE, f"{shape}", claimed)
            array(packed, PACKED_ZERO, "uint8", (-(-count * self._sensor.channels // 8),))
        with np.errstate(all="ignore"):
            readings = unpack_readings(packed)
        return array({"readings": readings}, "readings", "float32", shape, *self._sensor.limits)

    def _rows_of(self, columns: int) -> dict[int, int]:
        """How many rows a touch of so many columns has, by the number of the scale."""
        found: dict[int, int] = {}
        for stage in self._plan.scored_stages(columns):
            for scale, groups in stage.items():
                found[int(scale)] = found.get(int(scale), 0) + len(groups)
        return found

    def checkpoint(self, checkpoint: Checkpoint) -> None:
        """Check all that a memory takes from a checkpoint."""
        self._check_contents(checkpoint.arrays, checkpoint.attributes, checkpoint.last_sequence)

    def _check_contents(self, arrays: Mapping[str, Any], told: Mapping[str, Any], last: int | None) -> None:
        """Check the arrays and attributes of a checkpoint; last: its last row, None of what a merge brought."""
        most = last or LAST_ROW
        expected = {"dimension": self._dimension, "scales": list(map(int, self._plan.scales))}
        for field, own in expected.items():
            expect(told.get(field) == own, field, f"{own}", told.get(field))
        materials = names("materials", told.get("materials"))
        self._check_statistics(arrays, len(materials))
        self._check_sample(arrays, names("sample", told.get("sample"), materials))
        if self._keeps or "kept" in told:
            self._check_kept(arrays, names("kept", told.get("kept"), materials))
        if "exemplars" in told:
            self._check_exemplars(arrays, names("exemplars", told["exemplars"]["materials"], materials), most)
        self._check_targets(arrays, told, materials)
        for field in ("retracted", "excluded"):
            array(arrays, field, "int64", (None,), 1, most)
        for material, constituents in told.get("descriptions", {}).items():
            checked(require_name(material), constituents)
        corrections = told.get("corrections", [])
        expect(len(corrections) <= MOST_CORRECTIONS, "corrections", f"at most {MOST_CORRECTIONS}", corrections)
        for row, text in corrections:
            whole("corrections", row, 1, most)
            Correction.from_text(text, self._sensor)
        if WEIGHINGS in arrays:
            text = array(arrays, WEIGHINGS, "uint8", (None,)).tobytes()
            expect(all(isinstance(each, str) for each in from_json(text.decode()).values()), WEIGHINGS, "texts", text)
        if last is not None or "tuned" in told:  # a merge leaves the tuned model where it is
            whole("tuned_last_sequence", told.get("tuned_last_sequence"), 0, most)
        if "tuned" in told:
            self._check_tuned(arrays, told["tuned"])

    def _check_statistics(self, arrays: Arrays, count: int, shared: bool = False) -> None:
        """Check the statistics of so many materials or labels; shared: those of all have second moments for them."""
        array(arrays, "observations", "int64", (count,), 1, MOST_ROWS)
        array(arrays, "lengths", "int64", (None, 2), 1, (LONGEST_TOUCH, MOST_ROWS))
        for scale in self._plan.scales:
            rows = array(arrays, f"rows-{scale}", "int64", (count,), int(scale in self._plan.views), MOST_ROWS)
            total = whole(f"rows-{scale}", int(rows.sum()), 0, MOST_ROWS)
            codes = total * LARGEST_CODE
            array(arrays, f"sums-{scale}", "int64", (count, self._dimension), -codes, codes)
            if not total or (shared and not any(f"{name}-{scale}" in arrays for name in SECOND)):
                continue
            if (field := f"second-{scale}") in arrays:
                packed, squares = self._dimension * (self._dimension + 1) // 2, codes * LARGEST_CODE
                array(arrays, field, "int64", (packed,), -squares, squares)
            else:  # the rows that it is of
                values = array(arrays, f"values-{scale}", "int32", (None,), -LARGEST_CODE, LARGEST_CODE)
                array(arrays, f"places-{scale}", "int32", (self._dimension, total), 0, values.shape[0] - 1)

    def _check_sample(self, arrays: Arrays, materials: Sequence[str]) -> None:
        _check_keys(arrays, "sample-keys", len(materials))
        sizes = array(arrays, "sample-sizes", "int64", (len(materials),), 1, MOST_STAGES**2)
        count, last = int(sizes.sum()), MOST_STAGES - 1
        array(arrays, "sample-pairs", "int64", (count, 3), (0, 0, 1), (last, last, MOST_ROWS))
        features = self._dimension if count else None
        array(arrays, "sample-rows", "int32", (features, count), -LARGEST_CODE, LARGEST_CODE)

    def _check_kept(self, arrays: Arrays, materials: Sequence[str]) -> None:
        _check_keys(arrays, "kept-keys", len(materials))
        fewest = fewest_readings(self._sensor)
        columns = array(arrays, "kept-columns", "int64", (len(materials),), fewest, LONGEST_TOUCH)
        array(arrays, "kept-levels", "uint8", (int(columns.sum()) * self._sensor.channels,))

    def _check_exemplars(self, arrays: Arrays, materials: Sequence[str], last: int) -> None:
        count = len(materials)
        _check_keys(arrays, "exemplar-keys", count)
        if "exemplar-sources" in arrays:
            array(arrays, "exemplar-sources", "int64", (count,), 0, last)
        if "exemplar-readings" not in arrays:
            return
        fewest = fewest_readings(self._sensor)
        lengths = array(arrays, "exemplar-lengths", "int64", (count,), fewest, LONGEST_TOUCH)
        scales = array(arrays, "exemplar-scales", "int64", (count,)).tolist()
        widths = [int(scale) for scale in self._plan.scales if scale.width]
        expect(set(scales) <= set(widths), "exemplar-scales", f"some of {widths}", scales)
        features = self._dimension if count else None
        array(arrays, "exemplar-codes", "int32", (count, features), -LARGEST_CODE, LARGEST_CODE)
        shape = (int(lengths.sum()), *self._sensor.shape) if count else (0, None)
        array(arrays, "exemplar-readings", "float32", shape, *self._sensor.limits)

    def _check_targets(self, arrays: Arrays, told: Mapping[str, Any], materials: Sequence[str]) -> None:
        """Check the sums of values and labels, and the annotations of the samples' touches."""
        quantities, about = quantities_of(told), told.get("targets", {"sums": [], "axes": []})
        if "targets" in told:
            whole("targets.touches", about["touches"], 1, MOST_ROWS)
            whole("targets.total", int(about["total"], 16), 0, 2**256 - 1)
            most = MOST_ROWS, MOST_ROWS * MOST_STEPS, MOST_ROWS * MOST_STEPS**2
            array(arrays, "quantity-sums", "int64", (len(about["sums"]), 3), (1, 0, 0), most)
        for quantity, material in about["sums"]:
            known = quantity in quantities and material in materials
            expect(known, "targets.sums", "a declared quantity of a material", (quantity, material))
        axes: dict[str, list[str]] = {}
        for number, (axis, labels) in enumerate(about["axes"]):
            whole("targets.axes", number, 0, MOST_AXES - 1)
            axes[require_name(axis)] = names("targets.axes", labels)
            self._check_statistics(axis_arrays(arrays, number), len(labels), shared=True)
        for which in ANNOTATED:
            noted = told.get(which, [])
            if noted:
                expect(len(noted) == len(told[which.partition("-")[0]]), which, "one of each touch", noted)
            for attributes in noted:
                values, labels = _check_annotation(attributes)
                known = all(name in quantities and steps <= quantities[name].steps for name, steps in values.items())
                known = known and all(label in axes.get(axis, ()) for axis, label in labels.items())
                expect(known, which, "values of declared quantities, and labels that touches have", attributes)

    def _check_tuned(self, arrays: Arrays, about: Mapping[str, Any]) -> None:
        """Check a tuned model: whether a network takes its tensors is known when one is made."""
        count = len(names("tuned.names", about["names"]))
        kept, report = about["kept"], about["report"]
        sound = count > 0 and about["mode"] in MODES and isinstance(kept, bool) and isinstance(report, dict)
        expect(sound, "tuned", "names, mode, kept and report", about)
        heads = {field for field in arrays if field.startswith("tuned-head-")}
        able = {f"tuned-head-{scale}" for scale in self._plan.windows}
        expect(bool(heads) and heads <= able, "tuned", f"heads of {sorted(able)}", sorted(heads))
        for field in heads:
            array(arrays, field, "float64", (self._dimension, count))
        array(arrays, "tuned-bias", "float64", (count,))
        for field in (field for field in arrays if field.startswith("tuned-net-")):
            array(arrays, field, "float32", arrays[field].shape)


def _check_keys(arrays: Arrays, field: str, count: int) -> None:
    array(arrays, field, "uint8", (count, KEY_BYTES if count else None))


def _check_annotation(told: Mapping[str, Any]) -> tuple[Mapping[str, int], Mapping[str, str]]:
    """The values and labels of a touch; Unexpected and InputError for those that `observe` would not keep."""
    for what, most in ((VALUES, MOST_QUANTITIES), (LABELS, MOST_AXES)):
        if what in told:
            expect(0 < len(told[what]) <= most, what, f"1 to {most} by name", told[what])
            for name, value in told[what].items():
                require_name(name)
                whole(what, value, 0, MOST_STEPS) if what == VALUES else require_name(value)
    return told.get(VALUES, {}), told.get(LABELS, {})


def _check_spans(pairs: Any, sequence: int, most_rows: int) -> None:
    """Raise Unexpected for anything but spans of rows before this one, ascending and apart."""
    before = rows = 0
    for first, last in pairs:
        least = whole("sequences", first, before + 1, sequence - 1)
        before = whole("sequences", last, least, sequence - 1)
        rows += before - least + 1
    expect(0 < rows <= most_rows, "sequences", f"1 to {most_rows} rows, which the journal can hold", rows)

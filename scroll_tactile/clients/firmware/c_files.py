"""The exported judge as C: tables, the engine that reads them, an example with touches to check it by, and a Makefile.

All that is written is a function of the judge and of the touches: equal ones give the same bytes. Names come from
elsewhere, and are written as C strings of escaped bytes: nothing that a name holds becomes code.
"""

from __future__ import annotations

import os
import string
import struct
from collections.abc import Iterable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile import __version__
from scroll_tactile.clients.firmware.exported_judge import (
    ANGLES,
    CHANCES,
    ExportedJudge,
    ExportedScale,
    ExportedStage,
    LevelRows,
)
from scroll_tactile.embeddings.convolution import compiled_bank
from scroll_tactile.errors import InputError
from scroll_tactile.memory.state import Memory
from scroll_tactile.signals.levels import stream_of

__all__ = ["flash_bytes", "kept_levels", "tables_of", "touches_to_check", "write_firmware"]

Tables = dict[str, npt.NDArray[Any]]

ENGINE = ("kernels.h", "kernels.c", "wide.h", "judge.h", "judge.c")
TYPES = {"u1": "uint8_t", "u2": "uint16_t", "i2": "int16_t", "u4": "uint32_t", "i4": "int32_t"}
TYPES |= {"i8": "int64_t", "f4": "float"}
A_LINE = 16  # numbers
MOST_CHECKED = 64


def write_firmware(judge: ExportedJudge, folder: str | os.PathLike[str], touches: Sequence[LevelRows]) -> None:
    """Write a judge as C99 into a new or empty folder.

    touches: levels, int16 of shape (T, n), as `ExportedJudge.levels` gives them. `touches.bin` holds them with the
    judge's answers; the program of `main.c` reads it, and says how many answers differ.

    Raises InputError for a folder that holds something, or cannot be written.
    """
    target = Path(folder)
    written = {
        **{name: (files("scroll_tactile.native") / name).read_bytes() for name in ENGINE},
        "touch_memory.h": _header(judge).encode(),
        "touch_memory.c": _source(judge).encode(),
        "main.c": (files("scroll_tactile.clients.firmware") / "main.c").read_bytes(),
        "Makefile": (files("scroll_tactile.clients.firmware") / "Makefile").read_bytes(),
        "touches.bin": touches_to_check(judge, touches),
    }
    try:
        target.mkdir(parents=True, exist_ok=True)
        if any(target.iterdir()):
            raise InputError(f"expected a new or empty folder for the C files; {target} holds something")
        for name, content in written.items():
            (target / name).write_bytes(content)
    except OSError as error:
        raise InputError(f"the C files cannot be written to {target}: {error}") from error


def kept_levels(judge: ExportedJudge, memory: Memory) -> list[LevelRows]:
    """The levels of the touches that a memory keeps, at most so many, to check what was exported by."""
    kept = [] if memory.kept is None else memory.kept.touches()
    return [judge.levels(stream_of(touch.levels, judge.sensor)) for touch in kept[:: len(kept) // MOST_CHECKED + 1]]


def touches_to_check(judge: ExportedJudge, touches: Iterable[LevelRows]) -> bytes:
    """The touches with the answers that they must get: little-endian, one behind another.

    Of each: int32 readings; int16 levels (readings, n); int32 material, known, probability, readings judged; int64
    novelty; int64 scores (M).
    """
    packed = []
    for levels in touches:
        answer = judge.answer(levels)
        material = -1 if answer.material is None else judge.materials.index(answer.material)
        known = -1 if answer.known is None else int(answer.known)
        scores = answer.scores or (0,) * len(judge.materials)
        heads = material, known, round(65535 * answer.probability), answer.readings, answer.novelty
        packed += [struct.pack("<i", len(levels)), levels.astype("<i2").tobytes()]
        packed.append(struct.pack(f"<4iq{len(scores)}q", *heads, *scores))
    return b"".join(packed)


def tables_of(judge: ExportedJudge) -> Tables:
    """The tables that lie in a chip's flash, by their names in C."""
    channels, tables = judge.sensor.channels, Tables(angles=ANGLES, chances=CHANCES)
    for dilation, features in _dilations(judge).items():
        heavy, begins, summed, thresholds = compiled_bank(judge.embedding.bank_of(channels, dilation))
        kernels = min(features, len(heavy))
        tables |= {
            f"heavy_{dilation}": heavy[:kernels].ravel(),
            f"begins_{dilation}": begins[: kernels + 1],
            f"channels_{dilation}": summed[: begins[kernels]],
            f"thresholds_{dilation}": thresholds.ravel()[:features],
        }
    for one in judge.scales:
        width = one.scale.width
        shares = judge.embedding.dilations(channels, width)
        tables[f"shares_{width}"] = np.array([shares.get(each, 0) for each in _dilations(judge)], np.uint16)
        if (triangles := judge.embedding.triangles(channels, width)) is not None:
            feature, inputs = np.nonzero(triangles.weights.T)
            tables |= {
                f"terms_{width}": np.searchsorted(feature, range(len(triangles.phases) + 1)).astype(np.uint16),
                f"inputs_{width}": inputs.astype(np.uint16),
                f"factors_{width}": triangles.weights[inputs, feature].astype(np.int16),
                f"phases_{width}": triangles.phases.astype(np.uint32),
            }
        tables |= {
            f"weights_{width}": one.weights.ravel(),
            f"offsets_{width}": one.offsets,
            f"halves_{width}": one.halves,
            f"background_{width}": one.background.ravel(),
        }
    return tables


def flash_bytes(judge: ExportedJudge) -> int:
    """Bytes of a judge's tables on a chip; its code takes some ten kilobytes more."""
    return sum(table.nbytes for table in tables_of(judge).values())


def _dilations(judge: ExportedJudge) -> dict[int, int]:
    """Dilation → the features that any width has of it."""
    shares = [judge.embedding.dilations(judge.sensor.channels, one.scale.width) for one in judge.scales]
    return {each: max(share.get(each, 0) for share in shares) for each in sorted(set().union(*shares))}


def _header(judge: ExportedJudge) -> str:
    sensor = judge.sensor
    return f"""/* A touch memory of {len(judge.materials)} materials, exported by scroll-tactile {__version__}.
 *
 * {flash_bytes(judge)} bytes of tables in flash, {judge.ram_bytes} of RAM, 2 kB of stack.
 *
 * touch_memory_begin() where a touch begins; touch_memory_push() for each reading, TOUCH_MEMORY_RATE a second;
 * touch_memory_answer() whenever an answer is wanted. A reading has a level of each channel, as touch_memory_level()
 * makes it: the sensor's range is -2048 to 2048, rounded. -32768: the channel was not read.
 * Left out of what the learner has: kept touches, views of a whole touch, fine-tuning.
 */
#ifndef TOUCH_MEMORY_H
#define TOUCH_MEMORY_H

#include "judge.h"

#define TOUCH_MEMORY_SENSOR {_quoted(sensor.name)}
#define TOUCH_MEMORY_RATE {sensor.rate!r}
#define TOUCH_MEMORY_DIGEST "{judge.digest}" /* of the memory, as Python says it */

enum {{
    TOUCH_MEMORY_CHANNELS = {sensor.channels},
    TOUCH_MEMORY_READINGS = {judge.capacity},
    TOUCH_MEMORY_MATERIALS = {len(judge.materials)}
}};

#ifdef __cplusplus
extern "C" {{
#endif

/* Names by the number in an answer, in UTF-8; and the range of each channel, in the sensor's unit. */
extern const char *const touch_memory_names[TOUCH_MEMORY_MATERIALS];
extern const float touch_memory_low[TOUCH_MEMORY_CHANNELS], touch_memory_high[TOUCH_MEMORY_CHANNELS];

/* The level of a value in the sensor's unit, in float arithmetic; NaN and infinity count as not read. */
static inline int16_t touch_memory_level(int32_t channel, float value)
{{
    return tactile_level(touch_memory_low[channel], touch_memory_high[channel], value);
}}

void touch_memory_begin(void);

/* Returns 0 where the touch has TOUCH_MEMORY_READINGS already: the reading is not taken. */
int touch_memory_push(const int16_t reading[TOUCH_MEMORY_CHANNELS]);

/* answer->material is -1 where the touch is too short to say. */
void touch_memory_answer(tactile_answer *answer);

#ifdef __cplusplus
}}
#endif

#endif
"""


def _source(judge: ExportedJudge) -> str:
    tables, dilations = tables_of(judge), _dilations(judge)
    limits = zip(("low", "high"), judge.sensor.limits, strict=True)
    ranges = [(f"touch_memory_{name}", np.broadcast_to(limit, judge.sensor.channels)) for name, limit in limits]
    arrays = [
        _array("const char *const touch_memory_names", map(_quoted, judge.materials)),
        *(_table(name, table, "") for name, table in ranges),
        *(_table(name, table) for name, table in tables.items()),
        _array("static const tactile_bank banks", (_bank(tables, each) for each in dilations)),
        _array("static const tactile_scale scales", (_scale(tables, each) for each in judge.scales)),
        _array("static const tactile_stage stages", map(_stage, judge.stages)),
    ]
    most = max((len(tables.get(f"phases_{one.scale.width}", ())) for one in judge.scales), default=0)
    return f"""#include "touch_memory.h"

{"".join(arrays)}static const tactile_memory memory = {{
    TOUCH_MEMORY_CHANNELS, TOUCH_MEMORY_READINGS, TOUCH_MEMORY_MATERIALS,
    {len(judge.stages)}, {len(dilations)}, banks, scales, stages, angles, chances
}};

static int16_t levels[TOUCH_MEMORY_CHANNELS * TOUCH_MEMORY_READINGS];
static int32_t work[4 * TOUCH_MEMORY_READINGS], triangles[{max(most, 1)}], statistics[4 * TOUCH_MEMORY_CHANNELS];
static tactile_touch touch = {{&memory, levels, work, triangles, statistics, 0, 0,
                              {{0}}, {{0}}, {{{{0}}}}, {{0}}, {{{{0}}}}}};

void touch_memory_begin(void) {{ tactile_begin(&touch); }}

int touch_memory_push(const int16_t reading[TOUCH_MEMORY_CHANNELS]) {{ return tactile_push(&touch, reading); }}

void touch_memory_answer(tactile_answer *answer) {{ tactile_judge(&touch, answer); }}
"""


def _quoted(name: str) -> str:
    """A C string; what is no letter, digit, space or dash is three octal digits: any character may follow these."""
    plain = string.ascii_letters + string.digits + " -_"
    return '"' + "".join(chr(byte) if chr(byte) in plain else f"\\{byte:03o}" for byte in name.encode()) + '"'


def _table(name: str, table: npt.NDArray[Any], storage: str = "static ") -> str:
    numbers = [_number(value) for value in table.tolist()]
    lines = (", ".join(numbers[at : at + A_LINE]) for at in range(0, len(numbers), A_LINE))
    return _array(f"{storage}const {TYPES[f'{table.dtype.kind}{table.dtype.itemsize}']} {name}", lines)


def _array(declared: str, lines: Iterable[str]) -> str:
    return f"{declared}[] = {{\n" + "".join(f"    {line},\n" for line in lines) + "};\n\n"


def _number(value: float) -> str:
    """A number in C: one beyond 32 bits needs no suffix there, the least of them has none that is a literal."""
    if isinstance(value, float):
        return f"{value!r}f"
    return str(value) if value > -(2**31) else f"({value + 1} - 1)"


def _listed(*values: float | str | Sequence[int]) -> str:
    """Values in braces: numbers, names of tables, and lists of numbers."""
    parts = (v if isinstance(v, str) else _listed(*v) if isinstance(v, Sequence) else _number(v) for v in values)
    return "{" + ", ".join(parts) + "}"


def _bank(tables: Tables, dilation: int) -> str:
    named = (f"{name}_{dilation}" for name in ("heavy", "begins", "channels", "thresholds"))
    return _listed(len(tables[f"begins_{dilation}"]) - 1, dilation, *named)


def _scale(tables: Tables, one: ExportedScale) -> str:
    width, count = one.scale.width, len(tables.get(f"phases_{one.scale.width}", ()))
    terms = (f"{name}_{width}" if count else "0" for name in ("terms", "inputs", "factors", "phases"))
    weighed = f"weights_{width}", one.shift, f"offsets_{width}", f"halves_{width}", f"background_{width}"
    return _listed(width, f"shares_{width}", count, *terms, *weighed, one.background_shift)


def _stage(one: ExportedStage) -> str:
    parts = one.weights, one.distance_weights, one.distance_shifts, one.threshold
    return _listed(one.least, len(one.weights), int(one.detects), *parts)

"""What a hostile hand makes of bytes, of JSON, of arrays and of payloads: every choice is a random generator's."""

from __future__ import annotations

import copy
import functools
import json
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from forging import pack, unpack

NUMBERS = (0, 1, -1, 2, 3, 7, 255, 256, 4095, 4096, 65535, 65536, 2**30, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1)
NUMBERS += (2**63, 2**64 - 1, -(2**31), -(2**63), 10**30)
TEXTS = ("", "x", "a", "ü", "NaN", "\x1b]0;pwned\x07\x1b[2J", "two\nlines", "\u202etxt.exe", "\x9b31m", "9" * 5000)
TEXTS += ("../../etc/passwd", "kernels", "<U1000000000", "|O", "a" * 100_000, " a ", "\x7f", "-1")
VALUES = (*NUMBERS, *TEXTS, None, True, False, 0.5, -0.0, 1e308, 5e-324, float("nan"), float("inf"), [], {}, [[]])
VALUES += ([1], [None], {"x": 1}, [[1, 10**12]], [[1, 1], [1, 1]], [[5, 1]], [-1], {"a": {"b": [1, {"c": 2}]}})
SHAPES: tuple[tuple[int, ...], ...] = ((2**40,), (0,), (2**63, 2), (-1,), (1,) * 65, (2**32, 2**32), ())
DTYPES = ("|b1", "|i1", "|u1", "<i2", "<i4", "<i8", "<u2", "<u4", "<u8", "<f2", "<f4", "<f8", "<U3")
MORE_DTYPES = (*DTYPES, "|O", "<U1000000000", ">i4", "i", "<M8[s]", "|V8", "i4,i4", "\xff")
NAMES = ("", "x", "readings", "readings-rest", "readings-shape", "readings-zero", "readings-2e-8", "readings-2e9999")
NAMES += ("codes-15", "codes-015", "codes-0", "codes-x", "codes-1048576", "codes-99999", "codes--1")
NAMES += ("codes-" + "9" * 60, "zarr.json", "../x", "__x", "c", "READINGS", "exemplar-readings", "tuned-0", "a" * 100)


def mutated_bytes(rng: random.Random, data: bytes, others: Sequence[bytes]) -> tuple[str, bytes]:
    """Other bytes, and what was done; others: of files of the same name in other memories, of which parts may come."""
    out = bytearray(data)
    at = rng.randrange(len(out)) if out else 0
    span = slice(at, at + rng.choice((1, 4, 16, 512, 4096)))
    kind = rng.choice(("bit", "byte", "bytes", "number", "number", "insert", "delete", "cut", "zero", "copy", "other"))
    if kind == "bit" and out:
        out[at] ^= 1 << rng.randrange(8)
    elif kind == "byte" and out:
        out[at] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))
    elif kind == "bytes":
        out[span] = rng.randbytes(len(out[span]))
    elif kind == "number":
        size = rng.choice((2, 4, 8))
        at = rng.choice((at, at // size * size, rng.randrange(0, 40, 4)))
        out[at : at + size] = _whole(rng.choice(NUMBERS), size, rng.choice(("little", "big")))
    elif kind == "insert":
        out[at:at] = rng.randbytes(rng.choice((1, 8, 4096)))
    elif kind == "delete":
        del out[span]
    elif kind == "cut":
        del out[at:]
    elif kind == "zero":
        out[span] = bytes(len(out[span]))
    elif kind == "copy" and out:
        other = rng.randrange(len(out)) // 16 * 16
        part = out[other : other + span.stop - span.start]
        out[at : at + len(part)] = part
    elif kind == "other" and others:
        source = rng.choice(others)
        out = bytearray(source) if rng.random() < 0.3 else out[:at] + source[at : span.stop] + out[span.stop :]
    return f"{kind} at {at}", bytes(out)


def _whole(number: int, size: int, order: Any) -> bytes:
    return (number % 2 ** (8 * size)).to_bytes(size, order)


def mutated_json(rng: random.Random, value: Any) -> tuple[str, str]:
    """A JSON value in which one to three things are others, as text, and what was done."""
    value, told = copy.deepcopy(value), []
    if rng.random() < 0.02:
        depth = rng.choice((50, 900, 5000, 100_000))
        return f"{depth} deep", rng.choice(("[" * depth + "]" * depth, '{"a":' * depth + "1" + "}" * depth))
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        places = [((), value), *_places(value, ())]
        path, node = rng.choice(places)
        if not path:
            if rng.random() < 0.7:
                continue
            return "another value", _dumped(rng.choice(VALUES))
        parent = functools.reduce(lambda part, step: part[step], path[:-1], value)
        kind = rng.choice(("set", "set", "set", "drop", "add", "twice", "near"))
        told.append(f"{kind} {'.'.join(map(str, path))}")
        if kind == "set":
            parent[path[-1]] = copy.deepcopy(rng.choice(VALUES))
        elif kind == "drop":
            del parent[path[-1]]
        elif kind == "near" and isinstance(node, int | float):
            parent[path[-1]] = rng.choice((node + 1, node - 1, -node, node * 2, float(node), str(node)))
        elif isinstance(parent, list):
            parent.insert(rng.randrange(len(parent) + 1), copy.deepcopy(rng.choice((node, *VALUES))))
        else:
            parent[rng.choice(TEXTS)] = copy.deepcopy(rng.choice((node, *VALUES)))
    text = _dumped(value)
    if rng.random() < 0.03:
        place, more = rng.randrange(len(text) + 1), rng.choice(("", ",", "\\ud800", "}", "1e999", "\x00"))
        return f"{told}, text broken", text[:place] + more + text[place:]
    return ", ".join(told), text


def _dumped(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))


def _places(value: Any, path: tuple[Any, ...]) -> list[tuple[tuple[Any, ...], Any]]:
    """Every place in a JSON value, with what is there."""
    steps = value.items() if isinstance(value, dict) else enumerate(value[:40]) if isinstance(value, list) else ()
    return [place for step, part in steps for place in [((*path, step), part), *_places(part, (*path, step))]]


def mutated_arrays(rng: random.Random, arrays: Mapping[str, np.ndarray]) -> tuple[str, dict[str, np.ndarray]]:
    """Arrays of which one or two are others, and what was done."""
    out, told = dict(arrays), []
    for _ in range(rng.choice((1, 1, 2))):
        if not out:
            break
        name = rng.choice(sorted(out))
        kind = rng.choice(("values", "values", "values", "dtype", "shape", "shape", "gone", "named", "more", "swapped"))
        told.append(f"{kind} {name}")
        if kind == "values":
            out[name] = _other_values(rng, out[name])
        elif kind == "dtype":
            with np.errstate(all="ignore"):
                out[name] = out[name].astype(rng.choice(DTYPES))
        elif kind == "shape":
            out[name] = np.ascontiguousarray(_other_shape(rng, out[name]))
        elif kind == "gone":
            del out[name]
        elif kind == "named":
            out[rng.choice(NAMES)] = out.pop(name)
        elif kind == "more":
            out[rng.choice(NAMES)] = out[name].copy()
        else:
            other = rng.choice(sorted(out))
            out[name], out[other] = out[other], out[name]
    return ", ".join(told), out


def _other_values(rng: random.Random, array: np.ndarray) -> np.ndarray:
    out = array.copy()
    if not out.size or out.dtype.kind not in "iuf":
        return np.zeros_like(out)
    if out.dtype.kind == "f":
        value: Any = rng.choice((np.nan, np.inf, -np.inf, 1e30, -1e30, 0.0, -0.0, 1e-40, rng.random()))
    else:
        about = np.iinfo(out.dtype)
        usual = (about.max, about.min, 0, 1, -1, 2**20, 2**20 + 1, -(2**20) - 1, rng.randrange(256))
        value = rng.choice([number for number in usual if about.min <= number <= about.max])
    flat = out.reshape(-1)
    place: Any = rng.choice((slice(None), slice(0, 1), slice(-1, None), slice(None, None, 3)))
    flat[place] = value
    return out


def _other_shape(rng: random.Random, array: np.ndarray) -> np.ndarray:
    shapes: tuple[Callable[[], np.ndarray], ...] = (
        lambda: array[..., :0],
        lambda: array[:-1] if array.ndim else array,
        lambda: np.concatenate([array] * 3, axis=-1) if array.ndim else array[None, None],
        lambda: array.reshape(-1),
        lambda: array[..., None],
        lambda: array.T,
        lambda: np.zeros((*[1] * 40,), array.dtype),
    )
    return rng.choice(shapes)()


def mutated_payload(rng: random.Random, payload: bytes) -> tuple[str, bytes]:
    """A payload that says other things of its arrays, or whose frames do, and what was done."""
    arrays = unpack(payload)
    if rng.random() < 0.15 or not arrays:
        told, out = mutated_bytes(rng, payload, [])
        return f"payload: {told}", out
    at = rng.randrange(len(arrays))
    array = arrays[at]
    kind = rng.choice(("shape", "stored", "name", "dtype", *["frame"] * 4))
    if kind == "shape":
        array = replace(array, shape=rng.choice((*SHAPES, array.shape[::-1])))
    elif kind == "stored":
        array = replace(array, stored=rng.choice((*NUMBERS, len(array.buffer) + 1, len(array.buffer) - 1)))
    elif kind == "name":
        array = replace(array, name=rng.choice((*NAMES, "\xff", "a\x00b"))[:255])
    elif kind == "dtype":
        array = replace(array, dtype=rng.choice(MORE_DTYPES))
    elif kind == "frame":
        told, buffer = mutated_bytes(rng, array.buffer, [])
        array = replace(array, buffer=buffer)
        kind = f"frame of {array.name}: {told}"
    arrays[at] = array
    return kind, pack(arrays)

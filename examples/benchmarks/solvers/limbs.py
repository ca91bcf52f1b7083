"""Integers of any width in arrays of small digits ("limbs"), whose products BLAS forms exactly in float64.

An array of integers is an array with one axis more, in front: limb t holds the digits of 2^(22·t). Digits are
balanced, from −2²¹ to 2²¹ − 1, so that a product of two is at most 2⁴² and 2048 of them sum exactly in float64's
53 bits, in any order and with any number of threads (the error-free splitting of Ozaki, Ogita, Oishi & Rump 2012,
Numerical Algorithms 59, with integers for its floating-point slices). Sums of products are kept in int64 and
carried over into the next limb before they can overflow.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = [
    "EMPTY",
    "LIMB",
    "LONGEST",
    "carry",
    "from_integers",
    "lowest_bits",
    "product",
    "shifted",
    "split",
    "split_if_whole",
    "to_float",
    "to_integers",
    "total",
]

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]
ObjectArray = npt.NDArray[Any]  # of Python's integers

LIMB = 22  # bits
HALF = 2 ** (LIMB - 1)
LONGEST = 2 ** (53 - 2 * (LIMB - 1))  # products that sum exactly in float64: 2048
ROOM = 2 ** (61 - 2 * (LIMB - 1))  # products that sum in int64, with two bits to spare for what follows: 2¹⁹
EMPTY = 2**20  # stands for the lowest bit of zero: higher than that of any number
_MANTISSA = 53
_QUICK = 900  # bits: within them powers of two and what they scale stay inside float64's range


def lowest_bits(values: FloatArray) -> IntArray:
    """The exponent of the lowest bit that is set in each double, EMPTY for zero; same shape."""
    mantissa, exponent = np.frexp(values)
    whole = np.ldexp(mantissa, _MANTISSA).astype(np.int64)
    lowest = np.frexp((whole & -whole).astype(np.float64))[1] - 1
    found: IntArray = np.where(whole == 0, EMPTY, exponent.astype(np.int64) - _MANTISSA + lowest)
    return found


def split(values: FloatArray, unit: npt.ArrayLike = 0) -> FloatArray:
    """The digits of values / 2^unit, which must be whole, as float64 of shape (limbs, *shape).

    unit: integers that broadcast to the values' shape. Exact for every finite double, denormal ones too.
    """
    found = split_if_whole(values, unit)
    if found is not None:
        return found
    mantissa, exponent = np.frexp(values)
    above = np.where(mantissa == 0, 0, exponent - np.asarray(unit, dtype=np.int64))  # bits of the whole number
    first = np.maximum(0, above - _MANTISSA) // LIMB  # the limb of its lowest bit, or one below
    rest = np.ldexp(mantissa, (above - LIMB * first).astype(np.int32))  # whole, below 2⁷⁵
    digits = np.zeros((int(first.max(initial=0)) + 4, *values.shape))
    flat, place, columns = digits.reshape(len(digits), -1), first.reshape(-1), np.arange(values.size)
    for limb in (3, 2, 1, 0):
        digit = np.rint(rest * 2.0 ** (-LIMB * limb))
        rest = rest - digit * 2.0 ** (LIMB * limb)
        flat[place + limb, columns] = digit.reshape(-1)
    return digits[: _used(digits)]


def split_if_whole(values: FloatArray, unit: npt.ArrayLike) -> FloatArray | None:
    """As `split`; None where values are not whole in these units, or so large that the quick way does not go."""
    units = np.asarray(unit, dtype=np.int64)
    if np.abs(units).max(initial=0) > _QUICK:
        return None
    with np.errstate(over="ignore"):
        rest = values * np.exp2(-units)
    largest = np.abs(rest).max(initial=0.0)
    if not largest < 2.0**_QUICK or (largest == 0 and values.any()):
        return None
    # |x| ≤ 2^(22 L − 1) has digits in L limbs: the highest is at most half of 2²² when the others are balanced.
    count = max(1, (int(np.frexp(largest)[1]) + LIMB) // LIMB)
    digits = np.empty((count, *values.shape))
    for limb in range(count - 1, -1, -1):  # from the top: what is left over is exact, as it has fewer bits
        np.multiply(rest, 2.0 ** (-LIMB * limb), out=digits[limb])
        np.rint(digits[limb], out=digits[limb])
        rest -= digits[limb] * 2.0 ** (LIMB * limb)
    return None if rest.any() else digits[: _used(digits)]


def _used(limbs: npt.NDArray[Any]) -> int:
    """How many limbs there are up to the highest that is not all zero, at least 1."""
    used = len(limbs)
    while used > 1 and not limbs[used - 1].any():
        used -= 1
    return used


def carry(limbs: IntArray) -> IntArray:
    """The same integers with digits from −2²¹ to 2²¹ − 1 in as many limbs as they need: one form for one value.

    limbs: sums of products, shape (limbs, …), each of magnitude below 2⁶² + 2²¹.
    """
    done: list[IntArray] = []
    rest = np.zeros_like(limbs[0])
    for limb in limbs:
        rest = rest + limb
        high = (rest + HALF) >> LIMB
        done.append(rest - (high << LIMB))
        rest = high
    while rest.any():
        high = (rest + HALF) >> LIMB
        done.append(rest - (high << LIMB))
        rest = high
    carried = np.stack(done)
    return carried[: _used(carried)]


def product(left: FloatArray, right: FloatArray) -> IntArray:
    """left @ right of integers in limbs, exact: int64 of shape (limbs, rows, columns), not yet carried.

    left: digits of shape (K, rows, inner); right: of shape (L, inner, columns); inner · min(K, L) ≤ 2¹⁹.
    """
    inner = left.shape[2]
    if inner * min(len(left), len(right)) > ROOM:
        raise OverflowError(f"a product over {inner} integers of {len(left)} and {len(right)} limbs passes int64")
    found = np.zeros((len(left) + len(right) - 1, left.shape[1], right.shape[2]), dtype=np.int64)
    filled = [(place, limb) for place, limb in enumerate(right) if limb.any()]
    for at, digits in enumerate(left):
        if digits.any():
            for place, limb in filled:
                for first in range(0, inner, LONGEST):
                    some = slice(first, first + LONGEST)
                    found[at + place] += (digits[:, some] @ limb[some]).astype(np.int64)
    return found


def shifted(limbs: IntArray, by: IntArray) -> IntArray:
    """Integers times 2^(22·by), by ≥ 0 of their shape."""
    moved = np.zeros((len(limbs) + int(by.max(initial=0)), *limbs.shape[1:]), dtype=np.int64)
    for step in np.unique(by):
        where = by == step
        moved[step : step + len(limbs), where] = limbs[:, where]
    return moved


def total(parts: Sequence[tuple[IntArray, int]]) -> tuple[IntArray, int]:
    """The sum of integers in limbs, each given with the place of its first limb; and the place of the sum's."""
    base = min(place for _, place in parts)
    length = max(place + len(limbs) for limbs, place in parts) - base
    found = np.zeros((length, *parts[0][0].shape[1:]), dtype=np.int64)
    for limbs, place in parts:
        found[place - base : place - base + len(limbs)] += limbs
    return carry(found), base


def to_float(limbs: IntArray, kind: type[np.floating] = np.float64) -> tuple[npt.NDArray[Any], IntArray]:
    """Integers in carried limbs as (x, e) with value x · 2^e, rounded once to float64 or another kind of float."""
    filled = limbs != 0
    top = len(limbs) - 1 - np.argmax(filled[::-1], axis=0)
    top[~filled.any(axis=0)] = 0

    def digit(down: int) -> IntArray:
        at = top - down
        found = np.take_along_axis(limbs, np.maximum(at, 0)[None], axis=0)[0]
        return np.where(at >= 0, found, 0)

    # Two limbs are below 2⁴⁴, so each half is exact; what follows the fourth is 2⁶⁶ times smaller than the first.
    high = ((digit(0) << LIMB) + digit(1)).astype(kind)
    low = ((digit(2) << LIMB) + digit(3)).astype(kind)
    return high * kind(2.0 ** (2 * LIMB)) + low, LIMB * (top - 3)


def to_integers(limbs: npt.NDArray[Any]) -> ObjectArray:
    """Integers in limbs as Python's, shape without the first axis."""
    found = np.zeros(limbs.shape[1:], dtype=object)
    for limb in limbs[::-1]:
        found = (found << LIMB) + limb.astype(np.int64).astype(object)
    return found


def from_integers(values: npt.ArrayLike) -> IntArray:
    """Integers, of int64 below 2⁶² or Python's of any size, in carried limbs: int64 of shape (limbs, *shape)."""
    rest = np.asarray(values)
    done: list[IntArray] = []
    while not done or rest.any():
        high = (rest + HALF) >> LIMB
        done.append((rest - (high << LIMB)).astype(np.int64))
        rest = high
    return np.stack(done)

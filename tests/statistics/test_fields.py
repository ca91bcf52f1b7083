"""Fields: a part comes back as it was, and what is not what its field says is named, with what was expected."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import numpy.typing as npt
import pytest

from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.fields import Ints, Must, Name, Unexpected, decode, encode, key_rows

NARROW, WHOLE = Scale("window", 5), Scale("whole")


@dataclass
class Inner:
    names: Annotated[list[Name], Must("", "n")]
    pairs: Annotated[Ints, Must("int64", "n 2", 0, (9, 99))]


@dataclass
class Outer:
    by_scale: Annotated[dict[Scale, npt.NDArray[np.float32]], Must("float32", "d ...")]
    inner: Inner
    several: list[Inner]
    perhaps: Inner | None = None
    rows: Annotated[Ints, Must("int64", "*", 1)] | None = None
    told: dict[str, int] = field(default_factory=dict)


def inner(*names):
    return Inner(list(names), np.arange(2 * len(names)).reshape(-1, 2))


def made(**changes):
    by_scale = {NARROW: np.ones((3, 2), np.float32), WHOLE: np.ones((3, 4, 5), np.float32)}
    return encode(Outer(by_scale, inner("a", "b"), [inner("c"), inner()], **changes))


@pytest.mark.parametrize("changes", [{}, {"perhaps": inner("d"), "rows": np.array([3]), "told": {"x": 1}}])
def test_a_part_comes_back_as_it_was(changes):
    arrays, told = made(**changes)
    again, told_again = encode(decode(Outer, arrays, told, {"d": 3}))
    assert told_again == told
    assert {name: (one.dtype, one.tolist()) for name, one in again.items()} == {
        name: (one.dtype, one.tolist()) for name, one in arrays.items()
    }


def test_an_array_is_named_by_the_fields_that_it_lies_in():
    arrays, told = made(perhaps=inner("d"))
    assert sorted(arrays) == [
        *("by_scale-1048576", "by_scale-5", "inner-pairs", "perhaps-pairs", "several-0-pairs", "several-1-pairs"),
    ]
    assert told == {"inner": {"names": ["a", "b"]}, "several": [{"names": ["c"]}, {"names": []}]} | {
        "perhaps": {"names": ["d"]}
    }


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        (
            "inner-pairs",
            lambda a: a.astype(np.int32),
            r"inner-pairs: expected int64 of shape \(2, 2\); came 'int32 \(2, 2\)'",
        ),
        ("inner-pairs", lambda a: a[:1], r"inner-pairs: expected int64 of shape \(2, 2\); came 'int64 \(1, 2\)'"),
        ("inner-pairs", lambda a: -a, "inner-pairs: expected values from 0 to"),
        ("inner-pairs", lambda a: a + 97, "inner-pairs: expected values from 0 to"),
        ("inner-pairs", lambda a: None, r"inner-pairs: expected int64 of shape \(2, 2\); came 'none'"),
        ("by_scale-5", lambda a: a[:2], r"by_scale-5: expected float32 of shape \(3, any\); came 'float32 \(2, 2\)'"),
        ("several-0-pairs", lambda a: a[:, :1], r"several-0-pairs: expected int64 of shape \(1, 2\)"),
    ],
)
def test_an_array_that_is_another_is_named_with_what_was_expected_and_what_came(name, change, said):
    arrays, told = made()
    arrays = {each: one if each != name else change(one) for each, one in arrays.items()}
    arrays = {each: one for each, one in arrays.items() if one is not None}
    with pytest.raises(Unexpected, match=said):
        decode(Outer, arrays, told, {"d": 3})


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"inner": None}, "inner: expected a mapping; came None"),
        ({"inner": {"names": "ab"}}, "inner-names.*valid list"),
        ({"inner": {"names": ["a", "b\n."]}}, "inner-names.1: .*printable"),
        ({"several": {}}, "several: expected a list"),
        ({"several": [3]}, "several-0: expected a mapping; came 3"),
        ({"told": {"x": "y"}}, "told.x: .*valid integer"),
    ],
)
def test_json_that_is_other_is_named(changes, said):
    arrays, told = made()
    with pytest.raises(Unexpected, match=said):
        decode(Outer, arrays, told | changes, {"d": 3})


def test_keys_are_rows_of_bytes():
    assert key_rows([b"ab", b"cd"]).tolist() == [[97, 98], [99, 100]]
    assert key_rows([]).shape == (0, 32)

"""The path from a message to its numbers."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scroll_tactile.errors import FieldError
from scroll_tactile.recordings.paths import FieldPath, matched


@dataclass
class Vector:
    x: float
    y: float
    z: float


@dataclass
class Patch:
    name: str
    taxels: list
    force: Vector
    values: np.ndarray


@dataclass
class Message:
    patches: list
    data: np.ndarray = field(default_factory=lambda: np.arange(6.0))
    fX: float = 1.5


MESSAGE = Message(
    [
        Patch(f"p{i}", [Vector(i, i + 0.25, i + 0.5), Vector(9, 8, 7)], Vector(-1, -2, i), np.arange(i + 2))
        for i in range(3)
    ]
)


@pytest.mark.parametrize(
    ("path", "numbers"),
    [
        ("data", [0, 1, 2, 3, 4, 5]),
        ("data[1:3]", [1, 2]),
        ("data[-1]", [5]),
        (" data [ * ] ", [0, 1, 2, 3, 4, 5]),
        ("fX", [1.5]),
        ("fx", [1.5]),
        ("{fX,data[0]}", [1.5, 0]),
        ("patches[1].taxels[*].{x,z}", [1, 1.5, 9, 7]),
        ("patches[*].force.z", [0, 1, 2]),
        ("patches[0].{force,taxels[0]}.{x,y}", [-1, -2, 0, 0.25]),
        ("patches[*].values", [0, 1, 0, 1, 2, 0, 1, 2, 3]),
        ("patches[1:].values[0:2]", [0, 1, 0, 1]),
    ],
)
def test_numbers_come_in_the_order_of_the_message(path, numbers):
    np.testing.assert_array_equal(FieldPath(path).reading(MESSAGE), numbers)


def test_dictionaries_and_lists_as_of_json():
    message = {"skin": {"values": [[1, 2], [3, 4]], "name": "a", "odd": [[1], [2, 3]]}}
    np.testing.assert_array_equal(FieldPath("skin.values").reading(message), [1, 2, 3, 4])
    np.testing.assert_array_equal(FieldPath("skin.values[1]").reading(message), [3, 4])
    with pytest.raises(FieldError, match="ragged"):
        FieldPath("skin.odd").reading(message)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("patches[0].name", "leads to text, 'p0'"),
        ("patches", r"leads to a message, .*inside it are name, taxels, force, values: write patches\[\*\]\.values"),
        ("patches[0].taxels", r"write patches\[0\].taxels\[\*\].z or patches\[0\].taxels\[\*\].\{x,y,z\}"),
        ("patches[0].taxel", r"no 'taxel'; nearest is 'taxels' \(of name, taxels, force, values\)"),
        ("patches.taxels", r"an array of 3 stands before 'taxels': write \[0\] or \[\*\]"),
        ("patches[3].force", r"\[3\] is wanted of an array of 3"),
        ("fX[0]", r"\[0\] is wanted of a float"),
        ("fX.y", "'y' is wanted of a float, which has no fields"),
        ("", "expected a field's name at character 1"),
        ("data.", "expected a field's name at character 6"),
        (".data", "expected a field's name at character 1"),
        ("data[", "expected"),
        ("data[a]", r"expected an index: \[0\], \[\*\] or \[0:19\]"),
        ("data[1.5]", "expected an index"),
        ("{fX", "expected a dot or an index"),
        ("{fX,}", "expected a field's name at character 5"),
        ("data data", "expected a dot or an index at character 6"),
        ("data;", "expected a dot or an index at character 5"),
        ("{" * 5000, "at most 32"),
    ],
)
def test_what_is_wrong_with_a_path_is_said_where_it_is(path, message):
    with pytest.raises(FieldError, match=message):
        FieldPath(path).reading(MESSAGE)


@given(st.text("adfXptches.[]{},*:012 -", max_size=30))
def test_any_text_is_a_path_or_a_field_error(text):
    try:
        reading = FieldPath(text).reading(MESSAGE)
    except FieldError:
        return
    assert reading.ndim == 1


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("obs/skin", ("obs/skin", "")),
        (" skin ", ("obs/skin", "")),
        ("skin [0:3] ", ("obs/skin", "[0:3]")),
        ("skin[[1]", ("obs/skin", "[[1]")),
        ("a[0][1]", ("a[0]", "[1]")),
        ("a[0]", ("a[0]", "")),
    ],
)
def test_a_field_of_arrays_is_found_with_the_index_behind_it(text, found):
    assert matched(text, ["obs/skin", "a[0]"], "x.h5") == found


@pytest.mark.parametrize("text", ["a" + " " * 5000 + "x", "[" * 20000 + "]x", "skin]", "skin[", "[0]", "]"])
def test_a_field_of_arrays_that_is_not_there_is_refused_however_long(text):
    with pytest.raises(FieldError, match="has no field"):
        matched(text, ["obs/skin"], "x.h5")

"""Pictures are what was drawn; any name fits, and is shown as text; ticks lie in their range."""

import base64
import struct
import zlib
from html import unescape

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from scroll_tactile.clients.report.drawing import clipped_name, png, shown, steps, tinted
from scroll_tactile.errors import printable


def test_a_png_is_what_was_drawn():
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    assert _decoded(png(pixels)) == (4, 3, 3, pixels.tobytes())
    colours = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    assert _decoded(png(colours)) == (4, 2, 2, colours.tobytes())
    assert tinted(np.array([0.0, 1.0])).tolist() == [[0, 32, 76], [255, 233, 69]]


def _decoded(address):
    data = base64.b64decode(address.removeprefix("data:image/png;base64,"))
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    chunks, place = {}, 8
    while place < len(data):
        (size,), kind = struct.unpack(">I", data[place : place + 4]), data[place + 4 : place + 8]
        body = data[place + 8 : place + 8 + size]
        assert struct.unpack(">I", data[place + 8 + size : place + 12 + size])[0] == zlib.crc32(kind + body)
        chunks[kind], place = body, place + 12 + size
    width, height, _, kind = struct.unpack(">IIBB", chunks[b"IHDR"][:10])
    rows = zlib.decompress(chunks[b"IDAT"])
    length = len(rows) // height
    assert all(rows[i * length] == 0 for i in range(height))
    return width, height, kind, b"".join(rows[i * length + 1 : (i + 1) * length] for i in range(height))


@given(st.text(), st.floats(10, 300))
def test_any_name_is_cut_to_the_room_that_there_is(name, room):
    cut = clipped_name(name, room)
    assert len(cut) <= room / 3.6
    assert cut.removesuffix("…") == printable(name)[: len(cut.removesuffix("…"))]


@given(st.text())
def test_any_text_is_shown_as_text(text):
    html = shown(text)
    assert unescape(html) == printable(text)
    assert not set(html) & set("<>\"'")


@given(st.floats(allow_nan=False), st.floats(allow_nan=False))
@example(-1.7e308, 1.7e308)
@example(2.2250738585e-313, 2.2250738585072014e-308)
def test_ticks_lie_in_their_range(low, high):
    found = steps(low, high)
    assert 1 <= len(found) <= 12
    if len(found) > 1:
        assert all(low - 1e-6 * (high - low) <= tick <= high + 1e-6 * (high - low) for tick in found)


def test_names_and_axes():
    assert shown("<a>\x00\u202e\"'&") == "&lt;a&gt;\\x00\\u202e&quot;&#x27;&amp;"
    assert steps(0, 1, 5) == [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    assert steps(3, 3) == [3]
    assert steps(0, float("inf")) == [0]

"""Definitions of messages in IDL, made plain for rosbags' parser, which is slow by more than their length.

It tries what stands in a parenthesis eighty times, and in two within each other 6400 times; it tries a sequence twice,
and one within three others 16 times; it goes through a constant's text 64 times; and it works out whatever numbers a
definition has it make. What ROS 2 makes of a .msg has parentheses and shifts in annotations and comments alone, which
say nothing about a message's bytes.
"""

from __future__ import annotations

import functools
import re

from scroll_tactile.errors import RecordingError

__all__ = ["parts", "weight"]

_SEPARATOR, _HEADER = "=" * 80 + "\n", re.compile(r"\AIDL: .*\n")
_TOKEN = re.compile(r'("[^"\\]*(?:\\"?[^"\\]*)*")|/\*.*?(?:\*/|\Z)|//[^\n]*', re.DOTALL)  # a text, or else a comment
_ANNOTATION = re.compile(r"@\s*[A-Za-z:][\w:]*(?:\s*\([^()]*\))?")
_REFUSED = re.compile(r"\(|<<|\*|\bsequence ?< ?sequence ?<")
_EXPRESSION, _PIECE = re.compile(r'[=\[,|^&+\-/%~"]|\bw?string ?<|>>'), re.compile(r"[;{]|::")
_AN_EXPRESSION = 8  # pieces that take as long


@functools.lru_cache(16)  # they are weighed, and then read
def parts(text: str) -> tuple[str, ...]:
    """The definitions in a text, without comments and annotations, and with nothing in the texts of constants.

    One that needs others holds them all, each below a line of = and one with its name. Raises RecordingError for what
    the parser cannot read in the time that its length allows.
    """
    return tuple(_plain(_HEADER.sub("", part)) for part in text.split(_SEPARATOR) if part)


def weight(text: str) -> int:
    """How many members a definition has, or as much else as takes the parser as long; raises RecordingError as above.

    An array's length, a constant and each operator take as long as eight.
    """
    return sum(_AN_EXPRESSION * len(_EXPRESSION.findall(part)) + len(_PIECE.findall(part)) for part in parts(text))


def _plain(text: str) -> str:
    plain = _TOKEN.sub(lambda found: " " if found[1] is None else '""', text)
    plain = re.sub(r"\s+", " ", _ANNOTATION.sub(" ", plain))
    if found := _REFUSED.search(plain):
        raise RecordingError(
            f"a definition in IDL has {found[0]!r} in {plain[max(found.start() - 30, 0) : found.end() + 30]!r}; "
            "expected constants and lengths as plain numbers, and no sequence in a sequence, as ROS 2 writes. Pass "
            "the type's .msg file in definitions=, or write the numbers out",
            argument="definitions",
        )
    return plain

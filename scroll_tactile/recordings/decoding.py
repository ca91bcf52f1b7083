"""The bytes of ROS's messages as objects, by the definitions that come with them, or else ROS 2's own."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from scroll_tactile.errors import RecordingError
from scroll_tactile.libraries import missing
from scroll_tactile.recordings.bagfiles import Channel
from scroll_tactile.recordings.blocks import Request
from scroll_tactile.recordings.bounds import Budget
from scroll_tactile.recordings.paths import fields_of

__all__ = ["MessageTypes"]

# rclpy's serialize_message reckons with padding behind the count of an empty list, writes none, and leaves as many
# bytes of whatever was there behind the message: a JointState without velocities and efforts has eight. rosbags
# takes more than three for damage.
_END, _WIDEST = 3, 8

# rosbags writes code for each element of an array of fixed length: a second for 4096 of them, or for 2500 fields. The
# largest definitions of ROS's own packages, MoveIt's, have some 400 fields in all.
_MOST_LINES, _MOST_OBJECTS = 4000, 1 << 14
_A_LINE, _A_MESSAGE, _NESTED = 500, 8, 32  # steps of work; a nested message takes one for as many bytes


class MessageTypes:
    """Turns the bytes of messages into objects, by the definitions that come with them, or else ROS 2's own."""

    def __init__(self, request: Request) -> None:
        self.given = request.definitions
        self.readers: dict[Channel, _MessageReader] = {}

    def decode(self, channel: Channel, data: bytes, budget: Budget) -> object:
        """Raises RecordingError for a type that is not defined, bytes that do not fit it, or a budget that is spent."""
        reader = self.readers.get(channel)
        if reader is None:
            given = self.given.get(channel.type, "")
            budget.work(len(given or channel.definition) // _NESTED)
            budget.work(_A_LINE * _lines(channel, given))
            reader = self.readers[channel] = _reader(channel, given)
        budget.work(reader.steps + len(data) // _NESTED if reader.nested else reader.steps)
        try:
            return reader.read(data)
        except Exception as error:
            raise RecordingError(
                f"a message of topic {channel.topic!r} does not fit its type {channel.type}, and may be damaged: "
                f"{type(error).__name__}: {error}"
            ) from error


@dataclass(frozen=True)
class _MessageReader:
    """What makes an object of bytes. steps: of work for each; nested: whether more come with its bytes."""

    read: Callable[[bytes], object]
    steps: int = _A_MESSAGE
    nested: bool = True


def _lines(channel: Channel, given: str) -> int:
    """How many lines of a definition define something; raises RecordingError where they are too many."""
    if channel.idl and not given:
        count = _weight(channel.definition)
    else:
        lines = re.split(r"[\n;]", given or channel.definition)
        count = sum(1 for line in lines if line.strip() and not line.lstrip().startswith("#"))
    if count > _MOST_LINES:
        raise RecordingError(f"a definition of a message has {count} lines; expected at most {_MOST_LINES}")
    return count


@functools.lru_cache(256)  # as many bags as touches have the same messages
def _reader(channel: Channel, given: str) -> _MessageReader:
    if channel.encoding == "json":
        return _MessageReader(json.loads)
    if channel.encoding not in ("cdr", "ros1"):
        raise RecordingError(
            f"messages of topic {channel.topic!r} are encoded as {channel.encoding!r}; expected cdr, ros1 or json"
        )
    try:
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    except ImportError as error:
        raise missing("rosbags", "ros", "a ROS recording", cause=error) from error
    store = get_typestore(Stores.EMPTY)
    text = given or channel.definition
    try:
        if text and channel.idl and not given:
            for part in _parts(text):
                store.register(get_types_from_idl(part))
        elif text:
            store.register(get_types_from_msg(text, channel.type))
    except Exception as error:
        raise RecordingError(f"the definition of {channel.type} cannot be read: {error}") from error
    if not text or channel.type not in store.fielddefs:
        store = get_typestore(Stores.LATEST)
    if channel.type not in store.fielddefs:
        raise RecordingError(
            f"{channel.type} of topic {channel.topic!r} is not defined in the recording, as before ROS 2 Iron: "
            f"pass definitions={{{channel.type!r}: text of its .msg file}}",
            argument="definitions",
        )
    objects, nested = _objects(store.fielddefs, channel.type, {})
    if objects > _MOST_OBJECTS:
        raise RecordingError(f"a message of {channel.type} holds {objects} values; expected at most {_MOST_OBJECTS}")
    if channel.encoding == "ros1":
        return _MessageReader(lambda data: store.deserialize_ros1(data, channel.type), _A_MESSAGE + objects, nested)
    return _MessageReader(functools.partial(_read_cdr, store, channel.type), _A_MESSAGE + objects, nested)


def _objects(definitions: Any, name: str, known: dict[str, tuple[int, bool] | None]) -> tuple[int, bool]:
    """How many objects each message of a type becomes, arrays of numbers one each; whether it has lists of others.

    known: those of other types; None while it is being found out. Raises RecordingError for a type that holds itself,
    or nothing.
    """
    from rosbags.interfaces import Nodetype

    if name in known:
        if (found := known[name]) is None:
            raise RecordingError(f"a message of {name} holds itself")
        return found
    known[name] = None
    total, nested = 1, False
    for field, (kind, about) in definitions[name][1]:
        array, several = kind == Nodetype.ARRAY, kind == Nodetype.SEQUENCE
        of, what = about[0] if array or several else (kind, about)
        plain = of == Nodetype.BASE and what[0] != "string"
        inside, deeper = _objects(definitions, what, known) if of == Nodetype.NAME else (1, False)
        names = [name for name, _ in definitions[what][1]] if of == Nodetype.NAME else [field]
        if (array and about[1] < 1) or names in ([], ["structure_needs_at_least_one_member"]):
            # There could be any number of them in no byte.
            raise RecordingError(f"field {field!r} of {name} can hold nothing; expected numbers or texts in it")
        total += inside * (about[1] if array and not plain else 1)
        nested |= deeper or (several and not plain)
    known[name] = total, nested
    return total, nested


def _read_cdr(store: Any, kind: str, data: bytes) -> object:
    try:
        return store.deserialize_cdr(data, kind)
    except Exception:
        about = store.get_msgdef(kind)
        with suppress(Exception):  # whatever damage does; the first error says it
            read = {b"\0\0": about.deserialize_cdr_be, b"\0\1": about.deserialize_cdr_le}[data[:2]]
            message, end = read(data[4:], 0, about.cls, store)
            if len(data) - 4 - end <= _END + _WIDEST * _empty_lists(message):
                return message
        raise


def _empty_lists(message: Any) -> int:
    """How many lists of 8-byte numbers in a message are empty."""
    if isinstance(message, np.ndarray):
        return int(message.size == 0 and message.itemsize == _WIDEST)
    if isinstance(message, list):
        return sum(map(_empty_lists, message))
    return sum(_empty_lists(getattr(message, name)) for name in fields_of(message))


# Definitions in IDL are made plain for rosbags' parser, which is slow by more than their length. It tries what stands
# in a parenthesis eighty times, and in two within each other 6400 times; it tries a sequence twice, and one within
# three others 16 times; it goes through a constant's text 64 times; and it works out whatever numbers a definition has
# it make. What ROS 2 makes of a .msg has parentheses and shifts in annotations and comments alone.
_SEPARATOR, _HEADER = "=" * 80 + "\n", re.compile(r"\AIDL: .*\n")
_TOKEN = re.compile(r'("[^"\\]*(?:\\"?[^"\\]*)*")|/\*.*?(?:\*/|\Z)|//[^\n]*', re.DOTALL)  # a text, or else a comment
_ANNOTATION = re.compile(r"@\s*[A-Za-z:][\w:]*(?:\s*\([^()]*\))?")
_REFUSED = re.compile(r"\(|<<|\*|\bsequence ?< ?sequence ?<")
_EXPRESSION, _PIECE = re.compile(r'[=\[,|^&+\-/%~"]|\bw?string ?<|>>'), re.compile(r"[;{]|::")
_AN_EXPRESSION = 8  # pieces that take as long


@functools.lru_cache(16)  # they are weighed, and then read
def _parts(text: str) -> tuple[str, ...]:
    """The definitions in a text, without comments and annotations, and with nothing in the texts of constants.

    One that needs others holds them all, each below a line of = and one with its name. Raises RecordingError for what
    the parser cannot read in the time that its length allows.
    """
    return tuple(_plain(_HEADER.sub("", part)) for part in text.split(_SEPARATOR) if part)


def _weight(text: str) -> int:
    """How many members a definition has, or as much else as takes the parser as long; raises RecordingError as above.

    An array's length, a constant and each operator take as long as eight.
    """
    return sum(_AN_EXPRESSION * len(_EXPRESSION.findall(part)) + len(_PIECE.findall(part)) for part in _parts(text))


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

"""The bytes of ROS's messages as objects, by definitions: those given, a bag's, a known driver's, or ROS 2's own."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import Any

from scroll_tactile.errors import InputError, RecordingError
from scroll_tactile.libraries import optional
from scroll_tactile.recordings import presets
from scroll_tactile.recordings.bagfiles import Channel

__all__ = ["MessageTypes", "definitions_of"]

# rclpy's serialize_message reckons with padding behind the count of an empty list, writes none, and leaves as many
# bytes of whatever was there behind the message: a JointState without velocities and efforts has eight. rosbags
# takes more than three for damage.
_A_WORD, _MOST_REST = 4, 16

# rosbags writes code for each element of an array of messages, and takes a second for a definition of 100 KB, as
# MoveIt's are.
_MOST_LETTERS, _MOST_OBJECTS = 1 << 19, 1 << 14

_NOTHING = "structure_needs_at_least_one_member"  # what ROS 2 writes for a message without fields

_Definitions = tuple[tuple[str, str], ...]  # a type's name, with its package or without, and the text of its .msg


def definitions_of(given: Mapping[str, str] | str | PathLike[str] | None) -> dict[str, str]:
    """The texts of .msg files by their types' names, of a mapping or of a folder: `package/msg/Name.msg`, or flat.

    Raises InputError for a folder that has none.
    """
    if given is None or isinstance(given, Mapping):
        return dict(given or {})
    files = sorted(Path(given).rglob("*.msg"))
    if not files:
        raise InputError(f"expected a folder with .msg files in it; came {given}", argument="definitions")
    packages = [file.resolve().parent.parent.name if file.resolve().parent.name == "msg" else "" for file in files]
    names = [
        f"{package}/msg/{file.stem}" if package else file.stem for package, file in zip(packages, files, strict=True)
    ]
    return {name: file.read_text(errors="replace") for name, file in zip(names, files, strict=True)}


class MessageTypes:
    """Turns the bytes of messages into objects. given: definitions, as `definitions_of` gives them."""

    def __init__(self, given: Mapping[str, str]) -> None:
        self.given = tuple(given.items())
        self.readers: dict[Channel, Callable[[bytes], object]] = {}

    def decode(self, channel: Channel, data: bytes) -> Any:
        """Raises RecordingError for a type that is not defined, and for bytes that do not fit it."""
        reader = self.readers.get(channel)
        why: Exception | None = None
        for read in [reader] if reader else _readers(channel, self.given):
            try:
                found = read(data)
            except Exception as error:  # whatever damage does
                why = error
                continue
            self.readers[channel] = read
            return found
        raise RecordingError(
            f"a message of topic {channel.topic!r} does not fit its type {channel.type}, and may be damaged: "
            f"{type(why).__name__}: {why}" + ("" if reader or channel.definition else f". {_cure(channel.type)}"),
            argument="definitions",
        ) from why


def _cure(kind: str) -> str:
    return f"Give definitions='FOLDER', a folder with {kind.rpartition('/')[2]}.msg of its driver and what that names"


@functools.lru_cache(256)  # as many bags as touches have the same messages
def _readers(channel: Channel, given: _Definitions) -> tuple[Callable[[bytes], object], ...]:
    """What may make objects of a channel's bytes: several where versions of a driver differ."""
    if channel.encoding == "json":
        return (json.loads,)
    if channel.encoding not in ("cdr", "ros1"):
        raise RecordingError(
            f"messages of topic {channel.topic!r} are encoded as {channel.encoding!r}; expected cdr, ros1 or json"
        )
    with optional("rosbags", "ros", "a ROS recording"):
        from rosbags.typesys import Stores, get_typestore
    readers: list[Callable[[bytes], object]] = []
    for texts in _alternatives(channel, given):
        store = get_typestore(Stores.EMPTY)
        try:
            store.register(_needed(channel, texts))
        except InputError:
            raise
        except Exception as error:
            raise RecordingError(
                f"the definition of {channel.type} cannot be read: {error}. {_cure(channel.type)}",
                argument="definitions",
            ) from error
        readers.append(functools.partial(_read_ros1 if channel.encoding == "ros1" else _read_cdr, store, channel.type))
    return tuple(readers)


def _read_ros1(store: Any, kind: str, data: bytes) -> object:
    return store.deserialize_ros1(data, kind)


def _alternatives(channel: Channel, given: _Definitions) -> Iterator[dict[str, str]]:
    """The texts that may define a channel's type, by full names; none where the bag defines it itself."""
    package, _, short = channel.type.rpartition("/")
    if channel.definition and not {channel.type, short} & {name for name, _ in given}:
        yield {}
        return
    for driver in presets.definitions(short) or [{}]:
        texts = {f"{package}/{name.rpartition('/')[2]}": text for name, text in [*driver.items(), *given]}
        yield texts | {name: text for name, text in given if "/" in name}


def _needed(channel: Channel, texts: Mapping[str, str]) -> dict[str, Any]:
    """The definitions of a channel's type and of all that it is made of, as rosbags has them.

    Raises RecordingError for one that is not there, that holds itself or nothing, or that is too large.
    """
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    known: dict[str, Any] = {}
    if not texts and channel.definition:
        if len(channel.definition) > _MOST_LETTERS:
            raise RecordingError(f"the definition of {channel.type} has more than {_MOST_LETTERS} letters")
        if channel.idl:
            for part in _plain(channel.definition):
                known |= get_types_from_idl(part)
        else:
            known = get_types_from_msg(channel.definition, channel.type)
    of_ros = get_typestore(Stores.ROS2_HUMBLE).fielddefs
    needed: dict[str, Any] = {}
    sizes: dict[str, int] = {}

    def size(name: str) -> int:
        """How many objects each message of a type becomes, arrays of numbers one each."""
        if name in sizes:
            return sizes[name]
        if name in needed:
            raise RecordingError(f"a message of {name} holds itself")
        if name not in known and name in texts:
            known.update(get_types_from_msg(texts[name], name))
        if (about := known.get(name, of_ros.get(name))) is None:
            raise RecordingError(
                f"{name} of topic {channel.topic!r} is not defined in the recording, as before ROS 2 Iron. "
                f"{_cure(name)}",
                argument="definitions",
            )
        needed[name] = about
        total = 1
        for field, (form, what) in about[1]:
            several = form in (Nodetype.ARRAY, Nodetype.SEQUENCE)
            part, inner = what[0] if several else (form, what)
            count = what[1] if form == Nodetype.ARRAY else 1
            objects = size(inner) if part == Nodetype.NAME else 1
            nothing = part == Nodetype.NAME and {name for name, _ in needed[inner][1]} <= {_NOTHING}
            if several and (count < 1 or nothing):  # there could be any number of them in no byte
                raise RecordingError(f"field {field!r} of {name} can hold nothing; expected numbers or texts in it")
            total += objects * (count if part == Nodetype.NAME or inner[0] == "string" else 1)
        if total > _MOST_OBJECTS:
            raise RecordingError(f"a message of {name} holds {total} values; expected at most {_MOST_OBJECTS}")
        sizes[name] = total
        return total

    size(channel.type)
    return needed


def _read_cdr(store: Any, kind: str, data: bytes) -> object:
    try:
        return store.deserialize_cdr(data, kind)
    except Exception:
        for rest in range(_A_WORD, _MOST_REST + 1, _A_WORD):
            with suppress(Exception):  # whatever damage does; the first error says it
                return store.deserialize_cdr(data[:-rest], kind)
        raise


# What rosbags' parser of IDL takes long for: it tries what stands in parentheses eighty times, a sequence in sequences
# as often as two to their number, and it works out whatever numbers a definition has it make. What ROS 2 makes of a
# .msg has those in comments, annotations and texts alone.
_TOKEN = re.compile(r'("[^"\\]*(?:\\"?[^"\\]*)*")|/\*.*?(?:\*/|\Z)|//[^\n]*', re.DOTALL)  # a text, or else a comment
_ANNOTATION = re.compile(r"@\s*[A-Za-z:][\w:]*(?:\s*\([^()]*\))?")
_REFUSED = re.compile(r"\(|<<|\*|\bsequence ?< ?sequence ?<")


def _plain(definition: str) -> Iterator[str]:
    """The parts of a definition in IDL without comments, annotations, texts; raises RecordingError for the above."""
    for part in re.split(r"^=+\n", definition, flags=re.MULTILINE):
        plain = _TOKEN.sub(lambda found: " " if found[1] is None else '""', re.sub(r"\AIDL: .*\n", "", part))
        plain = re.sub(r"\s+", " ", _ANNOTATION.sub(" ", plain))
        if found := _REFUSED.search(plain):
            raise RecordingError(
                f"a definition in IDL has {found[0]!r} in {plain[max(found.start() - 30, 0) : found.end() + 30]!r}; "
                "expected plain numbers, and no sequence in a sequence, as ROS 2 writes: give definitions='FOLDER' "
                "with the type's .msg file",
                argument="definitions",
            )
        if plain.strip():
            yield plain

"""ROS recordings as a source: which files make one, what their messages are, and the numbers in them."""

from __future__ import annotations

import itertools
import json
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import FieldError, RecordingError
from scroll_tactile.recordings import presets
from scroll_tactile.recordings.bagfiles import Channel, Message, Scan, inflated, scan_bag, scan_db3, scan_mcap
from scroll_tactile.recordings.blocks import Block, Contents, Entry, Request, floats, missing, rows_of
from scroll_tactile.recordings.clocks import Stamps
from scroll_tactile.recordings.paths import FieldPath, fields_of, nearest

__all__ = ["SUFFIXES", "RosBag", "is_rosbag"]

SUFFIXES = (".bag", ".mcap", ".db3")
"""What ROS's recordings end in."""

_LOOKED = 2000  # messages are looked at to say what a bag holds


def is_rosbag(path: Path) -> bool:
    """Whether this is a recording of ROS: one of its files, or a folder of them."""
    if path.is_dir():
        return (path / "metadata.yaml").exists() or any(_is_file(inside) for inside in path.iterdir())
    return _is_file(path)


def _is_file(path: Path) -> bool:
    name = path.name.lower().removesuffix(".zstd").removesuffix(".active")
    return name.endswith(SUFFIXES)


class RosBag:
    """A ROS 1 or ROS 2 recording: one file, or a folder of the parts that it was split into; see `Source`."""

    def __init__(self, path: Path, address: str, request: Request) -> None:
        self.address = address
        self.request = request
        self.topic = request.topic
        self.notes: list[str] = []
        self.cut_off = False
        self.names: dict[int, str] = {}
        self.marks: list[tuple[float, str]] = []
        self.files, self.compressed = _files(path)
        self.types = _Types(request)
        self._field: FieldPath | None = None

    def field(self) -> str:
        """The path to the numbers, as requested."""
        return self._field.text if self._field is not None else ""

    def contents(self) -> Contents:
        """The numbers in the first messages of each topic, those of known sensors first."""
        seen: dict[tuple[str, str], list[int]] = {}
        entries: dict[tuple[str, str], list[Entry]] = {}
        messages = itertools.islice(self._messages(lambda topic: True), _LOOKED)
        for message in messages:
            key = message.channel.topic, message.channel.type
            seen.setdefault(key, []).append(message.log)
            if key not in entries:
                try:
                    decoded = self.types.decode(message.channel, message.data)
                except RecordingError as error:
                    self.notes.append(str(error))
                    entries[key] = []
                    continue
                known = presets.fields_for(message.channel.type, decoded)
                entries[key] = [
                    Entry(key[0], text, shape, kind=key[1]) for text, shape in (known or list(_numbers(decoded)))
                ]
        total = sum(map(len, seen.values()))
        found = [
            Entry(entry.topic, entry.field, entry.shape, len(logs), _rate(logs), entry.kind)
            for key, logs in seen.items()
            for entry in entries[key]
        ]
        found.sort(key=lambda entry: not presets.is_known(entry.kind))
        return Contents(
            self.address,
            tuple(found),
            f"in its first {total} messages, among others perhaps" if total == _LOOKED else "",
        )

    def blocks(self) -> Iterator[Block]:
        """The readings of the requested topic; raises FieldError, with what there is, for one that is not there."""
        request = self.request
        self.topic, text = topic, _ = self._choose()
        self._field = path = FieldPath(text)
        stamps = Stamps(request.clock, text)
        rows: list[npt.NDArray[Any]] = []
        width, most, unfit = -1, 1, 0
        labels = request.labels
        for i, message in enumerate(self._messages(lambda name: name in (topic, labels))):
            channel = message.channel
            try:
                decoded = self.types.decode(channel, message.data)
            except RecordingError:
                if width < 0:
                    raise
                unfit += 1
                continue
            if channel.topic == labels:
                self.marks.append((message.log / 1e9, _text_in(decoded, channel)))
                if labels != topic:
                    continue
            row = _picture(decoded, path) if "encoding" in fields_of(decoded) else None
            row = path.reading(decoded) if row is None else row
            if width < 0:
                width, most = row.size, rows_of(max(row.nbytes, 4 * row.size))
                if not width:
                    raise FieldError(f"field {text!r} of topic {topic!r} holds no value: its array is empty")
            if row.size != width:
                raise RecordingError(
                    f"{self.address}: readings are ragged: message {i} of {topic!r} has {row.size} values in {text!r}, "
                    f"where those before have {width}. Name elements that each message has, as in {text}[0:{width}]"
                )
            rows.append(row)
            stamps.add(message, decoded)
            if len(rows) >= most:
                yield Block(floats(np.stack(rows)), *stamps.take())
                rows = []
        if unfit:
            self.notes.append(f"{unfit} messages do not fit their type, and were left out")
        if rows:
            yield Block(floats(np.stack(rows)), *stamps.take())
        elif width < 0:
            self._absent(topic)

    def _choose(self) -> tuple[str, str]:
        """The topic and the field, where the request or a preset names them, or where there is only one."""
        topic, text = self.request.topic, self.request.field
        if topic is not None and text is not None:
            return topic, text
        contents = self.contents()
        if not contents.entries:
            self._absent(topic)
        if text is None:
            fields = [e for e in contents.entries if topic is None or e.topic == topic]
            if not fields:
                self._absent(topic)
            raise FieldError(f"expected a topic and a field to read\n{Contents(contents.source, tuple(fields))}")
        root = re.split(r"[.\[{]", text.strip(), maxsplit=1)[0].lower()
        topics = {e.topic for e in contents.entries if re.split(r"[.\[{]", e.field, maxsplit=1)[0].lower() == root}
        if len(topics) != 1:
            raise FieldError(f"{'several topics have' if topics else 'no topic has'} a field {text!r}\n{contents}")
        return str(topics.pop()), text

    def _absent(self, topic: str | None) -> None:
        topics: dict[str, None] = {}
        for message in itertools.islice(self._messages(lambda name: True), _LOOKED):
            topics[message.channel.topic] = None
        if not topics:
            raise RecordingError(
                f"{self.address} holds no message" + (f": {'; '.join(self.notes)}" if self.notes else "")
            )
        raise FieldError(f"{self.address} holds no message of topic {topic!r}{nearest(str(topic), list(topics))}")

    def _messages(self, wanted: Callable[[str], bool]) -> Iterator[Message]:
        self.notes, self.cut_off, self.marks = [], False, []
        for path in self.files:
            scan = Scan(wanted)
            with tempfile.TemporaryDirectory() as folder:
                file = inflated(path, Path(folder)) if path.suffix.lower() == ".zstd" else path
                name = file.name.lower().removesuffix(".active")
                if name.endswith(".bag"):
                    yield from scan_bag(file, scan)
                elif name.endswith(".mcap"):
                    yield from scan_mcap(file, scan)
                else:
                    yield from scan_db3(file, scan, compressed=self.compressed)
            if scan.cut_off is not None:
                self.cut_off = True
                self.notes.append(f"{path.name} was cut off: {scan.cut_off}; what comes before was read")
            if scan.damaged:
                self.notes.append(f"{path.name} has {scan.damaged} damaged chunks, which were left out")


def _files(path: Path) -> tuple[list[Path], bool]:
    """The files of a recording in their order, and whether its messages are compressed one by one."""
    if not path.is_dir():
        return [path], False
    there = sorted((p for p in path.iterdir() if _is_file(p)), key=lambda p: _natural(p.name))
    listed = path / "metadata.yaml"
    if not listed.exists():
        return there, False
    try:
        from ruamel.yaml import YAML  # comes with rosbags
    except ImportError as error:
        raise missing("rosbags", "ros", "a ROS recording") from error
    about = YAML(typ="safe").load(listed.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
    files = [path / Path(str(name)).name for name in about["relative_file_paths"]]
    absent = [file.name for file in files if not file.exists()]
    if absent:
        raise RecordingError(
            f"{listed} lists {', '.join(absent)}, which are not there: copy them, or read the parts that are there, "
            f"{', '.join(p.name for p in there) or 'none'}, one by one"
        )
    return files, str(about.get("compression_mode", "")).lower() == "message"


def _natural(name: str) -> list[Any]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]


class _Types:
    """Turns the bytes of messages into objects, by the definitions that come with them, or else ROS 2's own."""

    def __init__(self, request: Request) -> None:
        self.given = request.definitions
        self.readers: dict[Channel, Callable[[bytes], object]] = {}

    def decode(self, channel: Channel, data: bytes) -> object:
        """Raises RecordingError for a type that is not defined, and for bytes that do not fit it."""
        reader = self.readers.get(channel)
        if reader is None:
            reader = self.readers[channel] = self._reader(channel)
        try:
            return reader(data)
        except RecordingError:
            raise
        except Exception as error:
            raise RecordingError(
                f"a message of topic {channel.topic!r} does not fit its type {channel.type}, and may be damaged: "
                f"{type(error).__name__}: {error}"
            ) from error

    def _reader(self, channel: Channel) -> Callable[[bytes], object]:
        if channel.encoding == "json":
            return json.loads
        if channel.encoding not in ("cdr", "ros1"):
            raise RecordingError(
                f"messages of topic {channel.topic!r} are encoded as {channel.encoding!r}; expected cdr, ros1 or json"
            )
        try:
            from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
        except ImportError as error:
            raise missing("rosbags", "ros", "a ROS recording") from error
        store = get_typestore(Stores.EMPTY)
        text = self.given.get(channel.type) or channel.definition
        if text:
            try:
                types = get_types_from_idl(text) if channel.idl else get_types_from_msg(text, channel.type)
                store.register(types)
            except Exception as error:
                raise RecordingError(f"the definition of {channel.type} cannot be read: {error}") from error
        if not text or channel.type not in store.fielddefs:
            store = get_typestore(Stores.LATEST)
        if channel.type not in store.fielddefs:
            raise RecordingError(
                f"{channel.type} of topic {channel.topic!r} is not defined in the recording, as before ROS 2 Iron: "
                f"pass definitions={{{channel.type!r}: text of its .msg file}}"
            )
        if channel.encoding == "ros1":
            return lambda data: store.deserialize_ros1(data, channel.type)
        return lambda data: store.deserialize_cdr(data, channel.type)


def _rate(logs: list[int]) -> float | None:
    steps = np.diff(np.sort(np.array(logs, np.int64)))
    middle = float(np.median(steps)) if len(steps) else 0.0
    return 1e9 / middle if middle > 0 else None


def _numbers(message: object, before: str = "", depth: int = 0) -> Iterator[tuple[str, tuple[int, ...]]]:
    """The paths to numbers in a message, and the shapes of what they lead to, arrays first."""
    scalars = []
    for name in fields_of(message):
        value = message[name] if isinstance(message, dict) else getattr(message, name)
        text = f"{before}{name}"
        if isinstance(value, np.ndarray) and value.dtype.kind in "biuf" and value.size:
            yield text, value.shape
        elif isinstance(value, list) and value and fields_of(value[0]) and depth < 4:
            inner = list(_numbers(value[0], f"{text}[*].", depth + 1))
            yield from ((path, (len(value), *shape)) for path, shape in inner)
        elif fields_of(value) and name not in ("header", "stamp", "layout") and depth < 4:
            yield from _numbers(value, f"{text}.", depth + 1)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            scalars.append(name)
    if scalars and before[-2:] != "]." and len(scalars) == 1:
        yield f"{before}{scalars[0]}", (1,)
    elif scalars and not before.startswith(("header.", "stamp.")):
        yield f"{before}{{{','.join(scalars)}}}", (len(scalars),)


def _text_in(message: object, channel: Channel) -> str:
    """The text of a message of labels: of `data`, or of its only field with text."""
    texts = {name: getattr(message, name, None) for name in fields_of(message)}
    found = {name: text for name, text in texts.items() if isinstance(text, str)}
    if "data" in found or len(found) == 1:
        return found.get("data") or next(iter(found.values()))
    raise FieldError(f"topic {channel.topic!r} of type {channel.type} cannot label: expected one field with text")


def _picture(message: Any, path: FieldPath) -> npt.NDArray[np.uint8] | None:
    """The pixels of a sensor_msgs/Image, shape (height, width, 3) in red, green, blue; None for anything else."""
    orders = {"rgb8": [0, 1, 2], "bgr8": [2, 1, 0], "rgba8": [0, 1, 2], "bgra8": [2, 1, 0], "mono8": [0, 0, 0]}
    order = orders.get(message.encoding)
    if path.text != "data" or order is None or not {"height", "width", "step"} <= set(fields_of(message)):
        return None
    depth = len(message.encoding.removesuffix("8")) if message.encoding != "mono8" else 1
    height, width = message.height, message.width
    pixels = np.frombuffer(bytes(message.data), np.uint8)
    if message.step < width * depth or pixels.size < height * message.step:
        raise RecordingError(f"a picture of {height} × {width} pixels is claimed; there are {pixels.size} bytes")
    lines = pixels[: height * message.step].reshape(height, message.step)[:, : width * depth]
    return lines.reshape(height, width, depth)[:, :, order]

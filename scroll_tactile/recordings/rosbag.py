"""ROS recordings as a source: which files make one, what their messages are, and the numbers in them."""

from __future__ import annotations

import itertools
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import FieldError, RecordingError
from scroll_tactile.libraries import missing
from scroll_tactile.recordings import presets
from scroll_tactile.recordings.bagfiles import Channel, Message, Scan, inflated, scan_bag, scan_db3, scan_mcap
from scroll_tactile.recordings.blocks import Block, Contents, Entry, Request, Source, floats, rows_of
from scroll_tactile.recordings.bounds import Budget, read_text, require_inside, stored_bytes
from scroll_tactile.recordings.decoding import MessageTypes
from scroll_tactile.recordings.paths import FieldPath, fields_of, nearest

__all__ = ["SUFFIXES", "RosBag", "is_rosbag", "picture"]

SUFFIXES = (".bag", ".mcap", ".db3")
"""What ROS's recordings end in."""

# What is needed of metadata.yaml, as rosbag2 writes it: each with the lines below it that lie deeper, or are a list's.
_LISTED = re.compile(r"^  (?:relative_file_paths|compression_mode):.*\n(?:(?:  +- |   ).*\n)*", re.MULTILINE)

_LOOKED = 2000  # messages are looked at to say what a bag holds
_DEEPEST = 32  # lists of metadata.yaml within each other, of which recorders write six
_LONGEST, _LISTS = 1 << 24, 1 << 16  # bytes of metadata.yaml; and of the part that lists files: two thousand of them

_PIXELS = 1 << 24  # of a compressed picture: 4096 × 4096, where the largest camera of a gel has 1600 × 1200


def is_rosbag(path: Path) -> bool:
    """Whether this is a recording of ROS: one of its files, or a folder of them."""
    return (path / "metadata.yaml").exists() or bool(_parts(path)) if path.is_dir() else _is_file(path)


def _parts(folder: Path) -> list[Path]:
    """The parts of one recording in their order: files whose names differ in a last number alone; otherwise none."""
    files = sorted((inside for inside in folder.iterdir() if _is_file(inside)), key=lambda file: _natural(file.name))
    return files if len({re.sub(r"\d+(?=\.|$)", "", file.name, count=1) for file in files}) == 1 else []


def _is_file(path: Path) -> bool:
    name = path.name.lower().removesuffix(".zstd").removesuffix(".active")
    return name.endswith(SUFFIXES)


class RosBag(Source):
    """A ROS 1 or ROS 2 recording: one file, or a folder of the parts that it was split into; see `Source`."""

    topics = labels = True

    def __init__(self, path: Path, address: str, request: Request) -> None:
        super().__init__(path, address, request)
        self.files, self.compressed = _files(path)
        self.types = MessageTypes(request)

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
                    decoded = self.types.decode(message.channel, message.data, self.budget)
                except RecordingError as error:
                    self.notes.append(str(error))
                    entries[key] = []
                    continue
                fields = dict([*presets.fields_for(message.channel.type, decoded), *_numbers(decoded)])
                entries[key] = [Entry(key[0], text, shape, kind=key[1]) for text, shape in fields.items()]
        total = sum(map(len, seen.values()))
        found = [
            Entry(entry.topic, entry.field, entry.shape, len(logs), _rate(logs), entry.kind)
            for key, logs in seen.items()
            for entry in entries[key]
        ]
        found.sort(key=lambda entry: not presets.is_known(entry.kind))
        looked = f"in its first {total} messages, among others perhaps" if total == _LOOKED else ""
        return Contents(self.address, tuple(found), looked, tuple(dict.fromkeys(self.notes)))

    def blocks(self) -> Iterator[Block]:
        """The readings of the requested topic; raises FieldError, with what there is, for one that is not there."""
        topic, text = self._choose()
        self.topic = topic
        path, stamps = FieldPath(text), Stamps(self.request.clock, text)
        rows: list[npt.NDArray[Any]] = []
        width, most = -1, 1
        for i, (message, decoded) in enumerate(self._decoded(topic)):
            row = picture(decoded) if path.text == "data" else None
            if row is None:
                row = path.reading(decoded)
            else:
                self.budget.take(row.nbytes)
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
        if rows:
            yield Block(floats(np.stack(rows)), *stamps.take())
        if width < 0:
            self._absent(topic)
        if self.request.labels is not None and not self.marks:
            self._absent(self.request.labels)

    def _decoded(self, topic: str) -> Iterator[tuple[Message, Any]]:
        """The messages of a topic as objects; those of the topic that labels go to `marks`."""
        labels = self.request.labels
        decoded, unfit = None, 0
        for message in self._messages(lambda name: name in (topic, labels)):
            try:
                decoded = self.types.decode(message.channel, message.data, self.budget)
            except RecordingError:
                if decoded is None:
                    raise
                unfit += 1
                continue
            if message.channel.topic == labels:
                self.marks.append((message.log / 1e9, _text_in(decoded, message.channel)))
            if message.channel.topic == topic:
                yield message, decoded
        if unfit:
            self.notes.append(f"{unfit} messages do not fit their type, and were left out")

    def _choose(self) -> tuple[str, str]:
        """The topic and the field, where the request or a preset names them, or where there is only one."""
        topic, text = self.request.topic, self.request.field
        if topic is not None and text is not None:
            return topic, text
        topics = self._having(FieldPath(text)) if text is not None else []
        if len(topics) == 1 and text is not None:
            return topics[0], text
        contents = self.contents()
        if text is not None and contents.entries:
            raise contents.refused(f"{'several topics have' if topics else 'no topic has'} a field {text!r}")
        entries = tuple(entry for entry in contents.entries if topic in (None, entry.topic))
        if not entries:
            self._absent(topic)
        raise Contents(contents.source, entries).refused("expected a topic and a field to read")

    def _having(self, path: FieldPath) -> list[str]:
        """The topics in whose first message a path leads to numbers; the likely one alone where it is among them."""
        topics: dict[str, bool] = {}
        for message in itertools.islice(self._messages(lambda name: True), _LOOKED):
            topic = message.channel.topic
            if topic not in topics:
                topics[topic] = False
                with suppress(RecordingError):
                    topics[topic] = path.reading(self.types.decode(message.channel, message.data, self.budget)).size > 0
                if topics[topic] and topic == self.request.likely:
                    return [topic]
        return [topic for topic, has in topics.items() if has]

    def _absent(self, topic: str | None) -> NoReturn:
        problems = self.notes
        messages = itertools.islice(self._messages(lambda name: True), _LOOKED)
        topics = dict.fromkeys(message.channel.topic for message in messages)
        if not topics:
            raise RecordingError(
                f"{self.address} holds no message" + (f": {'; '.join(self.notes)}" if self.notes else "")
            )
        if topic is None:
            raise RecordingError(f"{self.address} has no numbers in {', '.join(topics)}: {'; '.join(problems)}")
        raise FieldError(f"{self.address} holds no message of topic {topic!r}{nearest(str(topic), list(topics))}")

    def _messages(self, wanted: Callable[[str], bool]) -> Iterator[Message]:
        self.notes, self.cut_off, self.marks = [], False, []
        self.budget = Budget(self.address)
        for path in self.files:
            self.budget.add(stored_bytes(path))
            scan = Scan(wanted, self.budget)
            if path.suffix.lower() != ".zstd":
                yield from self._scanned(path, scan)
            else:
                with tempfile.TemporaryDirectory() as folder:
                    yield from self._scanned(inflated(path, Path(folder), self.budget), scan)
            if scan.cut_off is not None:
                self.cut_off = True
                self.notes.append(f"{path.name} was cut off: {scan.cut_off}; what comes before was read")
            if scan.damaged:
                self.notes.append(f"{path.name} has {scan.damaged} damaged chunks, which were left out")

    def _scanned(self, file: Path, scan: Scan) -> Iterator[Message]:
        name = file.name.lower().removesuffix(".active")
        if name.endswith(".bag"):
            return scan_bag(file, scan)
        if name.endswith(".mcap"):
            return scan_mcap(file, scan)
        return scan_db3(file, scan, compressed=self.compressed)


def _files(path: Path) -> tuple[list[Path], bool]:
    """The files of a recording in their order, and whether its messages are compressed one by one."""
    if not path.is_dir():
        return [path], False
    there = files = _parts(path)
    listed, compressed = path / "metadata.yaml", False
    if listed.exists():
        about = _listing(path, listed)
        compressed = str(about.get("compression_mode", "")).lower() == "message"
        files = [path / Path(str(name)).name for name in about["relative_file_paths"]]
    if absent := [file.name for file in files if not file.exists()]:
        raise RecordingError(
            f"{listed} lists {', '.join(absent)}, which are not there: copy them, or read the parts that are there, "
            f"{', '.join(p.name for p in there) or 'none'}, one by one"
        )
    for file in files:
        require_inside(path, file)
    return files, compressed


def _listing(path: Path, listed: Path) -> Any:
    """The part of a metadata.yaml that lists files; raises RecordingError where reading it would take for ever."""
    try:
        from ruamel.yaml import YAML, AliasEvent  # comes with rosbags
        from ruamel.yaml.events import CollectionEndEvent, CollectionStartEvent
    except ImportError as error:
        raise missing("rosbags", "ros", "a ROS recording", cause=error) from error
    text = read_text(path, listed, _LONGEST)
    parts = [text[match.start() : match.end()] for match in _LISTED.finditer(text)]
    # The whole text takes as long as a hundred messages do.
    lists = "".join(parts) if len(parts) == 2 else text
    if len(lists) > _LISTS:
        raise RecordingError(f"{listed} lists its files in {len(lists)} letters; expected at most {_LISTS}")
    depth = 0
    for event in YAML(typ="safe").parse(lists):
        if isinstance(event, AliasEvent):
            raise RecordingError(f"{listed} has aliases, which no recorder writes, and which can stand for any length")
        depth += isinstance(event, CollectionStartEvent) - isinstance(event, CollectionEndEvent)
        if depth > _DEEPEST:  # each level makes all that follows slower
            raise RecordingError(f"{listed} has more than {_DEEPEST} lists within each other")
    about = YAML(typ="safe").load(lists)
    return about if len(parts) == 2 else about["rosbag2_bagfile_information"]


def _natural(name: str) -> list[Any]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]


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
        if (array := _array(value)) is not None:
            yield text, array.shape
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


def _array(value: object) -> npt.NDArray[Any] | None:
    """An array of numbers, which JSON has as lists; None for anything else, and where there are none."""
    if isinstance(value, list) and value and isinstance(value[0], int | float | list):
        with suppress(ValueError):  # of rows that differ in length
            value = np.asarray(value)
    return value if isinstance(value, np.ndarray) and value.dtype.kind in "biuf" and value.size else None


def _text_in(message: object, channel: Channel) -> str:
    """The text of a message of labels: of `data`, or of its only field with text."""
    texts = {name: getattr(message, name, None) for name in fields_of(message)}
    found = {name: text for name, text in texts.items() if isinstance(text, str)}
    if "data" in found or len(found) == 1:
        return found.get("data") or next(iter(found.values()))
    raise FieldError(f"topic {channel.topic!r} of type {channel.type} cannot label: expected one field with text")


_ORDERS = {"rgb8": [0, 1, 2], "bgr8": [2, 1, 0], "rgba8": [0, 1, 2], "bgra8": [2, 1, 0], "mono8": [0, 0, 0]}


def picture(message: Any) -> npt.NDArray[np.uint8] | None:
    """The pixels of a sensor_msgs Image or CompressedImage, (height, width, 3) in red, green, blue; None otherwise."""
    fields = set(fields_of(message))
    if fields == {"header", "format", "data"}:
        return _decompressed(bytes(message.data))
    if not {"height", "width", "step", "encoding"} <= fields or message.encoding not in _ORDERS:
        return None
    depth = 1 if message.encoding == "mono8" else len(message.encoding) - 1
    height, width = message.height, message.width
    pixels = np.frombuffer(bytes(message.data), np.uint8)
    if message.step < width * depth or pixels.size < height * message.step:
        raise RecordingError(f"a picture of {height} × {width} pixels is claimed; there are {pixels.size} bytes")
    lines = pixels[: height * message.step].reshape(height, message.step)[:, : width * depth]
    return lines.reshape(height, width, depth)[:, :, _ORDERS[message.encoding]]


def _decompressed(data: bytes) -> npt.NDArray[np.uint8]:
    try:
        from PIL import Image
    except ImportError as error:
        raise missing("Pillow", "gelsight", "a topic of compressed pictures", cause=error) from error
    # What sensors send: decoders of other formats start programs, or were not made for files from elsewhere.
    with Image.open(BytesIO(data), formats=("JPEG", "PNG")) as picture:
        if picture.width * picture.height > _PIXELS:
            raise RecordingError(f"a picture of {picture.width} × {picture.height} pixels; expected at most {_PIXELS}")
        return np.asarray(picture.convert("RGB"))


# The clocks and counters of messages: the device's, a header's, when a message was sent, when it was logged.

CLOCKS = ("device", "header", "publish", "log")
"""The clocks of a message, the one to prefer first."""

_Times = npt.NDArray[np.float64]

# What drivers call their device's own clock and count, beside the numbers or at the top of the message.
_DEVICE = ("tus", "time_us", "timestamp_us", "device_time", "device_timestamp", "hw_timestamp", "timestamp", "time")
_COUNTER = ("message", "seq", "sequence", "counter", "frame_index", "packet_id")
_UNITS = {"us": 1e-6, "ns": 1e-9, "ms": 1e-3}


class Stamps:
    """Collects the clocks and counters of messages, for one block after the other."""

    def __init__(self, clock: str | None, field: str) -> None:
        self.clock = clock
        self.field = field
        self.device: tuple[str, FieldPath] | None = None
        self.counter: FieldPath | None = None
        self.header = False
        self.unit: float | None = None
        self.begun = False
        self._empty()

    def _empty(self) -> None:
        self.times: dict[str, list[int]] = {name: [] for name in ("header", "publish", "log")}
        self.values: list[Any] = []
        self.counts: dict[str, list[int]] = {"message": [], "sequence": [], "all": []}

    def add(self, message: Message, decoded: Any) -> None:
        """Take the stamps of one message."""
        if not self.begun:
            self._begin(decoded)
        self.times["log"].append(message.log)
        if message.publish is not None:
            self.times["publish"].append(message.publish)
        if self.header:
            self.times["header"].append(_nanoseconds(decoded.header.stamp))
        if self.device is not None:
            self.values.append(_stamp(self.device[1], decoded))
        if self.counter is not None:
            self.counts["message"].append(int(self.counter.values(decoded)[0]))
        if message.sequence is not None:  # of the topic, or of all of them: then less the others it goes on by one
            self.counts["sequence"].append(message.sequence)
            self.counts["all"].append(message.sequence - message.others)

    def take(self) -> tuple[dict[str, _Times], dict[str, npt.NDArray[np.int64]]]:
        """The clocks in seconds and the counters since the last time, in the order of preference."""
        clocks = {}
        log = _seconds(self.times["log"])
        if self.device is not None:
            name = "device" if self.clock is None or self.clock in CLOCKS else self.clock
            values = np.array(self.values, np.float64)
            if self.unit is None:
                self.unit = _unit(self.device[0], self.values, values, log)
            clocks[name] = values * self.unit if self.unit >= 1 else values / round(1 / self.unit)
        for name, stamps in self.times.items():
            if stamps:
                clocks[name] = _seconds(stamps)
        counts = {name: np.array(values, np.int64) for name, values in self.counts.items() if values}
        self._empty()
        return clocks, counts

    def _begin(self, decoded: Any) -> None:
        self.begun = True
        stamp = getattr(getattr(decoded, "header", None), "stamp", None)
        self.header = hasattr(stamp, "sec") and hasattr(stamp, "nanosec")
        root = re.match(r"\s*\w+\[-?\d+\]\.", self.field)
        before = ["", *([root.group().strip()] if root else [])]
        if self.clock is not None and self.clock not in CLOCKS:
            path = FieldPath(self.clock)
            _stamp(path, decoded)
            self.device = (self.clock, path)
        else:
            self.device = _first(decoded, [f"{b}{name}" for b in before for name in _DEVICE])
        counter = _first(decoded, ["header.seq", *(f"{b}{name}" for b in before for name in _COUNTER)], counts=True)
        self.counter = None if counter is None else counter[1]


def _first(decoded: Any, texts: list[str], counts: bool = False) -> tuple[str, FieldPath] | None:
    """The first of some paths that leads to a stamp, or to a whole number where it `counts`."""
    names: dict[str, set[str]] = {}  # of what stands before the last dot; an error with the nearest takes long
    for text in texts:
        before, _, name = text.rpartition(".")
        if before not in names:
            names[before] = _names(decoded, before)
        if name.lower() not in names[before]:
            continue
        path = FieldPath(text)
        with suppress(FieldError):
            value = _stamp(path, decoded)
            if not counts or isinstance(value, int):
                return text, path
    return None


def _names(decoded: Any, text: str) -> set[str]:
    """The fields, in lower case, of the message that a path leads to; none where it leads to none."""
    try:
        found = FieldPath(text).values(decoded) if text else [decoded]
    except FieldError:
        return set()
    return {name.lower() for name in fields_of(found[0])} if len(found) == 1 else set()


def _stamp(path: FieldPath, decoded: Any) -> float:
    found = path.values(decoded)
    value = found[0] if len(found) == 1 else None
    if hasattr(value, "sec") and hasattr(value, "nanosec"):
        return _nanoseconds(value) / 1e9
    if isinstance(value, np.integer | np.floating):
        value = value.item()
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FieldError(f"clock {path.text!r} leads to {type(value).__name__}; expected a time, or a number of one")
    return value


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _seconds(stamps: list[int]) -> _Times:
    # Whole seconds and their rest each round once; the quotient of nanoseconds as a double would round twice.
    whole = np.array([stamp // 10**9 for stamp in stamps], np.float64)
    return whole + np.array([stamp % 10**9 for stamp in stamps], np.float64) / 1e9


def _unit(text: str, values: list[Any], times: _Times, log: _Times) -> float:
    """Seconds in one step of a device's clock: from its name, or the power of 1000 that fits the time it was logged."""
    name = re.split(r"[.\]]", text)[-1]
    if name[-2:] in _UNITS:
        return _UNITS[name[-2:]]
    if any(isinstance(value, float) for value in values):
        return 1.0
    span, logged = float(np.ptp(times)), float(np.ptp(log))
    if span <= 0 or logged <= 0:
        return 1.0
    return float(10.0 ** (-3 * np.clip(np.round(np.log10(span / logged) / 3), 0, 3)))

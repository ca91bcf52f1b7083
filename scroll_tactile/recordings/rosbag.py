"""ROS recordings as a source: which files make one, what their messages are, and the numbers in them."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import FieldError, RecordingError
from scroll_tactile.libraries import optional
from scroll_tactile.recordings import presets
from scroll_tactile.recordings.bagfiles import ZSTD, Channel, Message, Scan, inflated
from scroll_tactile.recordings.blocks import Block, Contents, Entry, Request, Source, floats, rows_of
from scroll_tactile.recordings.bounds import read_text, require_inside, stored_bytes
from scroll_tactile.recordings.decoding import MessageTypes
from scroll_tactile.recordings.paths import FieldPath, fields_of, nearest

__all__ = ["SUFFIXES", "RosBag", "is_rosbag", "picture"]

SUFFIXES = (".bag", ".mcap", ".db3")
"""What ROS's recordings end in."""

_LOOKED = 2000  # messages are looked at to say what a bag holds
_TRIED = 10  # messages of a topic are decoded for it: the first may have empty arrays, or be damaged
_LONGEST = 1 << 20  # bytes of metadata.yaml

_PIXELS = 1 << 24  # of a compressed picture: 4096 × 4096, where the largest camera of a gel has 1600 × 1200


def is_rosbag(path: Path) -> bool:
    """Whether this is a recording of ROS: one of its files, or a folder of them."""
    return (path / "metadata.yaml").exists() or bool(_parts(path)) if path.is_dir() else _is_file(path)


def _parts(folder: Path) -> list[Path]:
    """The parts of one recording in their order: files whose names differ in a last number alone; otherwise none."""

    def order(file: Path) -> list[Any]:
        return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", file.name)]

    files = sorted((inside for inside in folder.iterdir() if _is_file(inside)), key=order)
    return files if len({re.sub(r"\d+(?=\.|$)", "", file.name, count=1) for file in files}) == 1 else []


def _is_file(path: Path) -> bool:
    return path.name.lower().removesuffix(".zstd").removesuffix(".active").endswith(SUFFIXES)


class RosBag(Source):
    """A ROS 1 or ROS 2 recording: one file, or a folder of the parts that it was split into; see `Source`."""

    topics = labels = True

    def __init__(self, path: Path, address: str, request: Request) -> None:
        super().__init__(path, address, request)
        self.files = _files(path) if path.is_dir() else [path]
        self.types = MessageTypes(request.definitions)
        self.odd: list[str] = []  # what was found before reading
        for file in self.files:
            self.stored += stored_bytes(file)

    def contents(self) -> Contents:
        """The numbers in the first messages of each topic, those of known sensors first."""
        entries, count = self._entries(None)
        looked = f"in its first {count} messages, among others perhaps" if count == _LOOKED else ""
        return Contents(self.address, tuple(entries), looked, tuple(self.notes))

    def _entries(self, path: FieldPath | None) -> tuple[list[Entry], int]:
        """Where numbers are in the first messages, or where a path leads to some; and how many messages were seen.

        Where it leads to none, further messages are looked at: a topic may begin late.
        """
        logs: dict[Channel, list[int]] = {}
        found: dict[Channel, dict[str, tuple[int, ...]]] = {}
        failed: dict[Channel, int] = {}
        count = 0
        for message in self._messages(lambda topic: True):
            if count >= _LOOKED and (path is None or any(found.values())):
                break
            count, channel = count + 1, message.channel
            logs.setdefault(channel, []).append(message.log)
            fields = found.setdefault(channel, {})
            if failed.get(channel, 0) >= _TRIED or (fields and (path is not None or len(logs[channel]) > _TRIED)):
                continue
            try:
                decoded = self.types.decode(channel, message.data)
                if path is not None:
                    shapes = [(path.text, path.reading(decoded).shape)]
                else:
                    shapes = [*presets.fields_for(channel.type, decoded), *_numbers(decoded)]
                for text, shape in shapes:
                    fields |= {text: shape} if text not in fields and shape != (0,) else {}
            except RecordingError as error:
                failed[channel] = failed.get(channel, 0) + 1
                if not isinstance(error, FieldError) and str(error) not in self.notes:
                    self.notes.append(str(error))
        entries = [
            Entry(channel.topic, text, shape, len(logs[channel]), _rate(logs[channel]), channel.type)
            for channel, fields in found.items()
            for text, shape in fields.items()
        ]
        return sorted(entries, key=lambda entry: not presets.is_known(entry.kind)), count

    def blocks(self) -> Iterator[Block]:
        """The readings of the requested topic; raises FieldError, with what there is, for one that is not there."""
        topic, text = self._choose()
        self.topic = topic
        path, stamps = FieldPath(text), Stamps(self.request.clock, text, self.notes)
        rows: list[npt.NDArray[Any]] = []
        width: int | None = None
        most, empty = 1, 0
        for message, decoded in self._decoded(topic):
            row = _reading(path, decoded)
            if not row.size:
                empty += 1
                continue
            if width is None:
                width, most = row.size, rows_of(max(row.nbytes, 4 * row.size))
            if row.size != width:
                raise self._ragged(topic, path)
            rows.append(row)
            stamps.add(message, decoded)
            if len(rows) >= most:
                yield Block(floats(np.stack(rows)), *stamps.take())
                rows = []
        if empty and width is None:
            raise FieldError(f"field {text!r} of topic {topic!r} holds no value: its array is empty in each message")
        if empty:
            self.notes.append(f"{empty} messages have an empty array in {text!r}, and were left out")
        if rows:
            yield Block(floats(np.stack(rows)), *stamps.take())
        if width is None:
            self._absent(topic)
        if self.request.labels is not None and not self.marks:
            self._absent(self.request.labels)

    def _ragged(self, topic: str, path: FieldPath) -> RecordingError:
        """The error of readings that differ in size, with a field that each message has where there is such a one."""
        counts: dict[int, int] = {}
        samples: dict[int, Any] = {}
        for _, decoded in self._decoded(topic):
            size = _reading(path, decoded).size
            counts[size], samples[size] = counts.get(size, 0) + 1, decoded
        samples.pop(0, None)
        least, cure = min(samples), ""
        shorter = re.sub(r"\[(\d*):\d*\]$", lambda m: f"[{m[1] or 0}:{int(m[1] or 0) + least}]", path.text)
        some = (path.text.replace("[*]", f"[0:{least // of}]", 1) for of in range(1, least + 1))
        for text in (shorter, f"{path.text}[0:{least}]", *some):
            with suppress(FieldError):
                if not cure and len({FieldPath(text).reading(sample).size for sample in samples.values()}) == 1:
                    cure = f". Name elements that each of them has, as in field={text!r}"
        sizes = ", ".join(f"{counts[size]} have {size} values" for size in sorted(samples))
        return RecordingError(
            f"{self.address}: readings are ragged: of {topic!r} in {path.text!r} {sizes}{cure}", argument="field"
        )

    def _decoded(self, topic: str) -> Iterator[tuple[Message, Any]]:
        """The messages of a topic as objects; those of the topic that labels go to `marks`."""
        labels = self.request.labels
        unfit, fit = 0, 0
        why: RecordingError | None = None
        for message in self._messages(lambda name: name in (topic, labels)):
            try:
                decoded = self.types.decode(message.channel, message.data)
            except RecordingError as error:
                unfit, why = unfit + 1, error
                if not fit and unfit >= _TRIED:  # of another type, and not damaged
                    break
                continue
            fit += 1
            if message.channel.topic == labels:
                self.marks.append((message.log / 1e9, _text_in(decoded, message.channel)))
            if message.channel.topic == topic:
                yield message, decoded
        if why is not None and not fit:
            raise why
        if unfit:
            self.notes.append(f"{unfit} messages do not fit their type, and were left out")

    def _choose(self) -> tuple[str, str]:
        """The topic and the field, where the request or a preset names them, or where there is only one."""
        topic, text = self.request.topic, self.request.field
        if topic is not None and text is not None:
            return topic, text
        what = "expected a topic and a field to read"
        entries: list[Entry] = []
        if text is not None:
            entries, _ = self._entries(FieldPath(text))
            topics = {entry.topic for entry in entries}
            if len(topics) == 1 or self.request.likely in topics:
                topic = self.request.likely if len(topics) > 1 else entries[0].topic
                self.odd = [f"{other} has such readings, too" for other in sorted(map(str, topics - {topic}))]
                return str(topic), text
            what = f"{'several topics have' if topics else 'no topic has'} a field {text!r}"
        contents = self.contents()
        entries = entries or [entry for entry in contents.entries if topic in (None, entry.topic)]
        if not entries:
            self._absent(topic)
        raise replace(contents, entries=tuple(entries)).refused(what)

    def _absent(self, topic: str | None) -> NoReturn:
        problems = "; ".join(self.notes)
        messages = itertools.islice(self._messages(lambda name: True), _LOOKED)
        topics = dict.fromkeys(message.channel.topic for message in messages)
        if not topics:
            problems = "; ".join(self.notes)
            raise RecordingError(f"{self.address} holds no message" + (f": {problems}" if problems else ""))
        if topic is None or topic in topics:
            where = ", ".join(topics) if topic is None else topic
            why = problems or "its arrays are empty, or it has none"
            raise RecordingError(f"{self.address} has no numbers in {where}: {why}", argument="definitions")
        raise FieldError(f"{self.address} holds no message of topic {topic!r}{nearest(str(topic), list(topics))}")

    def _messages(self, wanted: Callable[[str], bool]) -> Iterator[Message]:
        self.notes[:] = self.odd
        self.marks.clear()
        self.cut_off = False
        for file in self.files:
            scan = Scan(file, wanted)
            for message in scan.messages():
                alone = message.data[:4] == ZSTD and message.channel.encoding == "cdr"  # compressed by itself
                yield message._replace(data=inflated(message.data, scan.room)) if alone else message
            if scan.cut_off is not None:
                self.cut_off = True
                self.notes.append(f"{file.name} was cut off: {scan.cut_off}; what comes before was read")
            if scan.damaged:
                self.notes.append(f"{file.name} has {scan.damaged} damaged chunks, which were left out")


def _files(folder: Path) -> list[Path]:
    """The files of a recording in their order: those that it lists, or those that are there."""
    there = files = _parts(folder)
    listed = folder / "metadata.yaml"
    if listed.exists():
        with optional("rosbags", "ros", "a ROS recording"):
            from ruamel.yaml import YAML  # comes with rosbags
        about = YAML(typ="safe").load(read_text(folder, listed, _LONGEST))
        if about is None:
            raise RecordingError(f"{listed} is empty, as after a power cut: remove it, and the parts there are read")
        names = about["rosbag2_bagfile_information"]["relative_file_paths"]
        files = [folder / Path(name).name for name in names if isinstance(name, str)]
    if absent := [file.name for file in files if not file.exists()]:
        raise RecordingError(
            f"{listed} lists {', '.join(absent)}, which are not there: copy them, or read the parts that are there, "
            f"{', '.join(p.name for p in there) or 'none'}, one by one"
        )
    for file in files:
        require_inside(folder, file)
    return files


def _reading(path: FieldPath, message: Any) -> npt.NDArray[Any]:
    """The pixels of a picture, or else the numbers that a path leads to; none of a driver that was not ready."""
    pixels = picture(message) if path.text == "data" else None
    return path.reading(message) if pixels is None else pixels


def _rate(logs: list[int]) -> float | None:
    steps = np.diff(np.sort(np.array(logs, np.int64)))
    middle = float(np.median(steps)) if len(steps) else 0.0
    return 1e9 / middle if middle > 0 else None


def _value(message: Any, name: str) -> Any:
    return message.get(name) if isinstance(message, Mapping) else getattr(message, name, None)


def _numbers(message: object, before: str = "", depth: int = 0) -> Iterator[tuple[str, tuple[int, ...]]]:
    """The paths to numbers in a message, and the shapes of what they lead to, arrays first."""
    scalars = []
    for name in fields_of(message):
        value, text = _value(message, name), f"{before}{name}"
        if (array := _array(value)) is not None:
            yield text, array.shape
        elif isinstance(value, list) and value and fields_of(value[0]) and depth < 4:
            for path, shape in _numbers(value[0], f"{text}[*].", depth + 1):
                yield path, (len(value), *shape)
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
    texts = {name: _value(message, name) for name in fields_of(message)}
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
    with optional("Pillow", "gelsight", "a topic of compressed pictures"):
        from PIL import Image
    # What sensors send: decoders of other formats start programs, or were not made for files from elsewhere.
    with Image.open(BytesIO(data), formats=("JPEG", "PNG")) as picture:
        if picture.width * picture.height > _PIXELS:
            raise RecordingError(f"a picture of {picture.width} × {picture.height} pixels; expected at most {_PIXELS}")
        return np.asarray(picture.convert("RGB"))


# The clocks and counters of messages: the device's, a header's, when a message was sent, when it was logged.

_Times = npt.NDArray[np.float64]

CLOCKS = ("device", "header", "publish", "log")
"""The clocks of a message, the one to prefer first."""

# What drivers call their device's own clock and count, beside the numbers or at the top of the message.
_DEVICE = ("tus", "time_us", "timestamp_us", "device_time", "device_timestamp", "hw_timestamp", "timestamp", "time")
_COUNTER = ("message", "seq", "sequence", "counter", "frame_index", "packet_id")
_UNITS = {"us": 1e-6, "ns": 1e-9, "ms": 1e-3}


class Stamps:
    """Collects the clocks and counters of messages, for one block after the other; says in `notes` what is odd."""

    def __init__(self, clock: str | None, field: str, notes: list[str]) -> None:
        self.clock, self.field, self.notes = clock, field, notes
        self.device = ""  # the path to its clock
        self.clocks: dict[str, Callable[[Message, Any], Any]] = {}
        self.counters: dict[str, Callable[[Message, Any], int]] = {}
        self.values: dict[str, list[Any]] = {}
        self.unit: float | None = None
        self.coarse: list[str] | None = None
        self.last, self.turns = 0.0, 0  # of the device's clock, and how often it has turned over

    def add(self, message: Message, decoded: Any) -> None:
        """Take the stamps of one message."""
        if not self.clocks:
            self._begin(message, decoded)
        for name, stamp in self.clocks.items():
            self.values[name].append(stamp(message, decoded))
        for name, count in self.counters.items():
            self.values[name].append(count(message, decoded))

    def take(self) -> tuple[dict[str, _Times], dict[str, npt.NDArray[np.int64]]]:
        """The clocks in seconds and the counters since the last time, in the order of preference."""
        clocks = {}
        for name in self.clocks:
            if name in CLOCKS[1:]:
                clocks[name] = _seconds(self.values[name])
                continue
            values = self._turned(self.values[name])
            if self.unit is None:
                self.unit = _unit(self.device, self.values[name], values, _seconds(self.values["log"]))
            clocks[name] = values * self.unit if self.unit >= 1 else values / round(1 / self.unit)
        if self.coarse is None:
            self.coarse = [name for name in ("device", "header") if name != self.clock and _is_coarse(clocks.get(name))]
            self.notes += [f"the {name}'s stamps are whole seconds: times are another clock's" for name in self.coarse]
        for name in self.coarse:
            del clocks[name]
        counts = {name: np.array(self.values[name], np.int64) for name in self.counters}
        self.values = {name: [] for name in self.values}
        return clocks, counts

    def _begin(self, message: Message, decoded: Any) -> None:
        root = re.match(r"\s*\w+\[-?\d+\]\.", self.field)
        before = ["", *([root.group().strip()] if root else [])]
        if self.clock is not None and self.clock not in CLOCKS:
            path: FieldPath | None = FieldPath(self.clock)
        else:
            path = _first_of(decoded, [f"{b}{name}" for b in before for name in _DEVICE])
        if (device := path) is not None:
            name = "device" if self.clock in (None, *CLOCKS) else str(self.clock)
            self.device, self.clocks[name] = device.text, lambda _, decoded: _stamp(device, decoded)
        header = _json_header if isinstance(decoded, Mapping) else attrgetter("header.stamp")
        with suppress(AttributeError, KeyError, TypeError):
            if _nanoseconds(header(decoded)) is not None:
                self.clocks["header"] = lambda _, decoded: _nanoseconds(header(decoded))
        if message.publish is not None:
            self.clocks["publish"] = lambda message, _: message.publish
        self.clocks["log"] = lambda message, _: message.log
        paths = ["header.seq", *(f"{b}{name}" for b in before for name in _COUNTER)]
        if (counter := _first_of(decoded, paths, counts=True)) is not None:
            self.counters["message"] = lambda _, decoded: int(counter.values(decoded)[0])
        if message.sequence is not None:  # of the topic, or of all of them: then less the others it goes on by one
            self.counters["sequence"] = lambda message, _: message.sequence or 0
            self.counters["all"] = lambda message, _: (message.sequence or 0) - message.others
        self.values = {name: [] for name in (*self.clocks, *self.counters)}

    def _turned(self, values: list[Any]) -> _Times:
        """A device's clock that goes on where it turns over, as one of 16 bits does after a minute of milliseconds."""
        times = np.array(values, np.float64)
        bits = 16 if times.max() < 2**16 else 32
        if times.max() < 2**bits and all(isinstance(value, int) for value in values):
            steps = np.diff(times, prepend=self.last if self.turns or self.last else times[0])
            usual = np.median(steps[steps > 0]) if (steps > 0).any() else 0
            turns = self.turns + np.cumsum((steps < 0) & (steps + 2**bits <= 5 * usual))
            self.last, self.turns = times[-1], turns[-1]
            times = times + turns * 2.0**bits
        return times


def _json_header(decoded: Any) -> Any:
    return decoded["header"]["stamp"]


def _first_of(decoded: Any, texts: list[str], counts: bool = False) -> FieldPath | None:
    """The first of some paths that leads to a stamp, or to a whole number where it `counts`."""
    for text in texts:
        path = FieldPath(text)
        with suppress(FieldError):
            value = _stamp(path, decoded)
            if not counts or isinstance(value, int):
                return path
    return None


def _stamp(path: FieldPath, decoded: Any) -> float:
    found = path.values(decoded)
    value = found[0] if len(found) == 1 else None
    if not isinstance(value, int | float) and (stamp := _nanoseconds(value)) is not None:
        return stamp / 1e9
    if isinstance(value, np.integer | np.floating):
        value = value.item()
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FieldError(f"clock {path.text!r} leads to {type(value).__name__}; expected a time, or a number of one")
    return value


def _nanoseconds(stamp: Any) -> int | None:
    """A time as ROS has it, or ROS's JSON; None for anything else."""
    try:
        return int(stamp.sec) * 10**9 + int(stamp.nanosec)
    except AttributeError:
        parts = [stamp.get(name) for name in ("sec", "nanosec", "nsec")] if isinstance(stamp, Mapping) else []
        numbers = [part for part in parts if isinstance(part, int)]
        return numbers[0] * 10**9 + numbers[1] if len(numbers) == 2 else None


def _seconds(stamps: list[int]) -> _Times:
    # Whole seconds and their rest each round once; the quotient of nanoseconds as a double would round twice.
    whole = np.array([stamp // 10**9 for stamp in stamps], np.float64)
    return whole + np.array([stamp % 10**9 for stamp in stamps], np.float64) / 1e9


def _is_coarse(times: _Times | None) -> bool:
    """Whether times are whole seconds, of which most readings have the one of the reading before them."""
    if times is None or not times.any() or (times % 1).any():
        return False
    return bool(2 * np.count_nonzero(np.diff(times) == 0) > len(times))


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

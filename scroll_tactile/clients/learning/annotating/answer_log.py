"""What a live session says, as channels of an MCAP file, which Foxglove and Rerun open beside the robot's own."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Self

from scroll_tactile.errors import InputError
from scroll_tactile.libraries import missing
from scroll_tactile.live.answers import LiveState, LiveTouch
from scroll_tactile.results import Estimate, Prediction

__all__ = ["SCHEMAS", "AnswerLog"]

DRAFT = "https://json-schema.org/draft/2020-12/schema"
CHUNK = 1 << 16  # bytes, of which compression makes a tenth
SECONDS = 1.0  # of the session, after which a chunk is written: so much a crash costs
LATEST = 2**63 - 1  # nanoseconds

# One type for each property, and none that is null: what there is nothing of is left out, so that every viewer plots.
_NUMBER, _TEXT, _SHARE = {"type": "number"}, {"type": "string"}, {"type": "number", "minimum": 0, "maximum": 1}
_SECONDS = {"type": "number", "minimum": 0, "description": "since the touch began"}
_ANSWER = {
    "material": {"type": "string", "description": "the likeliest; the nearest where it is not known"},
    "probability": _SHARE,
    "known": {"type": "integer", "enum": [1, 0, -1], "description": "learned, never observed, cannot be told"},
}
_ESTIMATE = {
    "type": "object",
    "properties": {"name": _TEXT, "unit": _TEXT, "value": _NUMBER, "low": _NUMBER, "high": _NUMBER},
    "required": ["name", "unit", "value", "low", "high"],
    "additionalProperties": False,
}


def _schema(title: str, properties: dict[str, Any], optional: tuple[str, ...] = ()) -> dict[str, Any]:
    required = [name for name in properties if name not in optional]
    about = {"$schema": DRAFT, "title": title, "type": "object", "properties": properties, "required": required}
    return about | {"additionalProperties": False}


SCHEMAS: dict[str, dict[str, Any]] = {
    "/touch/contact": _schema("touch.Contact", {"contact": {"type": "boolean"}, "seconds": _SECONDS}),
    "/touch/state": _schema(
        "touch.State",
        {"contact": {"type": "boolean"}, "seconds": _SECONDS, "decided": {"type": "boolean"}, **_ANSWER},
        tuple(_ANSWER),
    ),
    "/touch/answer": _schema(
        "touch.Answer",
        {
            **_ANSWER,
            "novelty": {"type": "number", "description": "in deviations of held-out touches; none where infinite"},
            "seconds": _SECONDS,
            "decided": {"type": "boolean"},
            "ended": {"type": "boolean", "description": "whether this is the answer to a whole touch"},
            "end": {"type": "string", "description": "why it ended"},
            "unusual": {"type": "array", "items": {"type": "string"}},
            "estimates": {"type": "array", "items": _ESTIMATE},
        },
        ("novelty", "end"),
    ),
}
"""Topic → the JSON schema, of draft 2020-12, of its messages."""


class AnswerLog:
    """The states of a live session in an MCAP file, to be looked at beside the robot's own.

    `/touch/contact` has a message where it changes, `/touch/answer` where there is a new one, or it is decided, or a
    touch has ended, and `/touch/state` each time; see `SCHEMAS`.

    path: a new file. Its chunks hold a second at most: a process that is killed leaves all before that to be read.

    >>> log = AnswerLog("answers.mcap")                      # doctest: +SKIP
    >>> log.note(session.push(reading, time), time)          # doctest: +SKIP

    Raises InputError for a path where something is, or that cannot be written; MissingLibraryError without the package
    mcap.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        try:
            from mcap.writer import CompressionType, Writer
        except ImportError as error:
            raise missing("mcap", "mcap", "writing an MCAP file", cause=error) from error
        self.path = os.fspath(path)
        with _writing(self.path):
            try:
                self._file = open(self.path, "xb")  # noqa: PTH123, SIM115  # closed by close()
            except FileExistsError:
                raise InputError(f"{self.path} is there already: give a new file, nothing is written over") from None
            self._writer: Any = Writer(self._file, chunk_size=CHUNK, compression=CompressionType.ZSTD)
            self._writer.start(profile="", library="scroll-tactile")
        self._channels = {topic: self._channel(topic, schema) for topic, schema in SCHEMAS.items()}
        self._counts = dict.fromkeys(SCHEMAS, 0)
        self._before, self._since = LiveState(), -math.inf

    def _channel(self, topic: str, schema: dict[str, Any]) -> int:
        text = json.dumps(schema).encode()
        number = self._writer.register_schema(name=schema["title"], encoding="jsonschema", data=text)
        return int(self._writer.register_channel(topic=topic, message_encoding="json", schema_id=number))

    def note(self, state: LiveState, time: float) -> None:
        """Write what a session says after a push, at this time in seconds: since 1970, or by the recording's clock.

        Raises InputError for a time before 0, and where the file cannot be written.
        """
        if self._file.closed:
            raise InputError(f"{self.path} is closed: begin another log")
        at = round(time * 1e9) if math.isfinite(time) else -1
        if not 0 <= at <= LATEST:
            raise InputError(f"expected a time in seconds, of 0 or more; came {time!r}: MCAP has no other")
        before, self._before = self._before, state
        with _writing(self.path):
            for touch in state.touches:
                self._write("/touch/answer", _ended(touch), at)
            if state.contact != before.contact or (state.contact and state.touches):
                self._write("/touch/contact", {"contact": state.contact, "seconds": state.seconds}, at)
            new = state.prediction is not before.prediction or state.decided != before.decided
            if state.contact and state.prediction is not None and (new or not before.contact):
                said = {"seconds": state.seconds, "decided": state.decided, "ended": False}
                more = _more(state.prediction, state.estimates)
                self._write("/touch/answer", _answer(state.prediction) | said | more, at)
            own = {} if state.prediction is None else _answer(state.prediction)
            of = {"contact": state.contact, "seconds": state.seconds, "decided": state.decided}
            self._write("/touch/state", of | own, at)
            if not self._since <= time < self._since + SECONDS:
                self._since = time
                self._writer.flush()

    def _write(self, topic: str, message: dict[str, Any], at: int) -> None:
        self._counts[topic] += 1
        data = json.dumps(message, allow_nan=False).encode()
        self._writer.add_message(self._channels[topic], at, data, at, self._counts[topic])

    def close(self) -> None:
        """Write the end of the file, with its index; a second call does nothing. Raises InputError as `note` does."""
        if not self._file.closed:
            with _writing(self.path), self._file:
                self._writer.finish()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _answer(prediction: Prediction) -> dict[str, Any]:
    if prediction.material is None:
        return {"material": "", "probability": 0.0, "known": 0}
    known = -1 if prediction.known is None else int(prediction.known)
    return {"material": prediction.material, "probability": prediction.probability, "known": known}


def _more(prediction: Prediction, estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    measured = [
        {"name": name, "unit": one.unit, "value": one.value, "low": one.low, "high": one.high}
        for name, one in estimates.items()
        if one.value is not None
    ]
    novelty = {"novelty": prediction.novelty} if math.isfinite(prediction.novelty) else {}
    return {**novelty, "unusual": list(prediction.unusual), "estimates": measured}


def _ended(touch: LiveTouch) -> dict[str, Any]:
    said = {"seconds": touch.stream.seconds, "decided": touch.decided, "ended": True, "end": touch.end}
    return _answer(touch.prediction) | said | _more(touch.prediction, touch.estimates)


@contextmanager
def _writing(path: str) -> Iterator[None]:
    """Errors of the system become those of the file that is written."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"{path} cannot be written: {error.strerror}. What is in it can be read; make room, or take another file"
        ) from error

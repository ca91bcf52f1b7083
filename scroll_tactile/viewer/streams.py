"""Streams of Rerun: where they go, how they are laid out, and how what has a name is written there."""

from __future__ import annotations

import importlib
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from scroll_tactile.errors import InputError, printable
from scroll_tactile.libraries import optional
from scroll_tactile.results import Prediction

__all__ = ["APPLICATION", "VIEWER", "Colours", "entity", "in_words", "layout", "rerun", "stream_to"]

APPLICATION = "scroll-tactile"
VIEWER = "viewer"  # what names the one that runs on this machine
ADDRESS = "rerun+http://127.0.0.1:9876/proxy"
View = tuple[str, str, str]  # its kind, its name, and the path of what it shows; of kind "Share" lines from 0 to 1
ANSWERS_WITHIN = 2.0  # seconds: a viewer that is there takes milliseconds
TAKEN_WITHIN = 10.0  # seconds, of what was written and is still under way
HELLO = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + b"\0\0\0\4\0\0\0\0\0"  # of HTTP/2 (RFC 9113, 3.4): no settings
SETTINGS = 4  # the kind of the frame that answers it


# Light enough for a dark viewer, dark enough for a light one; neighbours in the list are far from each other.
COLOURS = (
    *((70, 150, 255), (255, 140, 40), (60, 190, 100), (235, 80, 95), (160, 115, 250)),
    *((215, 180, 30), (30, 190, 200), (240, 115, 200), (165, 125, 85), (140, 155, 170)),
)


class Colours:
    """A colour for each name, in the order in which they come: Rerun's own, by the path, are often alike."""

    def __init__(self) -> None:
        self._places: dict[str, int] = {}

    def of(self, name: str) -> tuple[int, int, int]:
        """Red, green and blue, 0 to 255; the same for the same name, and after as many names as there are again."""
        return COLOURS[self._places.setdefault(name, len(self._places)) % len(COLOURS)]


def rerun() -> Any:
    """The SDK, which takes a second to import. Raises MissingLibraryError where it is not installed."""
    with optional("rerun-sdk", "rerun", "showing it in Rerun"):
        return importlib.import_module("rerun")


def entity(*parts: str) -> str:
    """The path of what is called by these parts; "" is left out, and what does not print is escaped."""
    escape = rerun().escape_entity_path_part
    return "/".join(escape(printable(part)) for part in parts if part)


@contextmanager
def stream_to(target: str) -> Iterator[Any]:
    """A stream of Rerun to a viewer or into a file, closed in the end.

    target: "viewer", the one on this machine; the address of another, such as rerun+http://robot:9876/proxy; or a new
    file that ends with .rrd. Raises InputError for anything else, for a viewer that does not answer or goes away
    meanwhile and for a file that is there; MissingLibraryError.
    """
    stream = rerun().RecordingStream(APPLICATION)
    if target == VIEWER or target.startswith(("rerun://", "rerun+http://", "rerun+https://")):
        _connect(stream, ADDRESS if target == VIEWER else target)
    elif target.endswith(".rrd"):
        if Path(target).exists() or not Path(target).parent.is_dir():
            why = "is there already" if Path(target).exists() else "has no folder"
            raise InputError(f"expected a new file to write for Rerun; {target} {why}: give another")
        stream.save(target)
    else:
        raise InputError(f"expected 'viewer', the address of one, or a file that ends with .rrd; came {target!r:.80}")
    try:
        yield stream
    except BaseException:
        with suppress(InputError):
            _finish(stream, target)
        raise
    _finish(stream, target)


def _connect(stream: Any, address: str) -> None:
    """To a viewer. Raises InputError for an address that is none, and where none answers."""
    _require_viewer(address)
    try:
        stream.connect_grpc(address)
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"expected the address of a viewer, such as rerun+http://robot:9876/proxy, with /proxy at its end; came "
            f"{address!r:.80} ({error})"
        ) from None


def _finish(stream: Any, target: str) -> None:
    """Have all that was written taken, and close. Raises InputError where a viewer, or a disk, takes no more."""
    try:
        stream.flush(timeout_sec=TAKEN_WITHIN)
        stream.disconnect()
    except (RuntimeError, ValueError) as error:
        rerun().unregister_shutdown()  # which would wait without end for what cannot be sent
        what = "its disk may be full" if target.endswith(".rrd") else "the viewer went away, or stands still"
        raise InputError(
            f"expected {target} to take all that was to be shown; {what} ({error}): start it again"
        ) from None


def _require_viewer(address: str) -> None:
    """Raise InputError where none answers: the SDK tries for ever, and says so nowhere. One that is reached through TLS
    is not asked."""
    try:
        parts = urlsplit(address)
        place = parts.hostname or "127.0.0.1", parts.port or 9876
        with socket.create_connection(place, timeout=ANSWERS_WITHIN) as asked:
            if parts.scheme == "rerun+http":
                asked.sendall(HELLO)
                answer = asked.recv(9)
                if answer[3:4] != bytes([SETTINGS]):
                    raise OSError("what listens there is none")
    except (OSError, ValueError) as error:
        raise InputError(
            f"no viewer answers at {address} ({error}): start `rerun` there first, or give a file that ends with .rrd"
        ) from None


def layout(prefix: str, left: Sequence[View], right: Sequence[View], time: str) -> Any:
    """A blueprint of two columns. prefix: of all entities. time: the timeline that it begins with."""
    rrb = importlib.import_module("rerun.blueprint")
    more: dict[str, dict[str, Any]] = {
        "Tensor": {"view_fit": "fill"},
        "Share": {"axis_y": rrb.ScalarAxis(range=(-0.03, 1.03))},
    }

    def column(views: Sequence[View]) -> Any:
        made = []
        for kind, name, path in views:
            view = getattr(rrb, "TimeSeriesView" if kind == "Share" else f"{kind}View")
            made.append(view(origin=f"/{prefix}/{path}" if prefix else f"/{path}", name=name, **more.get(kind, {})))
        return rrb.Vertical(*made)

    panels = rrb.BlueprintPanel(expanded=False), rrb.SelectionPanel(expanded=False), rrb.TimePanel(timeline=time)
    return rrb.Blueprint(rrb.Horizontal(column(left), column(right)), *panels)


def in_words(prediction: Prediction) -> str:
    """A prediction as a line of text."""
    if prediction.material is None:
        return "nothing was learned yet"
    name = printable(prediction.material)
    more = ", ".join((f"novelty {prediction.novelty:.1f}", *prediction.unusual))
    if prediction.known is False:
        return f"never felt this; nearest is {name} ({more})"
    doubt = "" if prediction.known else ", if it was ever felt"
    return f"{name}, {prediction.probability:.1%}{doubt} ({more})"

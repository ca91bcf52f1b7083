"""Streams of Rerun: where they go, how they are laid out, and how what has a name is written there."""

from __future__ import annotations

import importlib
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from scroll_tactile.errors import InputError, printable
from scroll_tactile.libraries import optional
from scroll_tactile.results import Prediction

__all__ = ["APPLICATION", "VIEWER", "entity", "in_words", "layout", "rerun", "stream_to"]

APPLICATION = "scroll-tactile"
VIEWER = "viewer"  # what names the one that runs on this machine
ADDRESS = "rerun+http://127.0.0.1:9876/proxy"
View = tuple[str, str, str]  # its kind, its name, and the path of what it shows; of kind "Share" lines from 0 to 1
ANSWERS_WITHIN = 2.0  # seconds: a viewer that is there takes milliseconds


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
    file that ends with .rrd. Raises InputError for anything else, for a viewer that does not answer and for a file that
    is there; MissingLibraryError.
    """
    stream = rerun().RecordingStream(APPLICATION)
    if target == VIEWER or target.startswith(("rerun://", "rerun+http://", "rerun+https://")):
        address = ADDRESS if target == VIEWER else target
        _require_viewer(address)
        stream.connect_grpc(address)
    elif target.endswith(".rrd"):
        if Path(target).exists() or not Path(target).parent.is_dir():
            why = "is there already" if Path(target).exists() else "has no folder"
            raise InputError(f"expected a new file to write for Rerun; {target} {why}: give another")
        stream.save(target)
    else:
        raise InputError(f"expected 'viewer', the address of one, or a file that ends with .rrd; came {target!r:.80}")
    try:
        yield stream
        stream.flush()
    finally:
        stream.disconnect()


def _require_viewer(address: str) -> None:
    """Raise InputError where nothing listens: the SDK tries for ever, and says so nowhere."""
    parts = urlsplit(address)
    try:
        place = parts.hostname or "127.0.0.1", parts.port or 9876
        socket.create_connection(place, timeout=ANSWERS_WITHIN).close()
    except (OSError, ValueError) as error:
        raise InputError(
            f"no viewer answers at {address} ({error}): start `rerun` there first, or give a file that ends with .rrd"
        ) from None


def layout(prefix: str, left: Sequence[View], right: Sequence[View], time: str) -> Any:
    """A blueprint of two columns. prefix: of all entities. time: the timeline that it begins with."""
    rrb = importlib.import_module("rerun.blueprint")
    more: dict[str, dict[str, Any]] = {
        "Tensor": {"view_fit": "fill"},
        "Share": {"axis_y": rrb.ScalarAxis(range=(0, 1))},
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

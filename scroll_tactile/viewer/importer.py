"""`rerun-importer-scroll-tactile`: the program that Rerun starts for a path that it does not know; it writes to Rerun
what the path holds.

Rerun starts every executable on PATH with this beginning for a folder and for each file in it, all at once, so what is
not ours has to be known before anything is imported. Rerun reads `.mcap` itself and asks nobody; of such a bag it is
given the folder, or

    rerun-importer-scroll-tactile bag.mcap --memory memory | rerun -
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from scroll_tactile.learner import TactileLearner

__all__ = ["INCOMPATIBLE", "MEMORY", "main"]

INCOMPATIBLE = 66  # rerun.EXTERNAL_IMPORTER_INCOMPATIBLE_EXIT_CODE, without a second of importing rerun
MEMORY = "SCROLL_TACTILE_MEMORY"  # the folder of the memory that answers, in the environment
CURRENT, BEGINNING = "CURRENT", b'{"format"'  # a file that every memory's folder has, and how it begins
DEEPEST = 8  # folders between a memory and a file in it; an array's chunks are six deep
BAGS = (".bag", ".db3", ".mcap")
FILES = (*BAGS, ".npy", ".csv", ".h5", ".hdf5", ".hdf", ".zarr.zip")
METADATA, BAG = "metadata.yaml", b"rosbag2_bagfile_information"  # of a bag of ROS 2, and what that begins with
FOLDERS = ("meta/info.json", ".zgroup", "zarr.json")  # of LeRobot, Zarr
OWN = (CURRENT, "lock", "holder.json", "checkpoints", "derived")  # what a store has in its folder, see FORMAT.md
Kind = str


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Write what a path holds to the standard output, and exit: 0; 66 for what is not ours; 1 after an error, and 2 for
    an option that there is not."""
    parser = _parser()
    chosen, others = parser.parse_known_args(arguments)  # Rerun may come to give more options than today
    if others and not (chosen.application_id or chosen.recording_id):
        parser.error(f"expected the options that --help lists; came {' '.join(others)}")
    memory = chosen.memory or os.environ.get(MEMORY) or None
    named = bool(memory or chosen.topic or chosen.field or chosen.preset)
    kind, chosen.path = _kind(chosen.path, chosen.application_id or "", named)
    if kind == "inside":
        sys.exit(0)  # shown with its memory: an error for each of its files would bury that
    if kind == "" or (kind == "readings" and not named):
        sys.exit(INCOMPATIBLE)
    sys.exit(_import(chosen, kind, memory, named))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="rerun-importer-scroll-tactile",
        allow_abbrev=False,
        description="Show a memory, or a recording of touches, in Rerun, which starts this for a path that it is to "
        "open. By hand: rerun-importer-scroll-tactile PATH | rerun -",
        epilog=f"Rerun gives no options of its user on: for those, ${MEMORY} names the memory.",
    )
    parser.add_argument("path", type=Path, help="the folder of a memory, or a recording")
    parser.add_argument("--memory", help=f"the memory that answers to a recording's touches; else ${MEMORY}")
    parser.add_argument("--topic", help="of a recording: which topic")
    parser.add_argument("--field", help="of a recording: where its numbers are")
    parser.add_argument("--preset", help="of a recording: a known sensor, in place of both")
    parser.add_argument("--application-id", help="as Rerun gives it, like the others below")
    parser.add_argument("--recording-id")
    parser.add_argument("--entity-path-prefix", default="")
    return parser


def _kind(path: Path, application: str, named: bool) -> tuple[Kind, Path]:
    """What there is to show, and where: a "memory", a "bag", which names its types, "readings", which do not; else "".

    "inside": it is a part of what is shown already, as Rerun opened the folder around it; it calls the application by
    what it opened. named: whether a memory or readings were named, without which readings are not shown.
    """
    if path.is_dir():
        return _folder(path), path
    if not path.is_file():  # neither a pipe nor a device
        return "", path
    for folder in path.absolute().parents[:DEEPEST]:
        kind = _folder(folder)
        if (kind in ("memory", "bag") or (kind and named)) and _stem(folder) == application != _stem(path):
            return "inside", folder
        if kind == "memory" and _is_own(path.absolute().relative_to(folder).parts[0]):
            return ("memory", folder) if path.name == CURRENT else ("inside", folder)
    name = path.name.lower()
    return "bag" if name.endswith(BAGS) else "readings" if name.endswith(FILES) else "", path


def _folder(path: Path) -> Kind:
    if _begins(path / CURRENT, BEGINNING):  # databases have a file of this name, too
        return "memory"
    if _begins(path / METADATA, BAG):
        return "bag"
    return "readings" if any((path / name).is_file() for name in FOLDERS) else ""


def _stem(path: Path) -> str:
    """What Rerun calls the application that it opens a path for."""
    return path.stem.replace(".", "_")


def _is_own(name: str) -> bool:
    """Whether this is the name of what a store keeps in its folder."""
    return name in OWN or name.startswith("log-") or any(end in name for end in (".damaged", ".new", ".partial"))


def _begins(place: Path, beginning: bytes) -> bool:
    """Whether this is a file that begins so."""
    try:
        if not place.is_file():
            return False
        with place.open("rb") as file:
            return file.read(len(beginning)) == beginning
    except OSError:
        return False


def _import(chosen: argparse.Namespace, kind: Kind, memory: str | None, named: bool) -> int:
    """Write it; returns the exit code. An unsound memory or recording is an error; a recording of another sensor is
    not, nor is a file of a kind that anybody has, such as a table of names, unless it was opened by hand."""
    from scroll_tactile_store import StoreError

    from scroll_tactile.errors import ChannelCountError, FieldError, RecordingError, ScrollTactileError

    try:
        if kind == "memory":
            _memory(chosen)
        else:
            _recording(chosen, memory)
    except BrokenPipeError:  # the viewer was closed
        return 1
    except (ScrollTactileError, StoreError, OSError, MemoryError) as error:
        print(f"rerun-importer-scroll-tactile: {error}", file=sys.stderr)
        others = isinstance(error, ChannelCountError | FieldError) and not (chosen.topic or chosen.field)
        if not (chosen.memory or chosen.topic or chosen.field or chosen.preset):  # the environment names the memory
            anybodys = chosen.path.is_dir() or chosen.path.suffix.lower() in (".csv", ".npy")
            others |= kind == "readings" and anybodys and isinstance(error, RecordingError)
        return INCOMPATIBLE if others or (kind == "bag" and not named) else 1
    return 0


def _memory(chosen: argparse.Namespace) -> None:
    from scroll_tactile.viewer.memory_log import log_memory

    with _opened(chosen.path) as learner, _stream(chosen) as stream:
        log_memory(stream, learner, chosen.entity_path_prefix.strip("/"))


def _recording(chosen: argparse.Namespace, memory: str | None) -> None:
    from scroll_tactile.learner import TactileLearner
    from scroll_tactile.viewer.recording_log import log_recording, read_for

    where: dict[str, Any] = {"topic": chosen.topic, "field": chosen.field, "preset": chosen.preset}
    learner = None if memory is None else TactileLearner.open(memory, mode="read")
    recording, sensor = read_for(chosen.path, None if learner is None else learner.sensor, **where)
    with learner or TactileLearner(sensor=sensor) as player, _stream(chosen) as stream:
        log_recording(stream, recording, player, chosen.entity_path_prefix.strip("/"))


def _opened(path: Path) -> TactileLearner:
    """A memory to read, whatever its embedding."""
    from scroll_tactile.learner import TactileLearner
    from scroll_tactile.memory.identity import absent_embedding

    return TactileLearner.open(path, embedding=absent_embedding(path), mode="read")


@contextmanager
def _stream(chosen: argparse.Namespace) -> Iterator[Any]:
    """A stream of Rerun on the standard output, under the names that it asked for."""
    from scroll_tactile.viewer.streams import APPLICATION, rerun

    stream = rerun().RecordingStream(chosen.application_id or APPLICATION, recording_id=chosen.recording_id)
    stream.stdout()
    yield stream
    stream.flush()
    stream.disconnect()

"""The files of a LeRobot data set, written again with columns of answers; a file that is there is whole."""

from __future__ import annotations

import errno
import itertools
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from scroll_tactile.clients.learning.annotating.frame_answers import FrameAnswers
from scroll_tactile.clients.learning.annotating.touch_columns import (
    EVENTS,
    TouchColumns,
    is_written,
    statistics_of,
    together,
)
from scroll_tactile.errors import FieldError, InputError, RecordingError
from scroll_tactile.recordings.arrays.lerobot import LeRobot
from scroll_tactile.recordings.arrays.rowgroups import codec_of, row_groups, schema_of
from scroll_tactile.recordings.bounds import read_text, require_inside, stored_bytes

__all__ = [
    "copied",
    "copy_others",
    "names_in",
    "own_files",
    "require_each_once",
    "require_metadata",
    "statistics_in",
    "wanted_statistics",
    "write_data",
    "write_metadata",
]

_LONGEST = 1 << 26  # bytes of stats.json
_PIECE = 1 << 20  # bytes that are copied at a time
_LOG = 4096  # steps of work that a log takes
_COUNTS = ("count",)  # statistics that are whole numbers, whatever they are of
_DRAFT = ".new"  # at the end of a file's name while it is written: no reader takes it for one of the set's


def names_in(source: LeRobot) -> list[str]:
    """The parquet files with frames, by their paths within the data set: those of its episodes, and what lies beside.

    Raises RecordingError where one is missing, or called as if it lay elsewhere, or the data set calls two by one name.
    """
    listed = source.files()
    paths = sorted({*listed, *(source.path / "data").glob("**/*.parquet")})
    found = [os.path.normpath(path.relative_to(source.path)) for path in paths]
    if len(set(found)) < len(found) or len(set(listed)) < len(listed):
        raise RecordingError(f"{source.address} names the same file of frames twice: expected each once")
    if climbing := [name for name in found if Path(name).parts[0] == os.pardir]:  # it would be written outside, too
        raise RecordingError(f"{source.address} names data outside its folder: {climbing[0]!r:.100}")
    return found


def require_each_once(source: LeRobot, names: Sequence[str], *, logged: bool) -> None:
    """Raises RecordingError for an episode in two places: two touches would be made of it, and one log of the two.

    logged: whether each has a log, a file of its own, which counts towards the budget: of what takes next to no room
    on the disk there could be one a frame. Raises FieldError where frames have no number of their episode.
    """
    found: set[int] = set()
    for name in names:
        last = None
        with source.opened(source.path / name, ["episode_index"]) as file:
            if "episode_index" not in file.schema_arrow.names:
                raise FieldError(f"{name} of {source.address} has no column 'episode_index'")
            if not source.types.is_integer(kind := file.schema_arrow.field("episode_index").type):
                raise FieldError(f"column 'episode_index' of {name} holds {kind}; expected whole numbers")
            for batch in file.iter_batches(columns=["episode_index"]):
                source.require_all(batch.column(0), "episode_index")
                numbers = batch.column(0).to_numpy(zero_copy_only=False).astype(np.int64)
                for number in numbers[np.diff(numbers, prepend=numbers[:1] - 1) != 0].tolist():
                    if number in found and number != last:
                        raise RecordingError(
                            f"episode {number} of {source.address} is in two places, the second in {name}: expected "
                            "its frames in one file, one after the other"
                        )
                    if number not in found:
                        source.budget.work(_LOG * logged)
                    found.add(number)
                    last = number


def require_metadata(source: LeRobot, columns: TouchColumns) -> None:
    """Raises FieldError or RecordingError for metadata that no statistics of answers can be added to."""
    wanted_statistics(source, source.column())
    for path in _tables(source, columns):
        schema = schema_of(source, path)
        kinds = [field.type for field in schema if field.name == "episode_index"]
        if any(own.startswith("stats/") for own in schema.names) and [*map(source.types.is_integer, kinds)] != [True]:
            raise FieldError(
                f"{path.relative_to(source.path)} of {source.address} has {len(kinds)} columns 'episode_index' "
                f"({', '.join(map(str, kinds))!s:.100}); expected one of whole numbers"
            )


def _tables(source: LeRobot, columns: TouchColumns) -> list[Path]:
    """The tables of episodes, to which statistics of columns of numbers are added."""
    return sorted((source.path / "meta" / "episodes").glob("**/*.parquet")) if columns.numbers else []


def write_data(
    source: LeRobot, name: str, target: Path, columns: TouchColumns, found: FrameAnswers, dropped: Sequence[str]
) -> None:
    """Write a file of frames with the answers to them, row group by row group, other columns as they are.

    dropped: columns of an earlier annotation. Raises RecordingError for a file that does not have as many frames.
    """
    from pyarrow import parquet

    path = source.path / name
    empty = _with_answers(schema_of(source, path).empty_table(), columns, found, 0, dropped, name)
    with drafted(target) as draft:
        at = 0
        with parquet.ParquetWriter(draft, empty.schema, compression=codec_of(source, path)) as writer:
            for table in row_groups(source, path):
                whole = _with_answers(table, columns, found, at, dropped, name)
                writer.write_table(whole, row_group_size=max(1, table.num_rows))
                at += table.num_rows
        if at != len(found.material):
            raise RecordingError(f"{path} has {at} frames, of which {len(found.material)} have readings")


def _with_answers(
    table: Any, columns: TouchColumns, found: FrameAnswers, begin: int, dropped: Sequence[str], name: str
) -> Any:
    """A table of the frames from `begin` on with the columns of answers behind the others."""
    end, there = begin + table.num_rows, table.schema.names
    new = columns.arrays(found, begin, end)
    if columns.language:
        new[EVENTS] = columns.events(found, begin, end, table.column(EVENTS) if EVENTS in there else None)
    if strays := [own for own in new if own in there and own not in dropped]:
        raise FieldError(f"{name} has a column {strays[0]!r}, which meta/info.json does not name: remove it first")
    table = table.drop_columns([own for own in dropped if own in there])
    for own, array in new.items():
        table = table.append_column(own, array)
    return table


def statistics_in(folder: Path, names: Sequence[str], columns: TouchColumns, wanted: Sequence[str]) -> dict[int, Any]:
    """Episode → column → statistics of the answers, as they were written.

    wanted: which statistics, by LeRobot's names.
    """
    from pyarrow import parquet

    parts: dict[int, list[dict[str, Any]]] = {}
    for name in names:
        table = parquet.ParquetFile(folder / name).read(columns=[*columns.numbers, "episode_index"])
        episodes = table.column("episode_index").to_numpy()
        arrays = {own: _numbers(table.column(own)) for own in columns.numbers}
        borders = [0, *(np.flatnonzero(np.diff(episodes)) + 1).tolist(), len(episodes)]
        for begin, end in itertools.pairwise(borders):
            if end > begin:
                own = {name: statistics_of(array[begin:end], wanted) for name, array in arrays.items()}
                parts.setdefault(int(episodes[begin]), []).append(own)
    return {
        episode: {own: together([part[own] for part in found]) if len(found) > 1 else found[0][own] for own in found[0]}
        for episode, found in parts.items()
    }


def _numbers(column: Any) -> Any:
    """A column of numbers, or of lists of as many, as an array (T, n)."""
    array = column.combine_chunks()
    flat = array.flatten() if hasattr(array.type, "value_type") else array
    return flat.to_numpy(zero_copy_only=False).reshape(len(array), -1)


def write_metadata(
    source: LeRobot, folder: Path, columns: TouchColumns, episodes: Mapping[int, Any], dropped: Sequence[str]
) -> list[str]:
    """Write the tables of episodes, the statistics and, last, info.json, with the answers in them; their paths."""
    from pyarrow import parquet

    written = []
    for path in _tables(source, columns):
        name = os.path.normpath(path.relative_to(source.path))
        schema = schema_of(source, path)
        if any(own.startswith("stats/") for own in schema.names):
            empty = _with_statistics(schema.empty_table(), columns, episodes, dropped)
            codec = codec_of(source, path)
            with (
                drafted(folder / name) as draft,
                parquet.ParquetWriter(draft, empty.schema, compression=codec) as writer,
            ):
                for table in row_groups(source, path):
                    writer.write_table(_with_statistics(table, columns, episodes, dropped))
            written.append(name)
    if columns.numbers and (source.path / "meta" / "stats.json").is_file():
        kept = _json(source, "stats.json")
        own = {name: together([of[name] for of in episodes.values()]) for name in columns.numbers if episodes}
        _write_json(folder / "meta" / "stats.json", _without(kept, dropped) | own)
        written.append("meta/stats.json")
    info = _json(source, "info.json")
    features = _without(info["features"], [name for name in dropped if name != EVENTS])
    theirs = {EVENTS: features[EVENTS]} if EVENTS in features and not is_written(EVENTS, features[EVENTS]) else {}
    info["features"] = features | columns.features | theirs  # what others say of their events stays
    _write_json(folder / "meta" / "info.json", info)
    return [*written, "meta/info.json"]


def wanted_statistics(source: LeRobot, field: str) -> list[str]:
    """Which statistics the data set keeps of a column; all that there are where it keeps none."""
    everything = ["min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"]
    if not (source.path / "meta" / "stats.json").is_file():
        return everything
    kept = _json(source, "stats.json").get(field)
    found = [name for name in everything if isinstance(kept, dict) and name in kept]
    return sorted({*found, "min", "max", "mean", "std", "count"}, key=everything.index) if found else everything


def _with_statistics(table: Any, columns: TouchColumns, episodes: Mapping[int, Any], dropped: Sequence[str]) -> Any:
    """A table of episodes with the statistics of the answers in each."""
    import pyarrow as pa

    gone = tuple(f"stats/{name}/" for name in [*dropped, *columns.numbers])
    table = table.drop_columns([name for name in table.schema.names if name.startswith(gone)])
    example: dict[str, Any] = next(iter(episodes.values()), {})
    rows = [episodes.get(number) for number in table.column("episode_index").to_pylist()]
    for name in columns.numbers:
        whole = columns.features[name]["dtype"] == "int64"
        for statistic in example.get(name, {}):
            number = pa.int64() if statistic in _COUNTS or (whole and statistic in ("min", "max")) else pa.float64()
            values = [None if row is None else row[name][statistic] for row in rows]
            table = table.append_column(f"stats/{name}/{statistic}", pa.array(values, pa.list_(number)))
    return table


def _without(kept: Mapping[str, Any], dropped: Sequence[str]) -> dict[str, Any]:
    return {name: about for name, about in kept.items() if name not in dropped}


def _json(source: LeRobot, name: str) -> dict[str, Any]:
    found = json.loads(read_text(source.path, source.path / "meta" / name, _LONGEST))
    if not isinstance(found, dict):
        raise RecordingError(f"meta/{name} of {source.address} is a {type(found).__name__}; expected names")
    return found


def _write_json(target: Path, content: Mapping[str, Any]) -> None:
    with drafted(target) as draft:
        draft.write_text(json.dumps(content, indent=4, ensure_ascii=False), encoding="utf-8")


def copy_others(source: LeRobot, folder: Path, written: Sequence[str]) -> None:
    """Bring all files but these into the folder: videos as a second name of the same file where that can be.

    Raises RecordingError as `own_files` does.
    """
    for own, path in own_files(source.path):
        source.budget.work()
        if own not in written and not (folder / own).exists():
            copied(path, folder / own, linked=own.startswith(f"videos{os.sep}"))


def own_files(root: Path, inside: str = "") -> Iterator[tuple[str, Path]]:
    """The files of a data set, or of a folder in it: the path of each within the data set, and where its bytes lie.

    Raises RecordingError for what is no file, or leads out of the data set; OSError for a folder that cannot be read.
    """
    for place, folders, files in os.walk(root / inside, onerror=_raise):
        for name in folders:
            if (Path(place) / name).is_symlink():
                raise RecordingError(f"{Path(place) / name} is a link to a folder: copy what it leads to in its place")
        for name in sorted(files):
            path = Path(place) / name
            require_inside(root, path)
            stored_bytes(path)
            yield os.path.normpath(path.relative_to(root)), path.resolve()


def _raise(error: OSError) -> None:
    raise error


def copied(path: Path, target: Path, *, linked: bool = False) -> None:
    """Copy a file, durable; linked: as a second name of it where the file system allows that."""
    with drafted(target) as draft:
        if linked:
            with suppress(OSError):  # other devices, and file systems without
                os.link(path, draft)
                return
        _copy(path, draft)


def _copy(path: Path, target: Path) -> None:
    """Copy a file's bytes. Its holes stay holes where the system tells them: it may claim to be larger than a disk."""
    about = path.stat()
    if not hasattr(os, "SEEK_DATA") or 512 * about.st_blocks >= about.st_size:
        shutil.copyfile(path, target)
        return
    with path.open("rb", buffering=0) as file, target.open("wb") as copy:
        end = 0
        while end < about.st_size:
            try:
                at = file.seek(end, os.SEEK_DATA)
            except OSError as error:
                if error.errno != errno.ENXIO:  # nothing but a hole is left
                    raise
                break
            end = file.seek(at, os.SEEK_HOLE)
            copy.seek(file.seek(at))
            while at < end and (data := file.read(min(end - at, _PIECE))):
                at += copy.write(data)
        copy.truncate(about.st_size)


@contextmanager
def drafted(target: Path) -> Iterator[Path]:
    """A path to write a file at, which takes the place of the target, durable, where the block ends without an error.

    Raises InputError where it cannot be written.
    """
    draft = target.with_name(target.name + _DRAFT)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        draft.unlink(missing_ok=True)
        yield draft
        with draft.open("rb") as file:
            os.fsync(file.fileno())
        draft.replace(target)
    except OSError as error:
        if error.errno is None:  # of a parser
            raise
        with suppress(OSError):
            draft.unlink(missing_ok=True)
        raise InputError(
            f"{target} cannot be written: {os.strerror(error.errno)}. What is done is kept: make room, or take another "
            "folder, and start the same again"
        ) from error

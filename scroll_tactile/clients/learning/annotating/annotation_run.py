"""A LeRobot data set with what a memory answers at each of its frames: written anew, or in its place."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.arguments import require_arguments, silent
from scroll_tactile.clients.learning.annotating.answer_log import AnswerLog
from scroll_tactile.clients.learning.annotating.frame_answers import Cut, Episodes
from scroll_tactile.clients.learning.annotating.noted import (
    COUNTS,
    LOGS,
    require_movable,
    require_no_links,
    require_notes,
)
from scroll_tactile.clients.learning.annotating.placing import (
    MADE,
    RECORD,
    clear,
    free_name,
    place,
    require_own_folders,
)
from scroll_tactile.clients.learning.annotating.rewriting import (
    copy_others,
    drafted,
    names_in,
    own_files,
    require_each_once,
    require_metadata,
    statistics_in,
    wanted_statistics,
    write_data,
    write_metadata,
)
from scroll_tactile.clients.learning.annotating.touch_columns import EVENTS, TouchColumns, is_written
from scroll_tactile.clients.learning.learning import Progress
from scroll_tactile.clients.learning.runfile import RunFile, alone_in, differing
from scroll_tactile.clients.learning.sources import readings_of
from scroll_tactile.errors import InputError, RecordingError, printable
from scroll_tactile.learner import TactileLearner
from scroll_tactile.recordings import Recording, Report
from scroll_tactile.recordings.arrays.lerobot import LeRobot, is_lerobot
from scroll_tactile.recordings.blocks import Request, guarded
from scroll_tactile.recordings.recording import only_columns

__all__ = ["Annotated", "annotate"]

WORK = ".annotating"  # the suffix of the folder that is worked in, behind the name of the one that is made


@dataclass(frozen=True)
class Annotated:
    """What annotating a data set did.

    output: its folder. episodes, frames: that it has. answered: frames with an answer. touches: that were found in it.
    events: frames with one. left_out: frames without readings that a session takes, NaN or infinite. kept: where an
    annotation in place keeps `meta/` as it was; None of a new folder.
    """

    output: Path
    episodes: int
    frames: int
    answered: int
    touches: int
    events: int
    left_out: int = 0
    kept: Path | None = None


def annotate(
    learner: TactileLearner,
    dataset: str | os.PathLike[str],
    *,
    output: str | os.PathLike[str] | None = None,
    in_place: bool = False,
    replace: bool = False,
    forms: Sequence[str] = ("numbers", "language"),
    field: str | None = None,
    columns: str | None = None,
    clock: str | None = None,
    cut: Cut = "episodes",
    risk: float = 0.05,
    scene: Sequence[str] | None = None,
    progress: Progress = silent,
) -> Annotated:
    """Write what a memory answers at each frame of a LeRobotDataset v3 beside what the robot recorded there.

    What stands at a frame is what a live session would have answered after it, and no more: a policy that is trained on
    it sees what the robot will know then. At the last frame of a touch it is the answer to the whole touch.

    - `observation.touch.material`, int64: the place of the name in `info.materials` of the feature in meta/info.json;
      −1 without an answer. `.probability`, float32: 0 without one. `.known`, int64: 1 learned, 0 never observed, −1
      where that cannot be told. `observation.touch.<quantity>`, float32 (3,), of each declared one: value, low and high
      of its interval; without an estimate the middle and the ends of its range.
    - `language_events`: on the frame where a touch is decided, or ends undecided or revised, a row such as "felt: oak,
      0.97, decided", of role "tool" and style "interjection"; null on others.
    - `mcap/episode_000000.mcap` and so on, where forms has "mcap": what `AnswerLog` writes of each episode, by its
      frames' times, for Foxglove and Rerun.

    Features, statistics and those of each episode are added. All else is copied as it is, videos as second names of
    the same files where the disk allows that. Equal memories give equal columns. An interrupted call is resumed by the
    same one, file by file; the new folder is there only once it is whole. Files that were being moved into a data set
    are moved by any call for it, whatever else it asks for: InputError then says so.

    learner: the memory; it is settled, and stays as it is. dataset: its folder. output: a new one; without it
    `<dataset>-annotated`. in_place: change the data set itself, and keep a copy of `meta/` in `meta.before`. replace:
    overwrite the answers of an earlier annotation; rows that others wrote in `language_events` stay. forms: some of
    "numbers", "language" and "mcap". field, columns, clock: as of `recordings.read`, field being a column of readings
    of the learner's sensor. cut: "episodes" takes each as one touch; "contact" finds touches in them, which then begin
    with two seconds at rest. risk, scene: as of `TactileLearner.live`. progress: called with (what is being done, files
    done, files in all).

    Raises InputError for a memory that holds nothing, an output that is there, or cannot be written, and frames that
    come less than half or more than twice as often as the sensor's readings; RecordingError and FieldError for a data
    set that is not whole, leads out of its folder, or is not v3; ChannelCountError for another sensor's; LockedError
    where another call is at work there; MissingLibraryError for "mcap" without that package.
    """
    require_arguments({"path": dataset, "risk": risk}, {"progress": progress})
    if not learner.materials:
        raise InputError("expected a memory that has observed something; this one is empty, and would answer nothing")
    _require_lerobot(Path(dataset))
    target = _target(Path(dataset), output, in_place)
    learner.settle()
    how: dict[str, Any] = {"cut": cut, "risk": risk, "scene": None if scene is None else sorted(scene)}
    episodes = Episodes(learner, **how)
    about = {"memory": learner.digest(), **how}
    made = TouchColumns(episodes.names, episodes.quantities, forms, about)
    asked = about | {"forms": sorted(forms), "field": field, "columns": columns, "clock": clock}
    asked |= {"replace": replace}
    work = target.with_name(target.name + WORK)
    with alone_in(work, target):
        require_no_links(work)
        record = RunFile(work / RECORD, {"dataset": str(Path(dataset).resolve()), "target": str(target.resolve())})
        require_notes(record.notes, work, in_place=in_place)
        try:
            differs = _differing(record, asked, work)
            if "moving" not in record.notes:
                _require_free(target, in_place)
                source = _opened(Path(dataset), field, clock)
                run = _Rewritten(source, target, work, record, made, logged="mcap" in forms)
                run.prepare(in_place=in_place, replace=replace)
                run.write(episodes, columns, progress)
            kept = place(target, work, record)
        except BaseException:
            if "done" not in record.notes:  # what is refused leaves nothing
                with suppress(OSError):
                    clear(work)
            raise
    if differs:
        raise InputError(
            f"an annotation of {dataset} was cut off while its files were moved: it is whole now, in {target}, but it "
            f"is not the one that is asked for here ({differs}). To have that one, too, start it again, with "
            "replace=True in place, or with another output="
        )
    return Annotated(target, **record.notes["summary"], kept=kept)


def _differing(record: RunFile, asked: dict[str, Any], work: Path) -> str:
    """How what is asked for differs from what is on its way there: that is put in its place all the same, once written.

    Raises InputError where only a part of it is written.
    """
    if "done" not in record.notes:
        record.notes = {"asked": json.loads(json.dumps(asked))}
    differs = differing(record.notes["asked"], asked)
    if differs and "moving" not in record.notes:
        raise InputError(f"{work} belongs to another run ({differs}): ask for the same, or remove {work} to begin anew")
    return differs


def _require_lerobot(path: Path) -> None:
    if not is_lerobot(path):
        kinds = {True: "there is no meta/info.json in it", False: "there is no such folder on this machine"}
        what = "it is a file" if path.is_file() else kinds[path.is_dir()]
        raise RecordingError(f"expected the folder of a LeRobot data set; came {path}: {what}")


def _require_free(target: Path, in_place: bool) -> None:
    if not in_place and os.path.lexists(target):
        raise InputError(f"{target} is there already: take another output=, or move it away")


def _opened(path: Path, field: str | None, clock: str | None) -> LeRobot:
    with guarded(str(path)):
        source = LeRobot(path, str(path), Request(field=field, clock=clock))
        source.column()
    return source


def _target(dataset: Path, output: str | os.PathLike[str] | None, in_place: bool) -> Path:
    """The folder that is made or changed. Raises InputError for one that cannot be."""
    if in_place:
        if output is not None:
            raise InputError("give output= or in_place=True: in place the data set itself is changed")
        return dataset.resolve()
    whole = dataset.resolve()
    target = whole.with_name(whole.name + "-annotated") if output is None else Path(output)
    if target.resolve().is_relative_to(whole):
        raise InputError(f"{target} lies in the data set that is read: take a folder outside, or in_place=True")
    return target


class _Rewritten:
    """One annotation: what is read, the folder it becomes, the one it is worked in, its record, and the columns."""

    def __init__(
        self, source: LeRobot, target: Path, work: Path, record: RunFile, made: TouchColumns, *, logged: bool
    ) -> None:
        self.source, self.target, self.work, self.record, self.made = source, target, work, record, made
        self.folder, self.logged = work / MADE, logged

    def prepare(self, *, in_place: bool, replace: bool) -> None:
        """Look at what is there, before anything is written: answering takes hours.

        Raises InputError for what was changed meanwhile, or cannot be put in its place; RecordingError for what leads
        out of the data set.
        """
        with guarded(self.source.address):
            self.names = names_in(self.source)
            self.dropped = _dropped(self.source, self.made, replace)
            if self.logged and not replace and (self.source.path / LOGS).exists():
                raise InputError(f"{self.source.address} has a folder {LOGS!r} already: replace=True writes over it")
            for _ in own_files(self.source.path, "meta" if in_place else ""):
                pass  # each is checked
            require_metadata(self.source, self.made)
            require_each_once(self.source, self.names, logged=self.logged)
            state = _state_of(self.source.path)
        if in_place:
            free_name(self.target)
            require_movable(self.names)
            require_own_folders(self.target, [*self.names, "meta/info.json", *[f"{LOGS}/*.mcap"] * self.logged])
        self.in_place = in_place
        if self.record.notes.setdefault("source", state) != state:
            raise InputError(
                f"{self.source.address} has changed since this annotation began: remove {self.work} to begin anew"
            )
        self.record.note("source", state)

    def write(self, episodes: Episodes, columns: str | None, progress: Progress) -> None:
        """Write what is not written yet, and note what then has to be moved."""
        for number, name in enumerate(self.names):
            progress(f"answering {printable(Path(name).name)}", number, len(self.names))
            if name not in self.record.notes.get("done", {}) or not (self.folder / name).is_file():
                self._annotated(name, episodes, columns)
        progress("statistics", len(self.names), len(self.names))
        with guarded(self.source.address):
            wanted = wanted_statistics(self.source, self.source.column())
            of_episodes = statistics_in(self.folder, self.names, self.made, wanted)
            written = write_metadata(self.source, self.folder, self.made, of_episodes, self.dropped)
            if not self.in_place:
                copy_others(self.source, self.folder, [*self.names, *written])
        self.record.note("summary", _summary(self.record.notes["done"], len(of_episodes)))
        logs = [f"{LOGS}/{path.name}" for path in sorted((self.folder / LOGS).glob("*.mcap"))]
        self.record.note("moving", [*logs, *self.names, *written] if self.in_place else [])

    @contextmanager
    def _log(self, episode: int) -> Iterator[AnswerLog]:
        """The log of an episode, whole on the disk where the block ends without an error."""
        with drafted(self.folder / LOGS / f"episode_{episode:06d}.mcap") as draft, AnswerLog(draft) as log:
            yield log

    def _annotated(self, name: str, episodes: Episodes, columns: str | None) -> None:
        with guarded(self.source.address):
            frames = _frames(self.source, name, columns)
        readings, times, numbers = readings_of(episodes.sensor, frames[0]), *frames[1:]
        found = episodes.answered(readings, times, numbers, *[self._log] * self.logged)
        with guarded(self.source.address):
            write_data(self.source, name, self.folder / name, self.made, found, self.dropped)
        counted = {
            "frames": len(times),
            "answered": int((found.material >= 0).sum()),
            "touches": found.touches,
            "events": len(found.events),
            "left_out": found.left_out,
        }
        self.record.note("done", self.record.notes.get("done", {}) | {name: counted})


def _frames(
    source: LeRobot, name: str, columns: str | None
) -> tuple[Recording, npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """The readings of a file as a recording, their times, and which episode each is of."""
    blocks = []
    for block in source.blocks_of(source.path / name):
        source.budget.give(block.readings.nbytes)
        blocks.append(block)
    if not blocks:
        raise RecordingError(f"{name} of {source.address} has no frames: remove it, or write it again")
    times = np.concatenate([next(iter(block.clocks.values())) for block in blocks])
    readings, report = np.concatenate([block.readings for block in blocks]), Report(len(times), source.request.clock)
    recording = Recording(f"{source.address}/{name}", None, source.field(), readings, times, (), report)
    numbers = np.concatenate([block.episodes for block in blocks if block.episodes is not None])
    return recording if columns is None else only_columns(recording, columns), times, numbers


def _dropped(source: LeRobot, made: TouchColumns, replace: bool) -> list[str]:
    """The columns that give way. Raises InputError where there are some without replace, or of somebody else."""
    ours = [name for name, about in source.features.items() if is_written(name, about)]
    wanted = [name for name in ours if (made.language if name == EVENTS else made.numbers)]
    there = [name for name in made.features if name in source.features]
    if strangers := [name for name in there if name not in ours and name != EVENTS]:
        raise InputError(
            f"{source.address} has a feature {strangers[0]!r} that no annotation wrote: rename one of them, or leave "
            "numbers out"
        )
    found = sorted({*wanted, *there}, key=lambda name: (name == EVENTS, name))
    if found and not replace:
        raise InputError(
            f"{source.address} has {found[0]!r} already: replace=True answers anew, and leaves the events of others; "
            "forms= without numbers, or language, leaves those alone"
        )
    if source.column() in found:
        raise InputError(f"{source.column()!r} are answers, and no readings: give another field=")
    return found


def _state_of(folder: Path) -> str:
    """A hash of which files a data set's frames and metadata are in, of their sizes and dates."""
    found = hashlib.sha256()
    for path in sorted([*(folder / "data").glob("**/*"), *(folder / "meta").glob("**/*")]):
        if path.is_file():
            about = path.stat()
            found.update(os.fsencode(f"{path.relative_to(folder)}\0{about.st_size}\0{about.st_mtime_ns}\n"))
    return found.hexdigest()


def _summary(done: dict[str, dict[str, int]], episodes: int) -> dict[str, int]:
    """What all files together have."""
    return {"episodes": episodes} | {name: sum(of[name] for of in done.values()) for name in COUNTS}

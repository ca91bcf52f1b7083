"""A copy of a store that is in use: whole, verified and durable when it appears, or not there at all."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp

from scroll_tactile_store.checkpoint_files import CheckpointReader
from scroll_tactile_store.exceptions import DamageError, NotAStoreError, StoreError, reported
from scroll_tactile_store.files import copy_regular, remove_tree, replacing, same_folder
from scroll_tactile_store.layout import (
    CURRENT_FILE,
    PARTIAL,
    Current,
    checkpoint_path,
    log_path,
    read_current,
    write_current,
)
from scroll_tactile_store.log import Log
from scroll_tactile_store.rows import Rows
from scroll_tactile_store.survey import Progress, check_store

LARGEST_FILE = 2**30  # of a checkpoint
PART = 2**20  # bytes that are copied at once
ATTEMPTS = 100  # while a writer commits one checkpoint after another


def back_up(source: Path, destination: Path, progress: Progress | None) -> None:
    """Copy the store in folder `source` to the new folder `destination`, as `Store.backup`."""
    if os.path.lexists(destination):
        raise NotAStoreError(f"{destination} is there already; nothing was written: give the name of a new folder")
    if any(same_folder(source, above) for above in destination.resolve().parents if above.is_dir()):
        raise NotAStoreError(f"{destination} lies inside {source}; nothing was written: give a folder outside of it")
    with reported(destination, "backing up a store"):
        destination.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(mkdtemp(prefix=f"{destination.name}.", suffix=PARTIAL, dir=destination.parent))
        with replacing(destination, draft):
            shutil.copymode(source, draft)
            _copy(source, draft)
            _verify(source, draft, progress)


def _copy(source: Path, draft: Path) -> None:
    """Copy what `CURRENT` names, and begin again where a writer replaced some of it meanwhile."""
    for _ in range(ATTEMPTS):
        current = read_current(source / CURRENT_FILE)
        # A writer removes what it replaces only after `CURRENT` has ceased to name it.
        try:
            last = _copy_named(source, draft, current)
            if read_current(source / CURRENT_FILE) == current:
                write_current(draft, replace(current, last=max(last, current.last)))
                return
        except (DamageError, FileNotFoundError):
            if read_current(source / CURRENT_FILE) == current:
                raise
        for entry in draft.iterdir():
            remove_tree(entry)
    raise StoreError(f"{source} changed {ATTEMPTS} times while it was copied: back it up when less is written")


def _copy_named(source: Path, draft: Path, current: Current) -> int:
    """Copy what `current` names; return the last row of the log, or 0. Verifying the copy names what is damaged."""
    for named in current.checkpoints:
        _copy_checkpoint(checkpoint_path(source, named.number), checkpoint_path(draft, named.number))
    # The log last: it has every row that the checkpoints contain.
    with Log(log_path(source, current.log)) as log:
        if current.newest is not None and log.has_place(current.newest.place):
            log.place = current.newest.place
        rows = Rows(0 if current.newest is None else current.newest.last_sequence)
        rows.catch_up(log)
        with log_path(draft, current.log).open("xb") as copy:
            for offset in range(0, log.place.offset, PART):
                copy.write(log.at(offset, min(PART, log.place.offset - offset)))
        return rows.last


def _copy_checkpoint(source: Path, target: Path) -> None:
    for name in ("zarr.json", *CheckpointReader(source).files):
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        copy_regular(source / name, target / name, LARGEST_FILE, within=source.parent.parent)


def _verify(source: Path, draft: Path, progress: Progress | None) -> None:
    damaged = [problem for problem in check_store(draft, progress=progress) if problem.kind != "leftover"]
    if damaged:
        what = damaged[0].what.replace(str(draft), str(source))
        raise DamageError(
            f"a copy of {source} does not verify: {what}; no copy was kept. Check the store (check_store): it is "
            "damaged, or else the disk of the copy cannot be trusted",
            path=source,
        )

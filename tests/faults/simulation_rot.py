"""Files at rest: a bit of one is another."""

from __future__ import annotations

import random
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from scroll_tactile_store import StoreError, repair_store
from scroll_tactile_store.layout import read_current

from faults.learners import KIT, perform
from faults.model import State, after
from faults.simulation_disk import abandon, flip, in_a_number, near_the_end
from faults.simulation_events import OneMemory
from faults.simulation_world import Machine, Wrong

KEPT = ("kept", "pool", "exemplars")


class Rotting(OneMemory):
    """The events of files that nobody writes."""

    def _rot(self, machine: Machine, rng: random.Random) -> None:
        """A bit of a file at rest is another: the memory is the same, or refused by name and repaired."""
        if not machine.made or len(machine.candidates) > 1 or not machine.path.exists():
            return
        if rng.random() < 0.5:
            self.shut(machine)
        self.drop(machine)
        newest = read_current(machine.path / "CURRENT").newest
        hurt, kind = self._hurt(machine.path, rng)
        self.disks.settle(machine.name)
        self.say(f"  {machine.name}: a bit of {hurt.relative_to(machine.path)} is another ({kind})")
        self.counts[f"rot: of {kind}"] += 1
        whole = machine.state
        allowed = [whole]
        if hurt.name.startswith("log-") and machine.begins:
            allowed.append(whole.cut(max(machine.begins[-1], whole.compacted)))
        machine.candidates = allowed
        self.warned.clear()

        def look(learner: Any, where: str, *, settle: bool = False) -> None:
            # Of a damaged compaction checkpoint a warning tells that nothing can take the place of what is retracted.
            named = any("no other touch can take the place" in text for text in self.warned)
            self.look(machine, learner, f"{where} after a bit of {hurt.name} changed", settle=settle, but=KEPT * named)

        try:
            learner = self.open(machine, machine.path, allowed, "read")
            look(learner, "read")
            learner.close()
        except StoreError as error:
            self.counts["rot: refused to read"] += 1
            self.say(f"    reading: {error!r:.150}")
        try:
            with self.disks.taken_in():
                machine.learner = self.open(machine, machine.path, allowed)
        except StoreError as error:
            self.counts["rot: refused"] += 1
            self.say(f"    writing: {error!r:.150}")
        if machine.learner is not None:
            try:
                look(machine.learner, "opened", settle=True)
                self.counts["rot: the same" if machine.state == whole else "rot: took the last batch"] += 1
                if not self.problems(machine.path):
                    return
                self.counts["rot: named by a check alone"] += 1
                self.drop(machine)
            except StoreError as error:
                self.counts["rot: refused when it was read"] += 1
                self.say(f"    reading what was opened: {error!r:.150}")
                self.drop(machine)
        self._repair(machine, whole, hurt, 0 if newest is None else newest.last_sequence)

    @staticmethod
    def _hurt(path: Path, rng: random.Random) -> tuple[Path, str]:
        """Flip a bit in a file of a memory, and return which, and where it was meant to hit: all kinds are hit."""
        files = [one for one in sorted(path.rglob("*")) if one.is_file() and one.stat().st_size]
        files = [one for one in files if one.name not in ("lock", "holder.json")]
        logs = [one for one in files if one.name.startswith("log-")]
        of_kind = {
            "CURRENT": [path / "CURRENT"],
            "a number": [path / "CURRENT"],
            "the log": logs,
            "the end of the log": logs,
            "a chunk": [one for one in files if "c" in one.relative_to(path).parts],
            "a checkpoint's own words": sorted(path.glob("checkpoints/*/zarr.json")),
            "any": files,
        }
        kind = rng.choice(list(of_kind))
        hurt = rng.choice(of_kind[kind] or files)
        if kind == "a number":
            flip(hurt, rng, in_a_number, bits=4)  # most are digits still
        else:
            flip(hurt, rng, near_the_end if "end" in kind else None)
        return hurt, kind

    def _repair(self, machine: Machine, whole: State, hurt: Path, contained: int) -> None:
        """contained: the last row that the newest checkpoint contained."""
        try:
            with self.disks.taken_in():
                repair = repair_store(machine.path)
        except StoreError as error:
            self.say(f"    repairing: {error!r:.200}")
            self.counts["rot: not repaired"] += 1
            self._replace(machine)
            return
        self.say(f"    repaired: {repair!r:.300}")
        self.counts["rot: repaired"] += 1
        rows = whole.cut(repair.kept)
        if not repair.lost and repair.kept < whole.last:
            raise Wrong(f"a repair of {hurt.name} kept {repair.kept} of {whole.last} rows, and tells of no loss")
        if repair.kept < whole.compacted:  # the compaction checkpoint is lost: with it all that it stood for
            self._replace(machine)
            return
        if repair.kept < whole.last and (not hurt.name.startswith("log-") or repair.kept < contained):
            raise Wrong(f"a repair of {hurt.name} kept {repair.kept} of {whole.last} rows")
        try:
            learner = self.open(machine, machine.path, [rows], "read")
        except StoreError as error:
            raise Wrong(f"repaired after {hurt.name}, and not opened: {error!r}") from error
        compacted = learner._ledger.store.compacted
        listed = {each.sequence for each in learner.observations()}
        heads = sum(1 for _ in learner._ledger.store.heads())
        learner.close()
        if compacted < rows.compacted:
            raise Wrong(
                f"a repair of {hurt.name} left the compaction checkpoint at {compacted}, which was {rows.compacted}"
            )
        if compacted > rows.compacted:
            # What a later row took back of those counts again: a warning tells of it at each opening.
            rows = replace(rows, compacted=compacted, stands=rows.cut(compacted).compact(compacted).stands)
        unlisted = {sequence for sequence, _ in rows.listed if sequence <= compacted and sequence not in listed}
        if len(unlisted) > 1:
            raise Wrong(f"a repair after one bit of {hurt.name} left out rows {unlisted}")
        # A row of another kind may be left out, too, such as one that took another back.
        if unlisted or compacted > whole.compacted or heads < rows.last:
            self._with_less(machine, rows, unlisted)
            return
        machine.candidates, machine.begins = [rows], []

    def _with_less(self, machine: Machine, rows: State, unlisted: set[int]) -> None:
        """A memory of which a repair left less knows still what it learned, and learns on.

        unlisted: the observations that were left out.
        """
        self.counts["rot: repaired, with less"] += 1
        learner = self.open(machine, machine.path, [rows])
        try:
            touch, but = ("observe", KIT.materials[0], 0), ("listed", "names", *KEPT)
            machine.candidates = [rows]
            self.look(machine, learner, "repaired with less", but=but)
            perform(learner, touch, machine.path)
            # A touch whose row was left out is not known any more, and is learned again.
            machine.candidates = [after(rows, touch, {})[0], *([rows.plus(touch)] if unlisted else [])]
            self.look(machine, learner, "learning on", but=but)
        finally:
            abandon(learner)
        self._replace(machine)  # nothing of this was written down

    def _replace(self, machine: Machine) -> None:
        """A new disk, and nothing on it."""
        self.drop(machine)
        shutil.rmtree(self.root / machine.name)
        (self.root / machine.name).mkdir()
        self.disks.settle(machine.name)
        machine.candidates, machine.copies, machine.made, machine.begins = [State()], {}, False, []
        self.counts["disks replaced"] += 1

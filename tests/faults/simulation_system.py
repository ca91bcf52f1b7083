"""Files at rest that change by a bit, and the end of a simulation: the last of its events."""

from __future__ import annotations

import random
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from faults.simulation_bucket import Carrying
from faults.simulation_disk import abandon, flip
from faults.simulation_model import Rows
from faults.simulation_touches import MATERIALS, stream
from faults.simulation_world import Machine, Wrong
from store import StoreError, repair_store
from store.layout import read_current

KEPT = ("kept", "pool", "exemplars")
END = 600  # bytes of a log, which has its last row or two there


class System(Carrying):
    """All events."""

    def _rot(self, machine: Machine, rng: random.Random) -> None:
        """A bit of a file at rest is another: the memory is the same, or refused by name and repaired."""
        if not machine.made or len(machine.candidates) > 1 or not machine.path.exists():
            return
        if rng.random() < 0.5:
            self._shut(machine)
        self.drop(machine)
        newest = read_current(machine.path / "CURRENT").newest
        hurt, last = self._hurt(machine.path, rng)
        flip(hurt, rng, last=last)
        self.disks.settle(machine.name)
        self.say(
            f"  {machine.name}: a bit of {hurt.relative_to(machine.path)} is another{', near its end' if last else ''}"
        )
        whole = machine.rows
        allowed = [whole]
        if hurt.name.startswith("log-") and machine.sure < len(whole.rows):
            allowed.append(whole.cut(max(machine.sure, whole.base)))
        machine.candidates = allowed
        self.warned.clear()

        def look(learner: Any, where: str, *, settle: bool = False) -> None:
            # Of a damaged base a warning tells that nothing can take the place of what is retracted.
            named = any("no other touch can take the place" in text for text in self.warned)
            self.look(machine, learner, f"{where} after a bit of {hurt.name} changed", settle=settle, but=KEPT * named)

        try:
            learner = self._open(machine, machine.path, allowed, "read")
            look(learner, "read")
            learner.close()
        except StoreError as error:
            self.counts["rot: refused to read"] += 1
            self.say(f"    reading: {error!r:.150}")
        try:
            self.disks.begin()
            machine.learner = self._open(machine, machine.path, allowed)
        except StoreError as error:
            self.counts["rot: refused"] += 1
            self.say(f"    writing: {error!r:.150}")
        finally:
            self.disks.go(self.disks.end())
        if machine.learner is not None:
            try:
                look(machine.learner, "opened", settle=True)
                self.counts["rot: the same" if machine.rows == whole else "rot: took the last batch"] += 1
                if not self._problems(machine.path):
                    return
                self.counts["rot: named by a check alone"] += 1
                self.drop(machine)
            except StoreError as error:
                self.counts["rot: refused when it was read"] += 1
                self.say(f"    reading what was opened: {error!r:.150}")
                self.drop(machine)
        self._repair(machine, whole, hurt, 0 if newest is None else newest.upto)

    @staticmethod
    def _hurt(path: Path, rng: random.Random) -> tuple[Path, int]:
        """A file of a memory, and how many of its last bytes are meant, 0 for all: all kinds of files are."""
        files = [one for one in sorted(path.rglob("*")) if one.is_file() and one.stat().st_size]
        files = [one for one in files if one.name not in ("lock", "holder.json")]
        chunks = [one for one in files if "c" in one.relative_to(path).parts]
        kind = rng.choice(("CURRENT", "log", "end of the log", "chunk", "any"))
        if kind == "CURRENT":
            return path / "CURRENT", 0
        if "log" in kind:
            return rng.choice([one for one in files if one.name.startswith("log-")]), END * (kind != "log")
        return rng.choice(chunks if kind == "chunk" and chunks else files), 0

    def _repair(self, machine: Machine, whole: Rows, hurt: Path, contained: int) -> None:
        """contained: the last row that the newest checkpoint contained."""
        refused = None
        self.disks.begin()
        try:
            repair = repair_store(machine.path)
        except StoreError as error:
            refused = error
        finally:
            self.disks.go(self.disks.end())
        if refused is not None:
            self.say(f"    repairing: {refused!r:.200}")
            self.counts["rot: not repaired"] += 1
            self._replace(machine)
            return
        self.say(f"    repaired: {repair!r:.300}")
        self.counts["rot: repaired"] += 1
        rows = whole.cut(repair.kept)
        if not repair.lost and repair.kept < len(whole.rows):
            raise Wrong(f"a repair of {hurt.name} kept {repair.kept} of {len(whole.rows)} rows, and tells of no loss")
        if repair.kept < whole.base:  # the base is lost: with it all that it stood for
            self._replace(machine)
            return
        if repair.kept < len(whole.rows) and (not hurt.name.startswith("log-") or repair.kept < contained):
            raise Wrong(f"a repair of {hurt.name} kept {repair.kept} of {len(whole.rows)} rows")
        try:
            learner = self._open(machine, machine.path, [rows], "read")
        except StoreError as error:
            raise Wrong(f"repaired after {hurt.name}, and not opened: {error!r}") from error
        base = learner._ledger.store.compacted
        listed = {each.sequence for each in learner.observations()}
        heads = sum(1 for _ in learner._ledger.store.heads())
        learner.close()
        if base < rows.base:
            raise Wrong(f"a repair of {hurt.name} left the base at {base}, which was {rows.base}")
        if base > rows.base:
            # What a later row took back of those counts again: a warning tells of it at each opening.
            rows = replace(rows, base=base, stands=rows.cut(base).based(base).stands)
        unlisted = {sequence for sequence, _ in rows.listed if sequence <= base and sequence not in listed}
        if len(unlisted) > 1:
            raise Wrong(f"a repair after one bit of {hurt.name} left out rows {unlisted}")
        # A row of another kind may be left out, too, such as one that took another back.
        if unlisted or base > whole.base or heads < len(rows.rows):
            self._with_less(machine, rows)
            return
        machine.candidates, machine.sure = [rows], min(repair.kept, len(rows.rows))

    def _with_less(self, machine: Machine, rows: Rows) -> None:
        """A memory of which a repair left less knows still what it learned, and learns on."""
        self.counts["rot: repaired, with less"] += 1
        learner = self._open(machine, machine.path, [rows])
        try:
            for candidate in (rows, rows.plus(("observe", MATERIALS[0], 0))):
                if candidate is not rows:
                    learner.observe(MATERIALS[0], stream(0), again=True)
                machine.candidates = [candidate]
                self.look(machine, learner, "repaired with less", but=("listed", *KEPT))
        finally:
            abandon(learner)
        self._replace(machine)  # nothing of this was written down

    def _replace(self, machine: Machine) -> None:
        """A new disk, and nothing on it."""
        self.drop(machine)
        shutil.rmtree(self.root / machine.name)
        (self.root / machine.name).mkdir()
        self.disks.settle(machine.name)
        machine.candidates, machine.copies, machine.made, machine.sure = [Rows()], {}, False, 0
        self.counts["disks replaced"] += 1

    # The end.

    def quiet(self) -> None:
        """All that is open is as it must be."""
        for machine in self.machines:
            if machine.learner is not None:
                self.look(machine, machine.learner, "quiet")
        self.counts["quiet points"] += 1

    def _quiet(self, machine: Machine, rng: random.Random) -> None:
        self.quiet()

    def finish(self, rng: random.Random) -> None:
        """The power of all is cut once more; then all is sound, and in one of the ways it may be."""
        for machine in self.machines:
            if not machine.made:
                continue
            self.crash(machine, rng, "cut")
            self.disks.begin()
            try:
                machine.learner = self._open(machine, machine.path, machine.candidates)
            finally:
                self.disks.go(self.disks.end())
            self.look(machine, machine.learner, "at the end", settle=True)
            self._shut(machine)
            if problems := self._problems(machine.path):
                raise Wrong(f"at the end {machine.name} has {problems}")
            for path, (_, acknowledged) in machine.copies.items():
                if acknowledged and not path.exists():
                    raise Wrong(f"{path.name} of {machine.name} is gone")

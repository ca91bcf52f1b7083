"""The end of a simulation: all is sound, and all of it is merged into one."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

from faults import simulation_model as model
from faults.simulation_model import Rows
from faults.simulation_rot import Rotting
from faults.simulation_touches import EMBEDDINGS, SETTINGS
from faults.simulation_world import Machine, Wrong
from scroll_tactile import TactileLearner
from scroll_tactile.errors import InputError


class System(Rotting):
    """All events, and the end."""

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
            with self.disks.taken_in():
                machine.learner = self._open(machine, machine.path, machine.candidates)
            self.look(machine, machine.learner, "at the end", settle=True)
            self._shut(machine)
            if problems := self._problems(machine.path):
                raise Wrong(f"at the end {machine.name} has {problems}")
            for path, (_, acknowledged, _) in machine.copies.items():
                if acknowledged and not path.exists():
                    raise Wrong(f"{path.name} of {machine.name} is gone")
        self._merge_all(rng)

    def _merge_all(self, rng: random.Random) -> None:
        """All memories, and the packed ones in the bucket, become one: the branches of a tree, merged two by two."""
        branches = [(machine.path, machine.rows) for machine in self.machines if machine.made]
        for name, versions in sorted(self.bucket.items()):
            data, rows = rng.choice(versions)
            branches.append((self.net / f"{name}.zip", rows))
            branches[-1][0].write_bytes(data)
        if not branches:
            return
        embedding = rng.choice(branches)[1].embedding
        branches = [branch for branch in branches if branch[1].embedding == embedding and not branch[1].unlisted]
        rng.shuffle(branches)
        touches = sorted(pair for _, rows in branches for pair in rows.pairs)
        once = rng.random() < 0.5
        while len(branches) > 1 or not branches[0][0].is_relative_to(self.trees):
            two = [branches.pop(rng.randrange(len(branches))) for _ in range(min(2, len(branches)))]
            branches.append(self._branch(two, rng, embedding, once=once))
        if not once and touches != list(branches[0][1].pairs):
            raise Wrong(f"all merged have {branches[0][1].pairs}, and each had {touches}")
        self.counts[f"all merged, {'once' if once else 'twice'}"] += 1

    def _branch(
        self, parts: list[tuple[Path, Rows]], rng: random.Random, embedding: str, *, once: bool
    ) -> tuple[Path, Rows]:
        """Merge memories into a new one; it goes on as a folder, a compacted folder or a packed memory."""
        path, rows = self.trees / f"{len(list(self.trees.iterdir()))}", Rows(embedding=embedding)
        with TactileLearner.open(path, embedding=EMBEDDINGS[embedding], **SETTINGS) as learner:
            for other, theirs in parts:
                self.say(f"  {path.name} of all: {other.parent.name}/{other.name}")
                then, foretold = model.merge(rows, theirs, once, "theirs", one_name=False)
                try:
                    merged = learner.merge(other, shared="once" if once else "twice", descriptions="theirs")
                    found: Any = [merged.observations, merged.shared, merged.described, 0]
                except InputError as error:
                    found = type(error).__name__
                if found != foretold:
                    raise Wrong(f"merging {other.name} of all gave {found!r}, expected {foretold!r}")
                if found == "ObservationError":  # it was compacted, and has what is there
                    then, _ = model.merge(rows, theirs, False, "theirs", one_name=False)
                    learner.merge(other, shared="twice", descriptions="theirs")
                rows = then
            if (drawn := rng.random()) < 0.3:
                keep = rng.choice((0, 2))
                rows, _ = model.compact(rows, keep)
                learner.compact(keep=keep)
            self.look(Machine("all", path, [rows]), learner, "all merged")
            if drawn > 0.7 and rows.pairs:
                packed = path.with_suffix(".zip")
                learner.pack(packed)
                return packed, model.packed(rows, True)
        return path, rows

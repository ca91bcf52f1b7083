"""What goes from one memory to another: by a bucket that loses, doubles and delays, or from folder to folder.

And the end of a simulation: all is sound, and all of it is merged into one.
"""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

from scroll_tactile_store import StoreError

from faults.learners import perform
from faults.model import State, after
from faults.simulation_disk import flip
from faults.simulation_rot import Rotting
from faults.simulation_world import Machine, Wrong

MOST = 24  # touches of a memory that is merged


class System(Rotting):
    """All events, and the end."""

    def _pack(self, machine: Machine, rng: random.Random) -> None:
        """Packed, and sent: it may be lost, come late, or twice."""
        if (learner := self.opened(machine, rng)) is None or not machine.state.pairs or machine.state.unlisted:
            return
        rows, to = rng.random() < 0.7, machine.path.with_name("packed.zip")
        done = lambda: learner.pack(to, rows=rows) or "done"  # noqa: E731
        if self.operate(machine, rng, f"pack {rows}", done, (machine.state, "done")) != "done":
            return
        sent = to.read_bytes(), machine.state.pack(rows=rows)
        name = f"{machine.name}-{rng.randrange(2)}"
        drawn = rng.random()
        fate = "packed memories lost" if drawn < 0.1 else "packed memories doubled" if drawn < 0.25 else "sent"
        for _ in range({"packed memories lost": 0, "packed memories doubled": 2, "sent": 1}[fate]):
            self.flying.append((self.step + rng.choice((0, 0, 1, 5, 20)), name, sent))
        self.counts[fate] += 1

    def _listed(self, rng: random.Random) -> list[tuple[str, bytes, State]]:
        """The bucket as a listing says: some are missing, some old, some there twice."""
        found = []
        for name, versions in sorted(self.bucket.items()):
            drawn = rng.random()
            version = rng.choice(versions) if drawn < 0.3 else versions[-1]
            self.counts["listed: old"] += version is not versions[-1]
            self.counts["listed: missing"] += drawn > 0.85
            self.counts["listed: twice"] += 0.3 < drawn < 0.45
            found += [(name, *version)] * (0 if drawn > 0.85 else 2 if 0.3 < drawn < 0.45 else 1)
        return found

    def _collect(self, machine: Machine, rng: random.Random) -> None:
        """What lies in the bucket is merged; what came damaged is refused by name."""
        if rng.random() < 0.7:
            machine = self.machines[-1]
        listed = self._listed(rng)
        rng.shuffle(listed)
        for name, data, state in listed[:3]:
            path, bad = self.net / f"{name}.zip", rng.random() < 0.12
            path.write_bytes(data)
            if bad and rng.random() < 0.5:
                flip(path, rng)
            elif bad:
                path.write_bytes(data[: rng.randrange(len(data))])
            self._merge_from(machine, rng, path, state, bad=bad)

    def _merge_from(self, machine: Machine, rng: random.Random, path: Path, state: State, *, bad: bool = False) -> None:
        if (learner := self.opened(machine, rng)) is None:
            return
        choice, of_sources = rng.choice(("same", "ours", "theirs", "theirs")), rng.random() < 0.3
        operation = "merge", str(path), choice, of_sources
        if not bad:
            self.do(machine, rng, operation, {str(path): state})
            return

        def damaged() -> Any:
            try:
                return perform(learner, operation, self.net)
            except StoreError as error:
                self.say(f"    refused: {error!r:.200}")
                self.counts["damaged on the way: refused"] += 1
                return "refused"

        either = after(machine.state, operation, {str(path): state})
        self.operate(machine, rng, f"damaged, merge {path.name}", damaged, (machine.state, "refused"), either)

    def _merge(self, machine: Machine, rng: random.Random) -> None:
        """The folder of another machine is merged, in which somebody may be writing."""
        other = rng.choice([one for one in self.machines if one is not machine])
        large = max(len(other.state.pairs), len(machine.state.pairs)) > MOST
        if other.settled and not other.state.unlisted and not large:
            self._merge_from(machine, rng, other.path, other.state)

    # The end.

    def _quiet(self, machine: Machine, rng: random.Random) -> None:
        """All that is open is as it must be."""
        for one in self.machines:
            if one.learner is not None:
                self.look(one, one.learner, "quiet")
        self.counts["quiet points"] += 1

    def finish(self, rng: random.Random) -> None:
        """The power of all is cut once more; then all is sound, and in one of the ways it may be."""
        for machine in self.machines:
            if not machine.made:
                continue
            self.crash(machine, rng, "cut")
            with self.disks.taken_in():
                machine.learner = self.open(machine, machine.path, machine.candidates)
            self.look(machine, machine.learner, "at the end", settle=True)
            self.shut(machine)
            if problems := self.problems(machine.path):
                raise Wrong(f"at the end {machine.name} has {problems}")
            for path, (_, acknowledged, _) in machine.copies.items():
                if acknowledged and not path.exists():
                    raise Wrong(f"{path.name} of {machine.name} is gone")
        self._merge_all(rng)

    def _merge_all(self, rng: random.Random) -> None:
        """All memories, and the packed ones in the bucket, become one: the branches of a tree, merged two by two."""
        branches = [(machine.path, machine.state) for machine in self.machines if machine.made]
        for name, versions in sorted(self.bucket.items()):
            data, state = rng.choice(versions)
            branches.append((self.net / f"{name}.zip", state))
            branches[-1][0].write_bytes(data)
        if not branches:
            return
        embedding = rng.choice(branches)[1].embedding
        branches = [branch for branch in branches if branch[1].embedding == embedding and not branch[1].unlisted]
        rng.shuffle(branches)
        touches, left_out = {pair for _, state in branches for pair in state.pairs}, self.counts["all merged: left out"]
        while len(branches) > 1 or not branches[0][0].is_relative_to(self.trees):
            two = [branches.pop(rng.randrange(len(branches))) for _ in range(min(2, len(branches)))]
            branches.append(self._branch(two, rng, embedding))
        if left_out == self.counts["all merged: left out"] and touches != set(branches[0][1].pairs):
            raise Wrong(f"all merged have {branches[0][1].pairs}, and each had {touches}")
        self.counts["all merged"] += 1

    def _branch(self, parts: list[tuple[Path, State]], rng: random.Random, embedding: str) -> tuple[Path, State]:
        """Merge memories into a new one; it goes on as a folder, a compacted folder or a packed memory."""
        path, state = self.trees / f"{len(list(self.trees.iterdir()))}", State(embedding=embedding)
        with self.open(Machine("all", path), path, [state]) as learner:

            def do(*operation: Any, others: dict[str, State]) -> Any:
                nonlocal state
                state, foretold = after(state, operation, others)
                if (found := perform(learner, operation, self.net)) != foretold:
                    raise Wrong(f"{operation} of all gave {found!r}, expected {foretold!r}")
                return found

            for other, theirs in parts:
                self.say(f"  {path.name} of all: {other.parent.name}/{other.name}")
                if do("merge", str(other), "theirs", others={str(other): theirs}) == "ObservationError":
                    self.counts["all merged: left out"] += 1  # it was compacted, and has what is there
            if (drawn := rng.random()) < 0.3:
                do("compact", rng.choice((0, 2)), others={})
            self.look(Machine("all", path, [state]), learner, "all merged")
            if drawn > 0.7 and state.pairs:
                packed = path.with_suffix(".zip")
                learner.pack(packed)
                return packed, state.pack(rows=True)
        return path, state

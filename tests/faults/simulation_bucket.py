"""What goes from one memory to another: by a bucket that loses, doubles and delays, or from folder to folder."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

from faults import simulation_model as model
from faults.simulation_disk import flip
from faults.simulation_events import OneMemory
from faults.simulation_model import Rows
from faults.simulation_world import Machine
from scroll_tactile.persistence.merge import MergeRules
from store import StoreError

MOST = 24  # touches of a memory that is merged


class Carrying(OneMemory):
    """The events of two memories."""

    def _pack(self, machine: Machine, rng: random.Random) -> None:
        """Packed, and sent: it may be lost, come late, or twice."""
        if self.opened(machine, rng) is None or not machine.rows.pairs or machine.rows.unlisted:
            return
        rows, to = rng.random() < 0.7, machine.path.with_name("packed.zip")
        pack = lambda learner: learner.pack(to, rows=rows) or "done"  # noqa: E731
        if self._do(machine, rng, f"pack {rows}", pack, lambda ours: (ours, "done")) != "done":
            return
        sent = to.read_bytes(), model.packed(machine.rows, rows)
        name = f"{machine.name}-{rng.randrange(2)}"
        drawn = rng.random()
        for _ in range(0 if drawn < 0.1 else 2 if drawn < 0.25 else 1):
            self.flying.append((self.step + rng.choice((0, 0, 1, 5, 20)), name, sent))
        self.counts[
            "packed memories lost" if drawn < 0.1 else "packed memories doubled" if drawn < 0.25 else "sent"
        ] += 1

    def _listed(self, rng: random.Random) -> list[tuple[str, bytes, Rows]]:
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
        for name, data, rows in listed[:3]:
            path, bad = self.net / f"{name}.zip", rng.random() < 0.12
            path.write_bytes(data)
            if bad and rng.random() < 0.5:
                flip(path, rng)
            elif bad:
                path.write_bytes(data[: rng.randrange(len(data))])
            self._merge_from(machine, rng, path, rows, bad=bad)

    def _merge_from(self, machine: Machine, rng: random.Random, path: Path, rows: Rows, *, bad: bool = False) -> None:
        if self.opened(machine, rng) is None:
            return
        once, choice = rng.random() < 0.8, rng.choice(("same", "ours", "theirs", "theirs"))
        of_sources = once and rng.random() < 0.4
        after = model.merge(machine.rows, rows, once, choice, of_sources)

        def do(learner: Any) -> Any:
            if of_sources:
                rules = MergeRules(one_name=True, descriptions=choice)
                merged, refused = learner._ledger.merge(path, rules, lambda *_: None)
                return [merged.observations, merged.shared, merged.described, len(refused)]
            merged = learner.merge(path, shared="once" if once else "twice", descriptions=choice)
            return [merged.observations, merged.shared, merged.described, 0]

        what = f"merge {path.name} {'once' if once else 'twice'} {choice}{' of sources' if of_sources else ''}"
        if not bad:
            self._do(machine, rng, what, do, lambda _: after)
            return

        def damaged(learner: Any) -> Any:
            try:
                return do(learner)
            except StoreError as error:
                self.say(f"    refused: {error!r:.200}")
                self.counts["damaged on the way: refused"] += 1
                return "refused"

        then = machine.rows, "refused"
        self.operate(machine, rng, f"damaged, {what}", lambda: damaged(machine.learner), then, either=after)

    def _merge(self, machine: Machine, rng: random.Random) -> None:
        """The folder of another machine is merged, in which somebody may be writing."""
        other = rng.choice([one for one in self.machines if one is not machine])
        usable = other.made and len(other.candidates) == 1 and (other.path / "CURRENT").exists()
        if not usable or other.rows.unlisted or len(other.rows.pairs) > MOST or (len(machine.rows.pairs) > MOST):
            return
        self._merge_from(machine, rng, other.path, other.rows)

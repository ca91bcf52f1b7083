"""Single bits flipped: `python tests/faults/bit_flips.py --flips 1200`.

Of a memory that was closed, and of one left as after a crash. Each flip, on a copy of its own:

1. `check_store` looks at it, and must change nothing.
2. It is opened to write. It is refused with a StoreError, or passed over with a warning, or not noticed.
3. Where it opens, what can be seen of it must be right. Then rows are read again: one observation and one material
   are retracted, and all must be right, or refused with a StoreError.

Never may it open and be wrong in silence, nor raise anything else; and what was noticed `check_store` must find. Damage
in the very last batch of the log looks as a power cut does (FORMAT.md): where the memory is then as it was before that,
without a word, that is counted apart. An f* in a damaged checkpoint is gone, with the warning, where that of a
compaction is taken; and with a damaged compaction checkpoint, with a warning, exemplars are those that are left.
"""

from __future__ import annotations

import argparse
import random
import shutil
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from forging import log_of, named_in
from scroll_tactile_store import DamageError, StoreError, check_store

from faults.common import fingerprint, folder, parser, run, warnings_told
from faults.learners import expected, opened, perform, seen, warm
from faults.model import Operation, State, after
from faults.plans import prepare
from faults.trials import NEVER, Trials, checkpoints_every

SOME = 500  # bytes

HISTORY: tuple[Operation, ...] = (
    ("batch", tuple(("observe", name, (i, 90)) for i in range(3) for name in "abc")),
    ("retract", 2),
    ("merge", "compacted"),
    ("observe", "ü", (1, 60)),
    ("compact", 4),
    ("observe", "a", (4, 90)),
    ("observe", "ü", (4, 40)),
    ("checkpoint",),
    ("observe", "b", (5, 25)),
    ("fine_tune",),
    ("forget", "ü"),
    ("observe", "c", (3, 60)),
    ("observe", "ü", (2, 16)),
)
THEN: tuple[Operation, ...] = (("forget", "ü"), ("observe", "a", (0, 25)))  # rows are read again


@dataclass
class Memory:
    """A memory to be harmed: where it lies, what it holds, and what it held before its last batch."""

    name: str
    path: Path
    state: State
    earlier: State

    def __post_init__(self) -> None:
        newest, compaction = named_in(self.path)
        self._roles = {compaction["number"]: "compaction checkpoint", newest["number"]: "newest checkpoint"}
        self.files = sorted(file for file in self.path.rglob("*") if file.is_file() and file.stat().st_size)

    def kind_of(self, file: Path) -> str:
        """What a file of its folder is to it."""
        if file.parts[0] == "checkpoints":
            return f"{self._roles[int(file.parts[1])]}: {'metadata' if file.name == 'zarr.json' else 'values'}"
        return "log" if file.name.startswith("log-") else file.name


def prepared(home: Path, others: dict[str, State]) -> list[Memory]:
    """The same history twice: closed at its end, and left as a crash would leave it."""
    checkpoints_every(NEVER)
    path, states = home / "memory", [State()]
    learner = opened(path)
    for operation in HISTORY:
        if operation == ("checkpoint",):
            learner._ledger._write_checkpoint()
            continue
        state, result = after(states[-1], operation, others)
        assert perform(learner, operation, home) == result
        states.append(state)
    shutil.copytree(path, home / "crashed")
    log = log_of(home / "crashed")
    log.write_bytes(log.read_bytes().rstrip(b"\0") + bytes(SOME))  # of zeros ahead a mebibyte would take most flips
    learner.close()
    path.rename(home / "closed")
    return [Memory(name, home / name, states[-1], states[-2]) for name in ("closed", "crashed")]


class Flipping(Trials):
    """Flips, and what became of them."""

    def __init__(self, home: Path, seed: int) -> None:
        super().__init__(home, prepare(home))
        self.rng = random.Random(seed)
        self.memories = prepared(home, self.others)

    def once(self) -> None:
        """Flip one bit, and look."""
        memory = self.rng.choice(self.memories)
        # Half of them by bytes, which are mostly the log's, and half by files, which are mostly checkpoints'.
        sizes = [file.stat().st_size for file in memory.files] if self.tried % 2 else None
        chosen = self.rng.choices(memory.files, sizes)[0].relative_to(memory.path)
        path = self.home / "flipped"
        shutil.rmtree(path, ignore_errors=True)
        shutil.copytree(memory.path, path)
        data = bytearray((path / chosen).read_bytes())
        bit = self.rng.randrange(8 * len(data))
        data[bit // 8] ^= 1 << bit % 8
        (path / chosen).write_bytes(data)
        kind = memory.kind_of(chosen)
        where = f"flip {self.tried + 1}: {memory.name}, {chosen}, byte {bit // 8}, bit {bit % 8}"
        checked = self._checked(path, where)
        noticed = self._opened(memory, path, where, kind)
        if noticed.startswith("WRONG"):
            self.failures.append(f"{where}: opened, and {noticed}")
        if not checked and noticed.startswith(("refused", "warned")):
            self.failures.append(f"{where}: {noticed}, and check_store finds nothing")
        self.note(kind, f"{noticed}; {'found by check' if checked else 'check finds nothing'}")

    def _checked(self, path: Path, where: str) -> bool:
        before, found = fingerprint(path), True
        with self.examined(f"{where}: check_store"):
            try:
                found = bool(check_store(path))
            except StoreError:
                found = True
        if fingerprint(path) != before:
            self.failures.append(f"{where}: check_store changed something")
        return found

    def _opened(self, memory: Memory, path: Path, where: str, kind: str) -> str:
        """What comes of opening it, and of working with it where it is right."""
        warned: list[str] = []
        try:
            with warnings_told(warned.append), opened(path) as learner:
                found = seen(learner)
        except StoreError as error:
            return f"refused: {type(error).__name__}"
        except Exception as error:
            self.failures.append(f"{where}: {error!r}")
            return "not a StoreError"
        told = self._told(memory, found, kind, warned=bool(warned))
        return told + self._worked_with(path, memory.state, where) if told.endswith("right") else told

    def _told(self, memory: Memory, found: dict[str, Any], kind: str, *, warned: bool) -> str:
        """What to call what was found where it opens; WRONG, and what differs, where that must not be."""
        wanted = expected(memory.state)
        if warned and _fewer(found, wanted):
            wanted = wanted | {"names": found["names"]}
        differ = {key for key in found if found[key] != wanted[key]}
        if not differ:
            return "warned and right" if warned else "right"
        if warned and differ == {"tuned"}:
            return "warned, and f* is gone"
        if warned and differ <= {"exemplars", "pool"} and kind.startswith("compaction checkpoint"):
            return "warned, and samples could not be chosen again"
        if kind == "log" and found == expected(memory.earlier):
            return "the last batch dropped" + (", warned" if warned else ", in silence")
        return f"WRONG, {'warned' if warned else 'silent'}: {sorted(differ)}"

    def _worked_with(self, path: Path, state: State, where: str) -> str:
        """Read rows again, to take two back; what to add to the outcome. It must open afterwards as it did before."""
        later = ""
        try:
            with warnings_told(lambda text: None), opened(path) as learner:
                for operation in (("retract", self.rng.choice(state.loose)), *THEN):
                    then, foretold = after(state, operation, self.others)
                    try:
                        result = perform(learner, operation, self.home)
                    except StoreError as error:
                        later, result, then, foretold = f", later {type(error).__name__}", None, state, None
                    if result == "ObservationError" != foretold:
                        # For want of a row: nothing was changed, and the caller is told so.
                        later, then, foretold = ", later ObservationError", state, result
                    self._require(where, f"{operation} gave {result}", learner, then, right=result == foretold)
                    state = then
            with warnings_told(lambda text: None), opened(path) as learner:
                self._require(where, "opened at last", learner, state, right=True)
        except DamageError as error:
            # A touch that takes the place of one that was taken back may be one whose row is damaged.
            again = self.examined(f"{where}: could be opened, and no more after a retraction")
            with again, warnings_told(lambda text: None), opened(path) as learner:
                learner.digest()
            return f"{later}, later {type(error).__name__}"
        except Exception as error:
            self.failures.append(f"{where}: could be opened, and no more after a retraction: {error!r}")
            return ", LATER UNREADABLE"
        return later

    def _require(self, where: str, what: str, learner: Any, state: State, *, right: bool) -> None:
        found, wanted = seen(learner), expected(state)
        known = {"names": None} if _fewer(found, wanted) else {}
        if not right or found | known != wanted | known:
            self.failures.append(f"{where}: then wrong: {what}")


def _fewer(found: dict[str, Any], wanted: dict[str, Any]) -> bool:
    """Whether touches are no longer known by their names, as of damaged rows, and none is that is not there."""
    return all(set(names) <= set(wanted["names"].get(touch, ())) for touch, names in found["names"].items())


def main(options: argparse.Namespace) -> dict[str, Any]:
    """As many flips as asked."""
    warm()
    with folder(options, in_memory=True) as home:
        flipping = Flipping(home, options.seed)
        for number in range(8 if options.quick else options.flips):
            flipping.once()
            flipping.tell(f"{number + 1} flips" if number % 100 == 99 else "")
    total = sum(flipping.outcomes.values(), Counter[str]())
    return {
        "flips": flipping.tried,
        "outcomes": dict(sorted(total.items())),
        "by file": {kind: dict(sorted(counted.items())) for kind, counted in sorted(flipping.outcomes.items())},
        "failures": flipping.failures,
    }


if __name__ == "__main__":
    run("bit_flips", parser(__doc__, flips=1200).parse_args(), main)

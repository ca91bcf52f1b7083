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
import hashlib
import random
import shutil
import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from forging import log_of, named_in

import scroll_tactile.persistence.open_memory
from faults.common import folder, parser, progress, run, warnings_told
from faults.model import Operation, Other, State, after, expected, opened, perform, seen, warm
from faults.plans import prepare
from store import DamageError, StoreError

try:
    from store import check_store
except ImportError:  # a release without it
    check_store = None  # type: ignore[assignment]

NEVER = 2**40
SOME = 500  # bytes

HISTORY: tuple[Operation, ...] = (
    ("batch", tuple(("observe", name, (i, 90)) for i in range(3) for name in "abc")),
    ("retract", 2),
    ("merge", "compacted", "twice"),
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


@dataclass
class Memory:
    """A memory to be harmed: where it lies, what it holds, and what it held before."""

    name: str
    path: Path
    state: State
    earlier: list[State]
    files: list[Path] = field(default_factory=list)
    roles: dict[str, str] = field(default_factory=dict)


def prepared(home: Path, others: dict[str, Other]) -> list[Memory]:
    """The same history twice: closed at its end, and left as a crash would leave it."""
    scroll_tactile.persistence.open_memory.SNAPSHOT_EVERY = NEVER
    path, states = home / "memory", [State()]
    learner = opened(path)
    for operation in HISTORY:
        if operation == ("checkpoint",):
            learner._ledger._snapshot()
            continue
        state, result = after(states[-1], operation, others)
        assert perform(learner, operation, home) == result
        states.append(state)
    shutil.copytree(path, home / "crashed")
    log = log_of(home / "crashed")
    log.write_bytes(log.read_bytes().rstrip(b"\0") + bytes(SOME))  # of zeros ahead a mebibyte would take most flips
    learner.close()
    path.rename(home / "closed")
    memories = [Memory(name, home / name, states[-1], states[:-1]) for name in ("closed", "crashed")]
    for memory in memories:
        memory.roles = roles_of(memory.path)
        memory.files = sorted(file for file in memory.path.rglob("*") if file.is_file() and file.stat().st_size)
    return memories


def roles_of(path: Path) -> dict[str, str]:
    """Folder of a checkpoint → what it is to the memory."""
    newest, compaction = named_in(path)
    return {f"{compaction['number']:08d}": "compaction checkpoint", f"{newest['number']:08d}": "newest checkpoint"}


def kind_of(file: Path, roles: dict[str, str]) -> str:
    """What a file is to the memory."""
    if file.parts[0] == "checkpoints":
        return f"{roles[file.parts[1]]}: {'metadata' if file.name == 'zarr.json' else 'values'}"
    return "log" if file.name.startswith("log-") else file.name


def fingerprint(path: Path) -> dict[str, str]:
    """The contents of all files."""
    return {
        str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(path.rglob("*"))
        if file.is_file()
    }


class Flipping:
    """Flips, and what became of them."""

    def __init__(self, home: Path, seed: int) -> None:
        self.home, self.rng = home, random.Random(seed)
        self.others = prepare(home)
        self.memories = prepared(home, self.others)
        self.outcomes: dict[str, Counter[str]] = {}
        self.failures: list[str] = []
        self.flips = 0

    def once(self) -> None:
        """Flip one bit, and look."""
        memory = self.rng.choice(self.memories)
        # Half of them by bytes, which are mostly the log's, and half by files, which are mostly checkpoints'.
        sizes = [file.stat().st_size for file in memory.files] if self.flips % 2 else None
        file = self.rng.choices(memory.files, sizes)[0]
        bit = self.rng.randrange(8 * file.stat().st_size)
        path = self.home / "flipped"
        shutil.rmtree(path, ignore_errors=True)
        shutil.copytree(memory.path, path)
        target = path / file.relative_to(memory.path)
        data = bytearray(target.read_bytes())
        data[bit // 8] ^= 1 << bit % 8
        target.write_bytes(data)
        self.flips += 1
        kind = kind_of(file.relative_to(memory.path), memory.roles)
        where = f"flip {self.flips}: {memory.name}, {file.relative_to(memory.path)}, byte {bit // 8}, bit {bit % 8}"
        checked = self._checked(path, where)
        noticed = self._opened(memory, path, where, kind)
        if checked is not None and not checked and noticed.startswith(("refused", "warned")):
            self.failures.append(f"{where}: {noticed}, and check_store finds nothing")
        told = "" if checked is None else "; found by check" if checked else "; check finds nothing"
        self.outcomes.setdefault(kind, Counter())[noticed + told] += 1

    def _checked(self, path: Path, where: str) -> bool | None:
        if check_store is None:
            return None
        before = fingerprint(path)
        try:
            found = bool(check_store(path))
        except StoreError:
            found = True
        except Exception as error:
            self.failures.append(f"{where}: check_store raised {error!r}")
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
        told = self._judged(memory, found, bool(warned), kind)
        if told is None:
            told_of = expected(memory.state)
            differ = [key for key in found if found[key] != told_of[key]]
            self.failures.append(f"{where}: opened, {'warned' if warned else 'silent'}, and wrong in {differ}")
            return "WRONG"
        outcome, state = told
        return outcome if state is None else outcome + self._worked_with(path, state, where)

    def _judged(
        self, memory: Memory, found: dict[str, Any], warned: bool, kind: str
    ) -> tuple[str, State | None] | None:
        """What to call what was found, and the state to go on from, if any; None where it is wrong."""
        told = expected(memory.state) | ({"names": found["names"]} if warned and _fewer(found, memory.state) else {})
        if found == told:
            return "warned and right" if warned else "right", memory.state
        differ = {key for key in found if found[key] != told[key]}
        if warned and differ == {"tuned"}:
            return "warned, and f* is gone", None
        if warned and differ <= {"exemplars", "pool"} and kind.startswith("compaction checkpoint"):
            return "warned, and samples could not be chosen again", None
        if kind == "log" and found == expected(memory.earlier[-1]):
            return "the last batch dropped" + (", warned" if warned else ", in silence"), None
        return None

    def _worked_with(self, path: Path, state: State, where: str) -> str:
        """Read rows again, to take two back; what to add to the outcome. It must open afterwards as it did before."""
        loose, later = self.rng.choice(state.loose), ""
        try:
            with warnings_told(lambda text: None), opened(path) as learner:
                for operation in (("retract", loose.sequence), ("forget", "ü"), ("observe", "a", (0, 25))):
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
            try:
                with warnings_told(lambda text: None), opened(path) as learner:
                    learner.digest()
            except Exception as still:
                self.failures.append(f"{where}: could be opened, and no more after a retraction: {still!r}")
            return f"{later}, later {type(error).__name__}"
        except Exception as error:
            self.failures.append(
                f"{where}: could be opened, and no more after one of its observations was retracted: {error!r}"
            )
            return ", LATER UNREADABLE"
        return later

    def _require(self, where: str, what: str, learner: Any, state: State, *, right: bool) -> None:
        found = seen(learner)
        known = {"names": None} if _fewer(found, state) else {}
        if not right or found | known != expected(state) | known:
            self.failures.append(f"{where}: then wrong: {what}")


def _fewer(found: dict[str, Any], state: State) -> bool:
    """Whether touches are no longer known by their names, as of damaged rows, and none is that is not there."""
    told = expected(state)["names"]
    return all(set(names) <= set(told.get(touch, ())) for touch, names in found["names"].items())


def main(options: argparse.Namespace) -> dict[str, Any]:
    """As many flips as asked."""
    flips = 8 if options.quick else options.flips
    warm()
    with folder(options, in_memory=True) as home:
        flipping = Flipping(home, options.seed)
        for _ in range(flips):
            flipping.once()
            if flipping.flips % 100 == 0:
                progress(f"{flipping.flips} flips, {len(flipping.failures)} failures")
    total: Counter[str] = Counter()
    for counted in flipping.outcomes.values():
        total.update(counted)
    return {
        "flips": flipping.flips,
        "check_store": "there" if check_store is not None else "not there",
        "outcomes": dict(sorted(total.items())),
        "by file": {kind: dict(sorted(counted.items())) for kind, counted in sorted(flipping.outcomes.items())},
        "failures": flipping.failures,
    }


if __name__ == "__main__":
    run("bit_flips", parser(__doc__, flips=1200).parse_args(), main)

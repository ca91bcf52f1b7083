"""The steps of a run, in order: how its sources are cut, what is noted of them, and what a run before left."""

from __future__ import annotations

import logging
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path

from scroll_tactile_store.files import remove_tree

from scroll_tactile.clients.learning.addresses import is_memory
from scroll_tactile.clients.learning.runfile import RunFile
from scroll_tactile.clients.learning.sources import Refused
from scroll_tactile.clients.learning.workers.jobs import LearnJob, Made, Making
from scroll_tactile.errors import InputError, MismatchError

__all__ = ["NOTES", "Step", "Steps"]

logger = logging.getLogger(__name__)

JOBS_A_WORKER = 4  # at least, so that all have something to do to the end; a merge costs what 50 touches do
MOST_SOURCES = 1024  # of a step: what is lost with a worker
MOST_STEP_BYTES = 2**28  # of their files, where these are here
NOTES = "run.json"
MOST_TRIES = 20  # of a job of one source whose worker died: where one dies each second, nearly all end sooner
NOTING = 20  # times as long as noting took, nothing is noted again: of a million sources it takes seconds


@dataclass(eq=False)
class Step:
    """Sources that come in together, in the order of the run: recordings, or one memory.

    made: what a worker made of recordings; None before. failed: sources of which something was not learned. tries: how
    often a worker ended with it.
    """

    sources: tuple[str, ...]
    memory: bool = False
    made: Made | None = None
    failed: set[str] = field(default_factory=set)
    tries: int = 0

    def source_of(self, row: int) -> str:
        """The source of a row of what was made."""
        assert self.made is not None
        return self.sources[min(bisect_right([*accumulate(self.made.rows)], row - 1), len(self.sources) - 1)]


class Steps:
    """The steps of a run that are still to come in, in order, and the notes beside their packed memories.

    folder: of the run. afresh: whether nothing of what was learned is there any more. learned: sources of which all has
    come in. waiting: steps that a worker is to learn. range_problem: of the first touch that has one.

    Raises InputError for notes of another run, or damaged ones, and for what is in the way.
    """

    def __init__(self, folder: Path, making: Making, *, afresh: bool) -> None:
        self.folder, self._making = folder, making
        plan = {"run": "fleet", "identity": making.identity.to_json(), "options": repr(making.options)}
        self._notes = RunFile(folder / NOTES, plan)
        self._made: dict[tuple[str, ...], Made] = {}
        self._noted_at, self._noting, self._unnoted = 0.0, 0.0, False
        self._read()
        if afresh:
            self.learned.clear()
        self.left: list[tuple[str, bool]] = []
        self.steps: deque[Step] = deque()
        self.waiting: deque[Step] = deque()
        for path in folder.iterdir():
            if path.suffix == ".part" and (path.is_symlink() or not path.is_file()):
                raise InputError(f"{path} is no file, and in the way of one that this run writes: move it away")
            if path.name.startswith("learned-") and path.suffix == ".partial":  # of a worker that died
                remove_tree(path)

    def _read(self) -> None:
        notes = self._notes.notes
        learned, problem = notes.get("learned", []), notes.get("range_problem")
        try:
            if not isinstance(learned, list) or not all(isinstance(source, str) for source in learned):
                raise TypeError(f"learned: {learned!r:.80}")
            if not isinstance(problem, str | None):
                raise TypeError(f"range_problem: {problem!r:.80}")
            for noted in notes.get("made", []):
                sources, made = tuple(noted["sources"]), Made.from_json(noted["made"])
                made.require(self.job(sources))
                self._made[sources] = made
        except (MismatchError, AttributeError, KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"expected what a run learned in {self._notes.path}; it cannot be read: {error!r:.200}. Move "
                f"{self.folder} away, and begin with add=True (--add): what the memory has it does not learn twice"
            ) from error
        self.learned: set[str] = set(learned)
        self.range_problem: str | None = problem

    def job(self, sources: tuple[str, ...]) -> LearnJob:
        """What a worker is handed over."""
        return LearnJob(self._making, sources, str(self.folder))

    def begin(self, found: Sequence[str]) -> list[Refused]:
        """Look at the sources that an earlier run did not learn; those that give no answer."""
        refused = []
        for source in found:
            if source in self.learned:
                continue
            try:
                self.left.append((source, is_memory(source, self._making.patience)))
            except TimeoutError as error:
                refused.append(Refused(source, f"it cannot be looked at: {error!s:.300}"))
        return refused

    def cut(self, workers: int) -> None:
        """Cut what is left into steps for so many workers; what an earlier run made of one stays one."""
        recordings = sum(not memory for _, memory in self.left)
        most = max(1, min(MOST_SOURCES, -(-recordings // (JOBS_A_WORKER * workers))))
        made = {sources[0]: sources for sources in self._made}
        names = [source for source, _ in self.left]
        group: list[str] = []
        place = size = 0
        while place < len(names):
            source, memory = self.left[place]
            whole = made.get(source, ())
            if whole != tuple(names[place : place + len(whole)]):
                whole = ()
            own = 0 if memory else _bytes_of(source)
            if group and (memory or whole or len(group) >= most or size + own > MOST_STEP_BYTES):
                self.steps.append(Step(tuple(group)))
                group, size = [], 0
            if whole:
                self.steps.append(Step(whole, made=self._made[whole]))
            elif memory:
                self.steps.append(Step((source,), memory=True))
            else:
                group.append(source)
                size += own
            place += max(1, len(whole))
        if group:
            self.steps.append(Step(tuple(group)))
        self.waiting = deque(step for step in self.steps if not step.memory and step.made is None)

    def learned_by(self, step: Step, made: Made) -> None:
        """Take note of what a worker made. Raises MismatchError for what it cannot have made."""
        if not isinstance(made, Made):
            raise MismatchError(f"expected what a job made; who runs the jobs gave {type(made).__name__}")
        made.require(self.job(step.sources))
        step.made = made
        self._made[step.sources] = made
        self._note()

    def came_in(self, step: Step) -> set[str]:
        """The first step is in the memory, durably; the sources of which all is."""
        assert self.steps.popleft() is step
        learned = set(step.sources) - step.failed
        self.learned |= learned
        made = self._made.pop(step.sources, None)
        if step.made is not None:
            self.range_problem = self.range_problem or step.made.range_problem
        self._note()
        if made is not None and made.path:
            Path(made.path).unlink(missing_ok=True)
        return learned

    def again(self, step: Step, tries: int) -> bool:
        """Have a step learned again, by halves where it has several sources; False where it was tried too often."""
        self._made.pop(step.sources, None)
        step.made = None
        if halves := self.job(step.sources).halves():
            place, parts = self.steps.index(step), [Step(half.sources) for half in halves]
            del self.steps[place]
            for part in reversed(parts):
                self.steps.insert(place, part)
            self.waiting.extendleft(reversed(parts))
            return True
        step.tries += tries
        if step.tries < MOST_TRIES:
            self.waiting.appendleft(step)
        return step.tries < MOST_TRIES

    def _note(self, *, now: bool = False) -> None:
        """Note what was learned, unless that was just now: what a kill leaves unnoted is learned again, and once."""
        begun = time.monotonic()
        self._unnoted = True
        if not now and begun < self._noted_at + NOTING * self._noting:
            return
        self._notes.notes |= {
            "learned": sorted(self.learned),
            "made": [{"sources": sources, "made": made.to_json()} for sources, made in self._made.items()],
        }
        self._notes.note("range_problem", self.range_problem)
        self._noted_at = time.monotonic()
        self._noting, self._unnoted = self._noted_at - begun, False

    def leave(self) -> None:
        """Note what is not noted yet, however the run ends."""
        if self._unnoted:
            try:
                self._note(now=True)
            except InputError as error:
                logger.warning("%s", error)

    def end(self) -> None:
        """Note that all is learned, and remove what packed memories are left."""
        self._made, self.range_problem = {}, None
        self._note(now=True)
        for path in self.folder.iterdir():
            if path.name.startswith("learned-") and path.suffix in (".part", ".partial"):
                remove_tree(path)


def _bytes_of(source: str) -> int:
    path = Path(source)
    return path.stat().st_size if path.is_file() else 0

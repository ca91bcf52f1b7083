"""Learner calls and live sessions in eight threads on one memory: `python tests/faults/threads.py --minutes 60`.

Every answer must be that of the memory after one of the rows that it had between the call and its return; all that is
said of a live touch, that of one row that it had while the call lasted in which the touch began. Each round has a
memory of its own and some seconds; then the journal tells which states there were, and each answer is looked up.

As strict as what is promised. Digest, materials, descriptions and exemplars are functions of the state. So is the
typicality in every prediction, to the bit, for all touches are kept and of one length; and what the readouts are of:
the rows of each material and their sums, to the integer. Probability and novelty rest on a calibration that may lag
behind (README), so of these it is asked that they are of exactly the materials of that state, and that the same model
says the same again, to the bit, while others go on. Settled at the end, all is what a memory says that observed the
same in one thread.

In every other round few touches are sampled and few changes are followed, as if there were thousands. What is solved
for comes in another order then, and the bits of probability and novelty depend on that.

Nothing may be raised but what is named here for each call. A call that takes longer than two minutes hangs; a machine
that stands still meanwhile does not count.
"""

from __future__ import annotations

import argparse
import copy
import faulthandler
import random
import sys
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from scroll_tactile_store import CompactedError

import scroll_tactile.learner
import scroll_tactile.memory.state
import scroll_tactile.prediction.fitting
import scroll_tactile.prediction.predictor
from faults.common import folder, parser, progress, run
from faults.truth import LENGTH, SETTINGS, SKIN, Array, Learned, LiveTold, Told, Truth, learned_of
from scroll_tactile import TactileLearner
from scroll_tactile.errors import DescriptionError, InputError, ObservationError, UnknownMaterialError
from scroll_tactile.matching.likelihood import Likelihood
from scroll_tactile.results import Prediction
from scroll_tactile.signals.levels import LEVELS
from scroll_tactile.signals.stream import Stream
from scroll_tactile.statistics.sample import TouchSample

SHORT = 12  # readings of the beginning of a touch
PAUSE = 30  # readings between touches; two seconds before the first of a session that finds them itself
MATERIALS, FIRST = "abcdef", "abcd"
FEWEST, MOST = 24, 56  # touches in the memory
NEW_AGAIN = 0.2  # of observations are of a material that comes and goes
SAID = ({"silk": 1.0}, {"silk": 0.25, "wool": 0.75}, {"wool": 1.0})
TAKEN_OUT = 8  # touches to calibrate on, in place of 96: many short fits, and not a few long ones
TICK, HANGS = 0.1, 1200  # seconds between two looks; looks that a call may last
SHOWN = 20  # failures of a round
FEW = 2  # changes and touches, in place of a thousand


def touch(material: str, seed: int, readings: int = LENGTH) -> Array:
    """A touch: its material's level and rhythm, in noise."""
    rng, place = np.random.default_rng([ord(material), seed]), MATERIALS.index(material)
    waves = np.sin(np.arange(readings)[:, None] * (0.2 + 0.15 * place) + rng.uniform(0, 6, SKIN.channels))
    noisy = 0.35 + 0.08 * place + 0.1 * waves + 0.03 * rng.standard_normal((readings, SKIN.channels))
    return np.asarray(noisy.clip(0, 1))


def rest(seed: int, readings: int) -> Array:
    """Readings while nothing touches."""
    return np.asarray(0.1 + 0.004 * np.random.default_rng(seed).standard_normal((readings, SKIN.channels)))


@dataclass
class Round:
    """A memory under eight threads, until `stop`. It has no lock: each note in it is a single step of Python."""

    learner: TactileLearner
    reader: TactileLearner
    others: list[Path]
    seed: int
    stop: threading.Event = field(default_factory=threading.Event)
    failures: list[str] = field(default_factory=list)
    told: list[Told | LiveTold] = field(default_factory=list)
    readings: dict[bytes, Array] = field(default_factory=dict)
    groups: list[tuple[int, int]] = field(default_factory=list)
    calls: list[str] = field(default_factory=list)
    busy: dict[str, tuple[str, int]] = field(default_factory=dict)
    looks: int = 0
    acknowledged: list[int] = field(default_factory=list)
    made: Iterator[int] = field(default_factory=lambda: count(1))

    def fresh(self, material: str) -> Array:
        """A touch that was never made before."""
        return touch(material, 1000 * self.seed + next(self.made))


def row_of(learner: TactileLearner) -> int:
    """The last row that its memory has taken in, or is just taking in."""
    return learner._ledger._memory.sequence


def learned_by(model: Any) -> Learned:
    """What the readouts of a model are of."""
    found = {}
    for scale, readout in model.readouts.items():
        found[int(scale)] = learned_of(readout.names, readout.counts, readout.sums)
    return found


LOCAL = threading.local()


@contextmanager
def watched(fail: Callable[[str], None]) -> Iterator[None]:
    """While it lasts each answer is asked for twice of the model that gives it, which must stay as it is."""
    own = scroll_tactile.prediction.predictor.answer

    def answer(model: Any, *rest: Any) -> Prediction:
        before, said = learned_by(model), own(model, *rest)
        again = own(model, *rest)
        if learned_by(model) != before:
            fail("a model that an answer is of was changed meanwhile: it is of other touches")
        elif again != said:
            fail(f"a model said {said}, and asked again {again}")
        LOCAL.learned = before
        return said

    with patch.object(scroll_tactile.prediction.predictor, "answer", answer):
        yield


class Worker:
    """One thread: random calls of its kinds, until the round is over; learner: the one that it calls."""

    def __init__(self, round_: Round, number: int, kinds: Sequence[str], learner: TactileLearner | None = None) -> None:
        self.round, self.kinds, self.name = round_, kinds, f"{number}"
        self.learner = learner or round_.learner
        self.rng = random.Random(f"{round_.seed} {number}")
        self.inside = False

    def run(self) -> None:
        """Call after call."""
        while not self.round.stop.is_set():
            kind = self.rng.choice(self.kinds)
            self.round.busy[self.name] = kind, self.round.looks
            try:
                self.call(kind)
            except Exception as error:  # what a call may raise is caught there
                frames = traceback.extract_tb(error.__traceback__)[-4:]
                at = ", ".join(f"{Path(frame.filename).name}:{frame.lineno}" for frame in frames)
                self.round.failures.append(f"{kind}: {type(error).__name__}: {error} ({at})")
            self.round.calls.append(kind)
            self.round.busy.pop(self.name, None)

    def call(self, kind: str) -> None:
        """A call of a kind: a method's, or one of `ASKED`."""
        if kind in ASKED:
            of, ask = ASKED[kind]
            since = row_of(self.learner)
            # A reader may be behind.
            with suppress(CompactedError) if self.learner is self.round.reader else nullcontext():
                what = ask(self.learner)
                self.round.told.append(Told(of, since, row_of(self.learner), what, self.inside))
        else:
            getattr(self, kind)()

    def material(self) -> str:
        """A material: now and then one that comes and goes."""
        return self.rng.choice(MATERIALS[len(FIRST) :] if self.rng.random() < NEW_AGAIN else FIRST)

    def probe(self, readings: int = LENGTH) -> Array:
        """A touch that is in no memory."""
        return touch(self.rng.choice(FIRST), self.rng.randrange(10**6), readings)

    @property
    def full(self) -> bool:
        """Whether there are enough touches in the memory."""
        return sum(self.learner.materials.values()) > MOST

    @contextmanager
    def together(self) -> Iterator[None]:
        """In the block rows are made that others see at once."""
        with self.learner._ledger.lock:
            before = row_of(self.learner)
            yield
            after = row_of(self.learner)
            self.round.groups.append((before + 1, after))
            self.round.acknowledged.append(after)

    # What changes the memory

    def observe(self) -> None:
        """A touch more; where there are enough, one is retracted in its place."""
        if self.full:
            self.retract()
            return
        material = self.material()
        readings = self.round.fresh(material)
        self.round.readings[self.learner.stream(readings).key] = readings
        receipt = self.learner.observe(material, readings)
        if not self.inside:
            self.round.acknowledged.append(receipt.sequence)

    def _loose(self) -> int | None:
        if sum(self.learner.materials.values()) < FEWEST:
            return None
        own = [one for one in self.learner.observations() if one.state == "kept"]
        return self.rng.choice(own).sequence if own else None

    def retract(self) -> None:
        """One less."""
        if (sequence := self._loose()) is not None:
            with suppress(ObservationError):  # another thread was faster, or compacted it
                self.learner.retract(sequence)

    def forget(self) -> None:
        """All of a material that comes and goes."""
        with suppress(ObservationError, UnknownMaterialError):
            self.learner.forget(self.rng.choice(MATERIALS[len(FIRST) :]))

    def relabel(self) -> None:
        """One under another name."""
        if (sequence := self._loose()) is not None:
            with self.together(), suppress(ObservationError, InputError):  # it may have that name already
                self.learner.relabel(sequence, self.material())

    def describe(self) -> None:
        """What a material is made of."""
        self.learner.describe(self.material(), self.rng.choice((None, *SAID)))

    def batch(self) -> None:
        """Several at once, with questions among them."""
        with self.together():
            self.inside = True
            try:
                with self.learner.batch():
                    for _ in range(self.rng.randrange(1, 5)):
                        self.call(self.rng.choice(("observe", "observe", "retract", "predict", "digest")))
            finally:
                self.inside = False

    def merge(self) -> None:
        """Another memory's touches."""
        if not self.full:
            with self.together():
                self.learner.merge(self.rng.choice(self.round.others))

    def compact(self) -> None:
        """Give up what is old."""
        self.learner.compact(keep=self.rng.choice((20, 30, 40)))

    # What asks

    def predict(self) -> None:
        """One touch, or its beginning."""
        self._predict([self.probe(self.rng.choice((LENGTH, LENGTH, SHORT)))])

    def several(self) -> None:
        """Several touches of one thing."""
        material = self.rng.choice(FIRST)
        self._predict([touch(material, self.rng.randrange(10**6)) for _ in range(3)])

    def compose(self) -> None:
        """What a touch is made of."""
        readings = self.probe()
        with suppress(DescriptionError):  # nothing was described
            self._predict([readings], lambda *_: self.learner.compose(readings).prediction)

    def _predict(self, touches: Sequence[Array], ask: Callable[..., Prediction] | None = None) -> None:
        since, said = row_of(self.learner), (ask or self.learner.predict)(*touches)
        until, streams = row_of(self.learner), [self.learner.stream(one) for one in touches]
        self.round.told.append(Told("prediction", since, until, said, self.inside, streams, LOCAL.learned))

    def settle(self) -> None:
        """All fitted to what is there."""
        self.learner.settle()

    def refresh(self) -> None:
        """A reader takes in what was acknowledged."""
        acknowledged = max(self.round.acknowledged)
        self.learner.refresh()
        if row_of(self.learner) < acknowledged:
            self.round.failures.append(
                f"a reader refreshed to row {row_of(self.learner)}; {acknowledged} was acknowledged"
            )

    # Live

    def live_manual(self) -> None:
        """Touches that are begun and ended by whoever pushes."""
        learner = self.round.reader if self.rng.random() < 0.2 else self.round.learner
        with learner.live(contact="manual", risk=self.rng.choice((0.05, 0.2, 1e-9))) as live:
            for number in range(self.rng.randrange(1, 5)):
                if number and self.rng.random() < 0.4:
                    live.again()
                since = row_of(learner)
                now = live.begin()
                window, said = (since, row_of(learner)), []
                readings, first = self.probe(), 0
                while first < LENGTH:
                    size = self.rng.randrange(1, 9)
                    now = live.push(readings[first : first + size])
                    said += [] if now.prediction is None else [(now.prediction, LOCAL.learned)]
                    first += size
                ended = live.end().touches[0]
                self._tell_live(window, said, ended)
                if self.rng.random() < 0.3:
                    self._observe_live(live.touch)

    def live_auto(self) -> None:
        """Touches that the session finds."""
        learner = self.learner
        with learner.live(false_contacts=1.0) as live:
            live.push(rest(self.rng.randrange(10**6), 110))
            window, said = (0, 0), []
            for _ in range(self.rng.randrange(1, 4)):
                material, seed = self.rng.choice(FIRST), self.rng.randrange(10**6)
                rows, first = np.concatenate([touch(material, seed), rest(seed, PAUSE)]), 0
                under_way = False
                while first < len(rows):
                    size, since = self.rng.randrange(1, 15), row_of(learner)
                    now = live.push(rows[first : first + size])
                    first += size
                    if not under_way and (now.contact or now.touches):
                        window, said = (since, row_of(learner)), []
                    if now.prediction is not None and now.contact:
                        said.append((now.prediction, LOCAL.learned))
                    for ended in now.touches:
                        self._tell_live(window, said, ended)
                        window, said = (since, row_of(learner)), []
                    under_way = now.contact

    def _tell_live(self, window: tuple[int, int], said: list[tuple[Prediction, Any]], ended: Any) -> None:
        live = LiveTold([Told("prediction", *window, what, learned=learned) for what, learned in said])
        streams = [*ended.earlier, ended.stream]
        live.said.append(Told("prediction", *window, ended.prediction, streams=streams, learned=LOCAL.learned))
        self.round.told.append(live)

    def _observe_live(self, stream: Stream | None) -> None:
        if stream is None or self.full or len(stream) != LENGTH:
            return
        self.round.readings[stream.key] = stream.readings.astype(np.float64)
        self.round.acknowledged.append(self.round.learner.observe(self.rng.choice(FIRST), stream).sequence)


ROWS: dict[int, int] = {}  # of a touch at each scale, once that is known
ROLES: tuple[tuple[str, ...], ...] = (
    ("observe",) * 6 + ("retract", "retract", "forget", "describe", "predict"),
    ("observe",) * 4 + ("relabel", "batch", "merge", "compact", "predict", "forget"),
    ("predict", "predict", "predict", "several", "observe"),
    ("predict", "digest", "materials", "descriptions", "exemplars", "copied"),
    ("predict", "compose", "compose", "settle", "several", "model"),
    ("live_manual",),
    ("live_auto", "live_manual"),
    ("refresh", "refresh", "predict", "digest", "materials", "exemplars"),  # a reader of the same memory
)


def counted_by(model: Any) -> dict[str, int]:
    """The touches of each material that a model is of."""
    scale, learned = min(learned_by(model).items())
    return {name: rows // ROWS[scale] for name, (rows, _) in sorted(learned.items())}


# By the kind of a call what it says, and the call.
ASKED: dict[str, tuple[str, Callable[[TactileLearner], Any]]] = {
    "digest": ("digest", lambda learner: learner.digest()),
    "copied": ("digest", lambda learner: copy.deepcopy(learner).digest()),
    "materials": ("materials", lambda learner: learner.materials),
    "descriptions": ("descriptions", lambda learner: learner.descriptions),
    "exemplars": ("exemplars", lambda learner: learner.exemplars),
    "model": ("materials", lambda learner: counted_by(learner.model())),  # fitted for who asks
}


def begun(home: Path, seed: int) -> Round:
    """A memory that knows some materials, a reader of it, and others that are to be merged."""
    learner = TactileLearner.open(home / "memory", **SETTINGS)
    round_ = Round(learner, learner, [], seed)
    worker = Worker(round_, -1, ())
    for _ in range(7):
        for material in FIRST:
            readings = round_.fresh(material)
            round_.readings[learner.stream(readings).key] = readings
            round_.acknowledged.append(learner.observe(material, readings).sequence)
    for number in range(3):
        round_.others.append(home / f"other-{number}")
        with TactileLearner.open(round_.others[-1], **SETTINGS) as other:
            for _ in range(3):
                material = worker.material()
                readings = round_.fresh(material)
                round_.readings[other.observe(material, readings).key] = readings
    codes = learner._predictor.extractor.codes(learner._predictor.extractor.image(learner.stream(touch("a", 0))))
    ROWS.update({int(scale): len(rows) for scale, rows in codes.items()})
    round_.reader = TactileLearner.open(home / "memory", mode="read")
    return round_


def under_threads(round_: Round, seconds: float, threads: int) -> bool:
    """Have them all call until the time is over; whether they all came to an end."""
    workers = []
    for number in range(threads):
        kinds = ROLES[number % len(ROLES)]
        workers.append(Worker(round_, number, kinds, round_.reader if "refresh" in kinds else None))
    running = [threading.Thread(target=worker.run, name=f"stress {worker.name}", daemon=True) for worker in workers]
    for thread in running:
        thread.start()
    end = time.monotonic() + seconds
    try:
        while any(thread.is_alive() for thread in running):
            time.sleep(TICK)
            round_.looks += 1
            if time.monotonic() > end or len(round_.failures) >= SHOWN:
                round_.stop.set()
            hung = {name: kind for name, (kind, since) in dict(round_.busy).items() if round_.looks - since > HANGS}
            if hung:
                faulthandler.dump_traceback()
                faulthandler.dump_traceback_later(60, exit=True)  # Python would wait for pools whose threads hang
                round_.failures.append(f"hang for {TICK * HANGS:g} s: {hung}")
                return False
    except KeyboardInterrupt:
        round_.stop.set()
        for thread in running:
            thread.join(TICK * HANGS)
        raise
    return True


def looked_up(round_: Round) -> tuple[list[str], Counter[str]]:
    """What was said that is of no state, and how many answers were looked up."""
    store = round_.learner._ledger.store
    assert store is not None
    truth = Truth(list(store.heads()), round_.readings, round_.groups)
    wrong, counted = [], Counter[str]()
    for told in round_.told:
        parts = [told] if isinstance(told, Told) else told.said
        first, what = parts[0], "a live touch" if isinstance(told, LiveTold) else parts[0].of
        counted[what] += len(parts)
        wrong += [unsound for part in parts if (unsound := part.unsound()) is not None]
        rows = list(truth.between(first.since, first.until, inside=first.inside))
        if not any(all(part.is_of(truth, row) for part in parts) for row in rows):
            anywhere = [row for row in range(len(truth.states)) if all(part.is_of(truth, row) for part in parts)]
            where = f"of rows {anywhere[:5]}" if anywhere else "of no state that there was"
            differ = [part.differs(truth, row) for row in rows[:1] for part in parts]
            wrong.append(f"{what}: {where}, and not of {first.since} to {first.until}: {differ}")
    return wrong, counted


def at_the_end(round_: Round) -> list[str]:
    """What is wrong when all threads have ended: the memory must be that of what was observed, in any order."""
    learner, wrong = round_.learner, []
    store = learner._ledger.store
    assert store is not None
    truth = Truth(list(store.heads()), round_.readings, round_.groups)
    alone = TactileLearner(**SETTINGS)
    for material, key in truth.states[-1].pairs:
        alone.observe(material, round_.readings[key])
    if learner.digest() != alone.digest():
        wrong.append("at the end the digest is not that of what was observed")
    probes = [touch(material, 7, readings) for material in FIRST for readings in (LENGTH, SHORT)]
    learner.settle()
    said = [learner.predict(probe) for probe in probes]
    if said != [alone.predict(probe) for probe in probes]:
        wrong.append("at the end, settled, it says other than a memory that observed the same in one thread")
    round_.reader.refresh()
    if round_.reader.digest() != alone.digest():
        wrong.append("at the end a reader sees another digest")
    return wrong


@contextmanager
def short_fits() -> Iterator[None]:
    """While it lasts a fit takes few touches out, and all have the tables of one set of touches: they take longest."""
    of_one = Likelihood(np.full(LEVELS, 4.0), np.full(LEVELS, 1 / LEVELS))
    with ExitStack() as patched:
        patched.enter_context(patch.object(scroll_tactile.prediction.fitting, "MOST_HELD_OUT", TAKEN_OUT))
        patched.enter_context(patch("scroll_tactile.matching.likelihood._table", lambda *of: of_one.table(of[-1])))
        yield


class FewSampled(TouchSample):
    """Calibrated on so few touches that not all materials are among them."""

    def __init__(self, capacity: int = FEW) -> None:
        super().__init__(capacity)


@contextmanager
def few_sampled() -> Iterator[None]:
    """While it lasts few touches are sampled, as if there were thousands."""
    with patch.object(scroll_tactile.memory.state, "TouchSample", FewSampled):
        yield


def main(options: argparse.Namespace) -> dict[str, Any]:
    """Round after round."""
    failures: list[str] = []
    calls, answers, rounds, ended = Counter[str](), Counter[str](), 0, time.monotonic() + 60 * options.minutes
    seconds = 2.0 if options.quick else options.seconds
    interrupted = False
    with folder(options, in_memory=True) as home, short_fits():
        while not interrupted and (not rounds or (time.monotonic() < ended and not options.quick)):
            seed = options.seed * 10_000 + rounds
            (where := home / f"round-{rounds}").mkdir()
            with few_sampled() if seed % 2 else nullcontext():
                round_ = begun(where, seed)
                with watched(round_.failures.append):
                    try:
                        whole = under_threads(round_, seconds, options.threads)
                    except KeyboardInterrupt:
                        whole, interrupted = True, True
                found = list(dict.fromkeys(round_.failures))
                if whole:
                    wrong, counted = looked_up(round_)
                    found += [*wrong, *at_the_end(round_)]
                    answers += counted
                    round_.reader.close()
                    round_.learner.close()
            failures += [f"seed {seed}: {text}" for text in found[:SHOWN]]
            calls.update(round_.calls)
            rounds += 1
            done = f"{sum(calls.values())} calls, {sum(answers.values())} answers, {len(failures)} failures"
            progress(f"round {rounds}: {done}")
            if not whole or len(failures) >= 5 * SHOWN:
                break
    return {
        "threads": options.threads,
        "rounds": rounds,
        "calls": dict(sorted(calls.items())),
        "answers looked up": dict(sorted(answers.items())),
        "failures": failures,
    }


if __name__ == "__main__":
    faulthandler.enable()
    run("threads", parser(__doc__, minutes=1.0, seconds=20.0, threads=8).parse_args(), main)

"""Many sources, one memory: the touches in files and folders are learned, or answered; what cannot be is listed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any, Self

import numpy as np

from scroll_tactile.clients.learning.metrics import Answers, calibration_error, interval_figures
from scroll_tactile.clients.learning.sources import Refused, SourceOptions, SourceTouch, source_touches
from scroll_tactile.errors import EmbeddingError, InputError, printable
from scroll_tactile.learner import TactileLearner
from scroll_tactile.persistence.observations import refusal
from scroll_tactile.results import Estimate, Prediction
from scroll_tactile.signals.facts import Fact, all_clipped, merged

__all__ = ["Answered", "Evaluation", "Learned", "Progress", "answers", "evaluate_sources", "learn_sources"]

BATCH_TOUCHES = 256  # become durable together: what a kill can cost …
BATCH_BYTES = 1 << 25  # … unless their readings would be more than this, or the first was read so long ago:
BATCH_SECONDS = 5.0

Progress = Callable[[str, int, int], object]


@dataclass
class Learned:
    """What learning from sources did.

    files: how many were read. learned: material → touches. skipped: touches that the memory had already under this
    name, by the hash of their content. refused: what was not learned. known: contents that were skipped or refused
    because another memory has them, see `learn_sources`. clipped: contents of touches all of whose values lay outside
    the sensor's range. facts: what is odd about what was learned, each kind once.
    """

    files: int = 0
    learned: Counter[str] = field(default_factory=Counter)
    skipped: int = 0
    refused: list[Refused] = field(default_factory=list)
    known: set[bytes] = field(default_factory=set)
    clipped: set[bytes] = field(default_factory=set)
    facts: list[Fact] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """It in JSON's types."""
        contents = {name: sorted(key.hex() for key in getattr(self, name)) for name in ("known", "clipped")}
        lists = {name: [vars(each) for each in getattr(self, name)] for name in ("refused", "facts")}
        return {**vars(self), **lists, **contents}

    @classmethod
    def from_json(cls, told: Mapping[str, Any]) -> Self:
        """What `to_json` gave. Raises TypeError, LookupError or ValueError for anything else."""
        contents = {name: {bytes.fromhex(key) for key in told[name]} for name in ("known", "clipped")}
        lists = {name: [kind(**each) for each in told[name]] for name, kind in (("refused", Refused), ("facts", Fact))}
        return cls(**{**told, "learned": Counter(told["learned"]), **lists, **contents})


def learn_sources(
    learner: TactileLearner,
    sources: Sequence[str],
    options: SourceOptions,
    progress: Progress = lambda what, done, of: None,
    *,
    known: Mapping[bytes, Sequence[str]] | None = None,
) -> Learned:
    """Observe the touches in sources, each once: call again after an interruption, and it goes on.

    At most 256 touches, or those of five seconds, become durable together: a kill loses those. A touch that the memory
    has under another name is refused.
    progress: called with (what is being done, files done, files in all).
    known: content → names, of the memory that this one will be merged into, in place of what this one has. A touch
    under two names is then learned under both: whoever merges decides.

    Raises AnnotationError for a quantity that the memory has with another unit or range (nothing was learned);
    StoreError and CapacityError; what was learned until then is kept.
    """
    done, batch, size, since = Learned(), list[tuple[int, SourceTouch]](), 0, 0.0
    options = options.by_names(sources, learner.sensor)
    for quantity in options.declared:
        learner.declare(quantity)

    def show(number: int, files: int) -> None:
        told = f"{done.learned.total()} touches; {printable(Path(sources[number]).name)}"
        progress(told, files, len(sources))

    def observe() -> None:
        with learner.batch():
            for number, touch in batch:
                show(number, number)
                _observe(learner, touch, done, known)
        batch.clear()

    for number, address in enumerate(sources):
        show(number, batch[0][0] if batch else number)  # what waits is not done
        for touch in source_touches(learner, address, options):
            if isinstance(touch, Refused):
                done.refused.append(touch)
                continue
            size, since = (size, since) if batch else (0, monotonic())
            batch.append((number, touch))
            size += touch.stream.readings.nbytes
            if len(batch) >= BATCH_TOUCHES or size >= BATCH_BYTES or monotonic() - since >= BATCH_SECONDS:
                observe()
        done.files += 1
    observe()
    progress(f"{done.learned.total()} touches", len(sources), len(sources))
    return done


def _observe(
    learner: TactileLearner, touch: SourceTouch, done: Learned, known: Mapping[bytes, Sequence[str]] | None
) -> None:
    """Observe a touch, unless it is there already, and take note of what became of it."""
    material, key, clipped = str(touch.material), touch.stream.key, all_clipped(touch.stream)
    names = learner.names_of(touch.stream) if known is None else known.get(key, ())
    repeated = material in names and not (touch.values or touch.labels)
    why = refusal(names, material, clipped)
    if known is not None and (repeated or why):
        done.known.add(key)
    try:
        if why is None and not repeated:
            noted: dict[str, Any] = {"values": touch.values, "labels": touch.labels}
            repeated = learner.observe(material, touch.stream, **noted, source=touch.source).repeated
    except InputError as error:  # such as one that is too long
        why = str(error)
    except EmbeddingError as error:
        error.add_note(f"The touch is {touch.source}, of {material!r}.")
        raise
    if why is not None:
        done.refused.append(Refused(touch.source, why))
        return
    done.facts = merged([*done.facts, *touch.facts])
    if repeated:
        done.skipped += 1
    else:
        done.learned[material] += 1
        done.clipped |= {key} if clipped else set()


@dataclass(frozen=True)
class Answered:
    """A touch out of a source, what it feels like, and the estimates of its quantities, if any was declared."""

    touch: SourceTouch
    prediction: Prediction
    estimates: Mapping[str, Estimate] = field(default_factory=dict)


def answers(
    learner: TactileLearner,
    sources: Sequence[str],
    options: SourceOptions,
    *,
    scene: Sequence[str] | None = None,
    of: str | None = None,
    named: bool = False,
    progress: Progress = lambda what, done, of: None,
) -> Iterator[Answered | Refused]:
    """What each touch in sources feels like; the memory stays as it is.

    scene, of: as of `TactileLearner.predict`. named: as of `source_touches`.
    """
    for touch in _touches(learner, sources, options, progress, named=named):
        yield touch if isinstance(touch, Refused) else _answered(learner, touch, scene, of)


def _answered(
    learner: TactileLearner, touch: SourceTouch, scene: Sequence[str] | None = None, of: str | None = None
) -> Answered:
    said = learner.predict(touch.stream, of=of, scene=scene)
    return Answered(touch, said, learner.estimate(touch.stream) if learner.quantities else {})


def _touches(
    learner: TactileLearner, sources: Sequence[str], options: SourceOptions, progress: Progress, *, named: bool
) -> Iterator[SourceTouch | Refused]:
    options = options.by_names(sources, learner.sensor) if len(sources) > 1 or learner.sensor.columns else options
    for number, address in enumerate(sources):
        progress(printable(Path(address).name), number, len(sources))
        yield from source_touches(learner, address, options, named=named)


@dataclass(frozen=True)
class Evaluation:
    """Answers to touches whose material is known, or whose label on an axis is: their name.

    answered: in the order of the sources. refused: what was not answered. learned: the materials of the memory, or its
    labels. seen: touches that the memory had learned, under any name; left out, or answered with `with_learned`.
    of: the axis; None for materials. unlabelled: touches without a label on it, which are left out. facts: what is odd
    about the touches, each kind once.
    """

    answered: tuple[Answered, ...]
    refused: tuple[Refused, ...]
    learned: frozenset[str]
    seen: int = 0
    of: str | None = None
    unlabelled: int = 0
    facts: tuple[Fact, ...] = ()

    def truth(self, answered: Answered) -> str:
        """The name of a touch."""
        return str(_name_of(answered.touch, self.of))

    @property
    def of_learned(self) -> list[Answered]:
        """Touches whose name the memory has: accuracy, confusions and calibration are theirs."""
        return [each for each in self.answered if self.truth(each) in self.learned]

    @property
    def of_others(self) -> list[Answered]:
        """Touches whose name it never learned, which it should call unknown."""
        return [each for each in self.answered if self.truth(each) not in self.learned]

    @property
    def answers(self) -> Answers:
        """Those to touches whose name the memory has."""
        return Answers([self.truth(each) for each in self.of_learned], [each.prediction for each in self.of_learned])

    @property
    def wrong(self) -> list[Answered]:
        """Touches taken for another: of names that the memory has, and of others that it called known."""
        mistaken = (each for each in self.answered if each.prediction.material != self.truth(each))
        return [each for each in mistaken if self.truth(each) in self.learned or each.prediction.known is not False]

    @property
    def calibration_error(self) -> float | None:
        """Expected calibration error of touches whose name the memory has, see `metrics`; None without any."""
        learned, truth = self.of_learned, self.answers
        right = [name == predicted for name, predicted in zip(truth.truth, truth.predicted, strict=True)]
        return calibration_error([each.prediction.probability for each in learned], right) if learned else None

    @property
    def measured(self) -> dict[str, dict[str, Any]]:
        """Quantity → figures of its estimates of touches whose value is known, see `interval_figures`.

        For those of learned materials by name, and for "new" materials behind it, with the number of touches; what no
        number was given for is left out of them and counted as "without", "missing" says why. Empty of a quantity that
        was not declared. By an axis nothing is estimated.
        """
        if self.of is not None:
            return {}
        names = sorted({name for each in self.answered for name in each.touch.values})
        return {
            name: {
                of: figures
                for of, among in (("learned", self.of_learned), ("new", self.of_others))
                if (figures := _measured(name, among)) is not None
            }
            for name in names
        }


def _measured(name: str, answered: Sequence[Answered]) -> dict[str, Any] | None:
    """The figures of a quantity over touches with a value of it; None where there are none."""
    pairs = [
        (each.touch.values[name], each.estimates[name])
        for each in answered
        if name in each.touch.values and name in each.estimates
    ]
    estimated = [(true, own.value, own.low, own.high) for true, own in pairs if own.value is not None]
    if not pairs:
        return None
    figures = interval_figures(*np.array(estimated, dtype=np.float64).T) if estimated else {}
    first, missing = pairs[0][1], next((own.missing for _, own in pairs if own.value is None), "")
    counted = {"touches": len(estimated), "without": len(pairs) - len(estimated), "missing": missing}
    return counted | {"risk": first.risk, "unit": first.unit} | figures


def evaluate_sources(
    learner: TactileLearner,
    sources: Sequence[str],
    options: SourceOptions,
    progress: Progress = lambda what, done, of: None,
    *,
    of: str | None = None,
    with_learned: bool = False,
) -> Evaluation:
    """Answer every touch in sources with what the memory knows, settled, and keep the right answers.

    of: an axis of labels, to be answered by in place of materials. with_learned: also those that the memory learned, of
    which it knows the answer. Raises AnnotationError for an axis that no touch of the memory has a label on.
    """
    learner._by(of)  # it is settled, too
    learner.settle()
    answered: list[Answered] = []
    refused: list[Refused] = []
    seen, unlabelled, facts = 0, 0, list[Fact]()
    for touch in _touches(learner, sources, options, progress, named=of is None):
        if isinstance(touch, Refused):
            refused.append(touch)
            continue
        facts = merged([*facts, *touch.facts])
        if _name_of(touch, of) is None:
            unlabelled += 1
        else:
            known = bool(learner.names_of(touch.stream))
            seen += known
            if with_learned or not known:
                answered.append(_answered(learner, touch, of=of))
    learned = frozenset(learner.materials if of is None else learner.axes[of])
    return Evaluation(
        answered=tuple(answered),
        refused=tuple(refused),
        learned=learned,
        seen=seen,
        of=of,
        unlabelled=unlabelled,
        facts=tuple(facts),
    )


def _name_of(touch: SourceTouch, of: str | None) -> str | None:
    """A touch's material, or its label on an axis; None where it has none."""
    return touch.material if of is None else touch.labels.get(of)

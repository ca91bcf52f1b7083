"""What a learner gives back."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, Self

from scroll_tactile.errors import InputError

__all__ = [
    "Adaptation",
    "Candidates",
    "ChangeKind",
    "Compacted",
    "Composition",
    "Constituent",
    "Estimate",
    "Health",
    "Merged",
    "Observation",
    "Prediction",
    "Receipt",
    "Unusual",
]

Unusual = Literal["shorter", "longer", "slower", "faster", "noisy", "zero moved", "channels dead"]
"""What may set a touch apart from those that were learned, whatever material it is of."""


ChangeKind = Literal["", "gain", "offset", "dead", "noisier", "slower", "gains", "all gains", "all offsets", "material"]
"""What a change of a sensor looks like; "gains": of several channels, "material": one material feels otherwise."""


@dataclass(frozen=True)
class Health:
    """Whether a sensor is still the one that learned.

    since: the row of the journal from which on touches are other than before; None where nothing is wrong. time: when
    that row was written, in seconds since 1970 by the clock of then. channels:
    that changed, from 0; empty where nothing is wrong, and where it is a material. kind: what it looks like; "" where
    nothing is wrong. evidence: the bet against exchangeable touches, 1 at first; it reaches 1/bound with a probability
    of at most `bound`, however long it goes on, where nothing changes. touches: how many rows it rests on, those at
    rest too. alarmed: the row at which it reached 1/bound; later rows are not read. materials: that show the change.
    grew: (row, logarithm of the evidence to base ten) for each row that could tell anything.
    """

    since: int | None
    time: float | None
    channels: tuple[int, ...]
    kind: ChangeKind
    evidence: float
    bound: float
    touches: int
    alarmed: int | None
    materials: tuple[str, ...]
    grew: tuple[tuple[int, float], ...] = field(repr=False)


@dataclass(frozen=True)
class Receipt:
    """The acknowledgement of one observation.

    sequence: its row in the memory's journal, from 1.
    material: its label. key: hash of the stream's content, 32 bytes.
    seconds: the stream's length; of a camera's, that of the frames in contact. clipped: values outside the sensor's
    range. durable: whether it is on disk; False in a memory without a path, and in a batch, which is durable at its
    end. repeated: whether the memory had this touch already: then nothing was learned, and the receipt equals that of
    the first time. What is said of one call, clipped, durable and repeated, is not compared.
    """

    sequence: int
    material: str
    key: bytes
    seconds: float
    clipped: int = field(compare=False)
    durable: bool = field(compare=False)
    repeated: bool = field(default=False, compare=False)


@dataclass(frozen=True)
class Observation:
    """What the journal says of one observation.

    sequence, material, key: as in its receipt. time: when it was observed, in seconds since 1970. state: "kept", with
    its features; "compacted", learned and without them; or "retracted". source: the file or place it came from, where
    `observe` was given one. values: quantity → value in its unit, to its resolution. labels: axis → label.
    """

    sequence: int
    material: str
    key: bytes
    time: float
    state: Literal["kept", "compacted", "retracted"]
    source: str | None = None
    values: Mapping[str, float] = field(default_factory=dict)
    labels: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Adaptation:
    """What `TactileLearner.adapt` found out about a changed skin.

    kept: whether touches are read through it from now on; False where the touches that it was made of are not explained
    better with it, and all stays as it was. why: in a sentence. sequence: its row in the memory's journal, to retract
    it by; None where it was not kept. gains, offsets: of each channel, as the changed skin reads low + gain · (x − low)
    + offset, in the sensor's unit, where the one that learned would have read x; 1 and 0 where nothing is known.
    left_out: channels that read nothing any more: all of their values are missing from now on, and guessed from the
    other channels. before, after: how far
    the touches lie from what was learned of their materials, each judged with the others' correction: the mean squared
    deviation of a number that is known of a channel, about 1 for a skin that did not change.
    """

    kept: bool
    why: str
    sequence: int | None
    gains: tuple[float, ...]
    offsets: tuple[float, ...]
    left_out: tuple[int, ...]
    before: float
    after: float


@dataclass(frozen=True)
class Merged:
    """What a merge brought.

    observations: how many came in. shared: how many streams of a material both memories had observed.
    described: how many materials' descriptions came in or replaced ours.
    """

    observations: int
    shared: int
    described: int = field(default=0, repr=False)


@dataclass(frozen=True)
class Compacted:
    """What a compaction did.

    last_sequence: the last row of the journal without its features. bytes_before, bytes_after: size of the memory on
    disk.
    """

    last_sequence: int
    bytes_before: int
    bytes_after: int


class Candidates(tuple[str, ...]):
    """The materials that a touch may be of, likeliest first.

    too_few: those among them that no touch could have excluded, too few touches of them being kept.
    """

    too_few: tuple[str, ...]

    def __new__(cls, materials: Iterable[str], too_few: Iterable[str] = ()) -> Self:
        """Make it of materials, likeliest first."""
        made = super().__new__(cls, materials)
        made.too_few = tuple(too_few)
        return made


@dataclass(frozen=True)
class Prediction:
    """What a stream feels like, or several of one thing.

    material: the likeliest of the materials that were candidates; None where nothing was ever observed.
    probability: that of `material`, given that it is one of the candidates; calibrated on touches held out.
    ranking: every candidate with its probability, likeliest first; equal ones in alphabetical order.
    novelty: how unlike the candidates the touch is, in standard deviations above held-out touches of known materials.
        Infinite where nothing was ever observed; 0 where only one material was: there is nothing to compare it with.
    known: False means "never felt this", and `material` is then only the nearest: the novelty is above that of all but
        a share of the material's touches, the false-alarm rate. True: it is below that of all but as large a share of
        touches of materials that were left out whole. None: neither holds, noise hides it (`unusual` has "noisy"), or
        too few touches could be left out, fewer than 1 / rate − 1 (19 at 0.05), or of one material. The rates hold for
        touches that could have been among the learned ones, not for those of another run, speed or sensor.
    seconds: how much touch the answer rests on: the stream's length, at most that of the longest touch learned. Of a
        camera's stream only the frames in contact count, and the one at rest. Of several streams it is the sum.
    tuned: whether f*, the fine-tuned model, gave the probabilities, and not f. Novelty is always f's.
    typicality: of each material in the ranking the share of touches of it, this one among them, that are as strange as
        this one, by the touches that are kept; 1 where nothing is. See `candidates`. typicality_of_all: of all touches,
        in place of those of the material. least_typicality: the least that typicality can be of each, and behind them
        of all.
    unusual: what sets the touch apart from those that were learned, whatever it is of. The rate of false alarms holds
        for touches like those that were learned, of which this is empty.
    """

    material: str | None
    probability: float
    ranking: tuple[tuple[str, float], ...]
    novelty: float
    known: bool | None
    seconds: float
    tuned: bool = False
    typicality: tuple[float, ...] = field(default=(), repr=False)
    typicality_of_all: tuple[float, ...] = field(default=(), repr=False)
    least_typicality: tuple[float, ...] = field(default=(), repr=False)
    unusual: tuple[Unusual, ...] = ()

    def __repr__(self) -> str:
        """On one line: the material, its probability and the next, and whether it is known."""
        (_, *others), new = self.ranking or ((None, 0.0),), {True: "known", False: "unknown", None: "known or not"}
        following = f", then {others[0][0]!r} {others[0][1]:.3g}, of {len(self.ranking)}" if others else ""
        unusual = f", {' and '.join(self.unusual)}" if self.unusual else ""
        return (
            f"Prediction({self.material!r} {self.probability:.3g}{following}; {new[self.known]}, "
            f"novelty {self.novelty:.2f}{unusual}; {self.seconds:g} s)"
        )

    def candidates(self, error: float = 0.05, *, of_all: bool = False) -> Candidates:
        """The materials that it may be, likeliest first: all but those of which it would be an odd touch.

        error: of the touches of any one material that was observed, this share or less lack their own (see
        `matching.conformal`); of several streams of one thing, for each such group. It holds whatever the sensor and
        the embedding are worth: a poor one makes the sets large. Nothing is left of a touch like none that was kept:
        an empty set means unknown.

        A material of which fewer than 1 / error − 1 touches are kept cannot be excluded: 19 of them at 0.05 unless
        given; `Candidates.too_few` names it. of_all: this share of the touches of all materials together, which needs
        so many in all: a material may have more of the errors than another. Where the memory keeps none, as of a
        camera, all are candidates. What holds of touches made as those that were observed does not hold of those that
        are `unusual`.

        Raises InputError for an error that is no share between 0 and 1.
        """
        if not 0 < error < 1:
            raise InputError(f"expected error as a share between 0 and 1; came {error!r}")
        names = [material for material, _ in self.ranking]
        anything = (1.0,) * len(names)
        typical = (self.typicality_of_all if of_all else self.typicality) or anything
        least = self.least_typicality or (*anything, 1.0)
        least = least[-1:] * len(names) if of_all else least[:-1]
        found = [name for name, share in zip(names, typical, strict=True) if share > error]
        too_few = {name for name, share in zip(names, least, strict=True) if share > error}
        return Candidates(found, [name for name in found if name in too_few])

    def as_json(self) -> dict[str, str | float | bool | None]:
        """Material, probability, known and novelty in JSON's types, which have no infinity: None stands for it.

        Numbers have six digits, and below a billionth they are 0.
        Of known None stands for what cannot be told.
        """
        return {
            "material": self.material,
            "probability": _written(self.probability),
            "known": self.known,
            "novelty": None if math.isinf(self.novelty) else _written(self.novelty),
        }

    def ranking_as_json(self, most: int | None = None) -> list[list[str | float]]:
        """The likeliest materials, each with its probability, in JSON's types; all unless `most` are wanted."""
        return [[name, _written(probability)] for name, probability in self.ranking[:most]]


def _written(number: float) -> float:
    """A probability or a novelty as it is written down: six digits, and 0 below a billionth."""
    return 0.0 if abs(number) < 1e-9 else float(f"{number:.6g}")


@dataclass(frozen=True)
class Estimate:
    """What a stream says of one quantity, such as its force.

    value: in `unit`; None where no head could be learned. low, high: an interval that holds the true value in a share
    of 1 − `risk` of touches, within the quantity's range; both None where value is. known: whether the interval is
    calibrated for a material that was learned, on touches held out; otherwise for a new one, on materials held out,
    which is as good as these are many and like the new one. inside: whether the touch is like those learned: of a known
    material, and not `unusual`. An interval holds for touches like those. touches, materials: how many sampled ones the
    value rests on. seconds: see Prediction. missing: in words, what a value or a bounded interval would take; empty
    where there is one.

    A quantity that says no more than the material's name is given away by its interval for new materials: it is wide.
    """

    value: float | None
    low: float | None
    high: float | None
    unit: str
    risk: float
    known: bool
    inside: bool = True
    touches: int = 0
    materials: int = 0
    seconds: float = 0.0
    missing: str = ""

    @property
    def interval(self) -> tuple[float, float] | None:
        """(low, high); None without a value."""
        return None if self.low is None or self.high is None else (self.low, self.high)

    @property
    def width(self) -> float | None:
        """high − low; None without a value."""
        return None if self.low is None or self.high is None else self.high - self.low

    def as_json(self) -> dict[str, str | float | bool | None]:
        """All of it by name, in JSON's types."""
        return dict(vars(self))


@dataclass(frozen=True)
class Constituent:
    """What a stream says of one constituent.

    name: as in the descriptions. presence: the probability that it is there; None where no head could be learned.
    share: its part of the mass, from 0 to 1; None where no description gives a share, or no head could be learned.
    evidence: the materials known to have it that the touch feels most like, each with its probability; likeliest first.
    unlearned: why there is no presence, in words; empty where there is one.
    """

    name: str
    presence: float | None
    share: float | None
    evidence: tuple[tuple[str, float], ...]
    unlearned: str = ""


@dataclass(frozen=True)
class Composition:
    """What a stream feels made of.

    constituents: those that were asked for, in alphabetical order. unfamiliar: the probability that the touch is of a
        material never observed; so much weight have the heads, and the rest the materials that it feels like.
    prediction: what it feels like among the materials observed.
    """

    constituents: tuple[Constituent, ...]
    unfamiliar: float
    prediction: Prediction

    def __getitem__(self, name: str) -> Constituent:
        """The constituent of a name. Raises KeyError where it was not asked for."""
        for constituent in self.constituents:
            if constituent.name == name:
                return constituent
        raise KeyError(name)

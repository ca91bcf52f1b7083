"""What a learner gives back."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

__all__ = ["Compacted", "Composition", "Constituent", "Merged", "Observation", "Prediction", "Receipt"]


@dataclass(frozen=True)
class Receipt:
    """Word that an observation is kept, given when it is durable.

    sequence: its place in the memory's journal, from 1; in a memory without a store, the count of observations.
    material: what it was said to be. key: hash of the stream's content, 32 bytes.
    seconds: the stream's length; of a camera's, of what was kept of it. clipped: values outside the sensor's range.
    durable: whether it is on disk; False in a memory without a store, and in a batch, which is when it ends.
    """

    sequence: int
    material: str
    key: bytes
    seconds: float
    clipped: int
    durable: bool


@dataclass(frozen=True)
class Observation:
    """What the journal says of one observation.

    sequence, material, key: as in its receipt. time: when it was observed, in seconds since 1970. state: "kept";
    "compacted": learned, and its features given up; or "retracted".
    """

    sequence: int
    material: str
    key: bytes
    time: float
    state: Literal["kept", "compacted", "retracted"]


@dataclass(frozen=True)
class Merged:
    """What a merge brought.

    observations: that came in. shared: streams, of one material, that both memories had observed.
    described: materials whose descriptions came in, or were replaced.
    """

    observations: int
    shared: int
    described: int = field(default=0, repr=False)


@dataclass(frozen=True)
class Compacted:
    """What a compaction did.

    upto: the last row of the journal whose features were given up. bytes_before, bytes_after: of the memory on disk.
    """

    upto: int
    bytes_before: int
    bytes_after: int


@dataclass(frozen=True)
class Prediction:
    """What a stream feels like.

    material: the likeliest of the materials that were candidates; None where nothing was ever observed.
    probability: that of `material`, given that it is one of the candidates; calibrated on touches held out.
    ranking: every candidate with its probability, likeliest first; equal ones in alphabetical order.
    novelty: how unlike anything observed: in standard deviations above what known materials give when held out; more
        is newer; with a scene, than its materials. Infinite where nothing was ever observed; 0 where one material only
        was, for then there is nothing to be told apart from.
    known: whether novelty stays below the threshold of the false-alarm rate: False means "never felt this", and
        then `material` is only what comes nearest.
    seconds: how much touch the answer rests on: the stream's length, or that of the longest touch learned where the
        stream is longer, for nothing was ever observed of how a material goes on after that. Of a camera's stream only
        the frames in contact count, and the one at rest.
    tuned: whether f*, the fine-tuned model, gave the probabilities; f did otherwise. Novelty is always f's.
    """

    material: str | None
    probability: float
    ranking: tuple[tuple[str, float], ...]
    novelty: float
    known: bool
    seconds: float
    tuned: bool = False


@dataclass(frozen=True)
class Constituent:
    """What a stream says of one constituent.

    name: as it was described. presence: the probability that it is there; None where no head could be learned.
    share: its part of the mass, from 0 to 1; None where it has none, or no head could be learned.
    evidence: the materials known to have it that the touch feels most like, with the probability of each among all
        that were observed; likeliest first.
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

    constituents: all that were asked for, in alphabetical order. unfamiliar: the probability that the touch is of a
        material never observed: what the heads weigh, which speak for a new material, against the known ones that it
        feels like.
    prediction: what it feels like among the materials observed.
    """

    constituents: tuple[Constituent, ...]
    unfamiliar: float
    prediction: Prediction

    def __getitem__(self, name: str) -> Constituent:
        """The constituent of a name. Raises KeyError where it was not asked for."""
        for one in self.constituents:
            if one.name == name:
                return one
        raise KeyError(name)

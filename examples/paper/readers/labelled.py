"""What every reader of a data set returns."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import DatasetError, InputError
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream

__all__ = ["Recordings", "chosen", "hold_out", "thinned"]

_BLOCK = 10  # repetitions in a block: a fifth of 50


@dataclass(frozen=True, eq=False)
class Recordings:
    """Streams of one sensor with their materials and the published, or a seeded, split into test folds.

    name: the data set.
    sensor: the sensor of all its streams.
    streams: N streams.
    materials: N names, one for each stream.
    repetition: int of shape (N,), which touch of its material a stream is (within its fold where `ordered` is
        false), from 0.
    fold: int of shape (N,), the fold in which a stream is tested, from 0.
    ordered: whether `repetition` is the order of recording, so that `blocked` has a meaning.

    Raises InputError if these are not all N long.
    """

    name: str
    sensor: Sensor
    streams: list[Stream]
    materials: list[str]
    repetition: npt.NDArray[np.int64]
    fold: npt.NDArray[np.int64]
    ordered: bool

    def __post_init__(self) -> None:
        lengths = [len(self.streams), len(self.materials), len(self.repetition), len(self.fold)]
        if len(set(lengths)) != 1:
            raise InputError(
                "expected as many streams, materials, repetitions and folds; came " + ", ".join(map(str, lengths))
            )

    def __len__(self) -> int:
        return len(self.streams)

    def blocked(self) -> npt.NDArray[np.int64]:
        """Folds of ten successive repetitions, int of shape (N,); the last, 4 of 50, is the usual test block.

        A material recorded in one session drifts as it goes: neighbours in time in training and test make a
        random split look better than tomorrow will be.

        Raises DatasetError if the order of recording is not known.
        """
        if not self.ordered:
            raise DatasetError(
                f"{self.name} of sensor {self.sensor.name!r} is published without its order of recording, so "
                "it has no blocked folds; use .fold, the publisher's own"
            )
        return self.repetition // _BLOCK


def hold_out(
    recordings: Recordings, tested: npt.NDArray[np.bool_]
) -> tuple[list[tuple[str, Stream]], list[tuple[str, Stream]]]:
    """The touches that are learned, and those that are held out for the test: of N, bool of shape (N,)."""
    touches = list(zip(recordings.materials, recordings.streams, tested.tolist(), strict=True))
    learned = [(name, stream) for name, stream, out in touches if not out]
    return learned, [(name, stream) for name, stream, out in touches if out]


def chosen(recordings: Recordings, places: Sequence[int]) -> Recordings:
    """The recordings at some places, in this order."""
    return replace(
        recordings,
        streams=[recordings.streams[i] for i in places],
        materials=[recordings.materials[i] for i in places],
        repetition=recordings.repetition[places],
        fold=recordings.fold[places],
    )


def thinned(recordings: Recordings, every: int) -> Recordings:
    """One of so many recordings of each material in each fold, for a look; frames of a video stay together."""
    marks = list(zip(recordings.materials, recordings.fold.tolist(), recordings.repetition.tolist(), strict=True))
    numbers: dict[tuple[str, int], list[int]] = {}
    for material, fold, repetition in dict.fromkeys(marks):
        numbers.setdefault((material, fold), []).append(repetition)
    return chosen(
        recordings,
        [i for i, (material, fold, number) in enumerate(marks) if number in numbers[material, fold][::every]],
    )

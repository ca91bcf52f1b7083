"""The learner: feels a material once, and knows it from then on."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings import Embedding, Frames, Kernels
from scroll_tactile.embeddings.protocol import window_plan
from scroll_tactile.errors import DescriptionError, InputError, MismatchError
from scroll_tactile.finetune.fine_tune import fine_tune
from scroll_tactile.finetune.network import TunedReader
from scroll_tactile.memory.descriptions import Description, checked, require_constituents
from scroll_tactile.memory.exemplars import Exemplar, mean_code, rank
from scroll_tactile.memory.identity import capacity_of, identity_of, kept_augmentation, kept_capacity, require_same
from scroll_tactile.memory.ledger import Ledger
from scroll_tactile.memory.merge import Choice
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.tuned import TuneReport
from scroll_tactile.prediction.composition import Composer
from scroll_tactile.prediction.features import Perception, Readings
from scroll_tactile.prediction.filling import Filling
from scroll_tactile.prediction.incremental import IncrementalModel, SolverName
from scroll_tactile.prediction.model import Judgement, Model
from scroll_tactile.readouts.readout import ReadoutName
from scroll_tactile.results import Compacted, Composition, Constituent, Merged, Prediction, Receipt
from scroll_tactile.sensors import Sensor
from scroll_tactile.settings import candidates_of, require_augmentable, require_name, require_settings
from scroll_tactile.signals.copies import Augmented
from scroll_tactile.signals.stream import Stream
from scroll_tactile.signals.windows import Scale
from store import Store

__all__ = ["TactileLearner"]

logger = logging.getLogger(__name__)


class TactileLearner:
    """A memory of how materials feel: exact, durable where it has a path, and honest about what it never felt.

    >>> from scroll_tactile import TactileLearner, sensors
    >>> from scroll_tactile.datasets.simulator import Scene
    >>> scene = Scene(sensor=sensors.BIOTAC)
    >>> learner = TactileLearner(sensor=sensors.BIOTAC)
    >>> receipts = [learner.observe(name, scene.touch(name, at)) for at in range(4) for name in scene.materials[:3]]
    >>> learner.predict(scene.touch(scene.materials[1], 9)).material == scene.materials[1]
    True

    sensor: whose streams it reads. embedding: the frozen features; unless given `Kernels()`, and `Frames()` for a
    camera, of whose frames those count in which the gel is pressed (see `scroll_tactile.signals.contact`).
    readout: "lda" or "ridge" (the paper's); computed from the statistics, so it can differ at every opening.
    false_alarms: the share of touches of known materials that may be called unknown.
    refit: the share by which the memory may grow before λ and the calibration are chosen again. 0: they are at each
    change, and every answer is a function of the memory alone. With 0.1, say, a `predict` just after an `observe` is a
    hundred times as fast: the readouts are of all that was felt, λ and the calibration of a little less.
    solver: how the readouts follow between two such fits. "exact": against a factor of the exact statistics, equal to a
    fresh solve to rounding. "recursive": the paper's recursive least squares, whose rounding errors add up until the
    next fit; it is there to be compared with, and what the memory keeps is exact all the same.
    exemplars: streams in the buffer that `fine_tune` trains on, 400 unless given; three times as many are kept raw, to
    choose from. 0: none are; so it is for a camera, whose frames are large (480 × 640: 4 MB), unless it is given.
    exemplar_bytes: a limit of bytes of raw readings, in place of it or beside it.
    augmentation: the copies that each touch is observed with, see `Augmented`; none unless given. A touch and its
    copies are one observation: it is taken back with them, and is as exact. Each copy costs as much time and space as
    the touch does, when it is observed; `predict` reads what it is given and nothing else.

    In memory only; `TactileLearner.open` gives one with a path. Methods may be called from any thread.
    """

    def __init__(
        self,
        *,
        sensor: Sensor,
        embedding: Embedding | None = None,
        readout: ReadoutName = "lda",
        false_alarms: float = 0.05,
        refit: float = 0.0,
        solver: SolverName = "exact",
        exemplars: int | None = None,
        exemplar_bytes: int | None = None,
        augmentation: Augmented | None = None,
    ) -> None:
        require_settings(readout, false_alarms, refit, solver)
        self.sensor = sensor
        self.embedding: Embedding = _usual(sensor) if embedding is None else embedding
        self.readout: ReadoutName = readout
        self.false_alarms = false_alarms
        self.refit = refit
        self.augmentation = require_augmentable(sensor, augmentation)
        self.solver: SolverName = solver
        self._reading = window_plan(sensor, self.embedding)
        self._perception = Perception(sensor, self.embedding, self._reading, self.augmentation)
        self._capacity = capacity_of(exemplars, exemplar_bytes, camera=sensor.camera)
        self._ledger = Ledger(lambda: Memory(self.embedding.dimension, self._reading, self._capacity))
        self._tuned_reader: TunedReader | None = None
        self._model: tuple[int, Model] | None = None
        self._following: tuple[int, IncrementalModel] | None = None
        self._composer: tuple[Model, int, Composer] | None = None
        self._filled: tuple[int, Filling | None] | None = None

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        *,
        sensor: Sensor | None = None,
        embedding: Embedding | None = None,
        readout: ReadoutName = "lda",
        false_alarms: float = 0.05,
        refit: float = 0.0,
        solver: SolverName = "exact",
        exemplars: int | None = None,
        exemplar_bytes: int | None = None,
        augmentation: Augmented | None = None,
        mode: Literal["write", "read"] = "write",
    ) -> TactileLearner:
        """Open the memory in folder `path`, or make it where there is nothing; the rest is as for the class.

        sensor: may be left out for a memory that is there, and so may the size of the buffer and the augmentation.
        mode: "read" for one that another process writes; it shows what was committed when it was opened.

        Raises SensorMismatchError, EmbeddingMismatchError, MismatchError for a memory made with others, InputError
        where a new memory is given no sensor, and StoreError (locked, damaged, not a store, a newer version …).
        """
        require_settings(readout, false_alarms, refit, solver)
        if sensor is None and not Path(path).exists():
            raise InputError(f"there is no memory in {path}; to make one, say which sensor it is for")
        asked = capacity_of(exemplars, exemplar_bytes, camera=sensor is not None and sensor.camera)
        identity = None if sensor is None else identity_of(sensor, embedding or _usual(sensor), asked, augmentation)
        store = Store.open(path, identity=identity, mode=mode)
        try:
            if "sensor" not in store.identity:
                raise MismatchError(f"{store.path} is a store, but holds no memory of touch. Take another path")
            kept = Sensor.model_validate(store.identity["sensor"])
            chosen: Embedding = _usual(kept) if embedding is None else embedding
            require_same(store, kept, sensor, chosen)
            capacity = kept_capacity(store, asked, given=exemplars is not None or exemplar_bytes is not None)
            learner = cls(
                sensor=kept,
                embedding=chosen,
                readout=readout,
                false_alarms=false_alarms,
                refit=refit,
                solver=solver,
                exemplars=capacity.streams,
                exemplar_bytes=capacity.nbytes,
                augmentation=kept_augmentation(store, augmentation),
            )
            reading = learner._reading
            learner._ledger = Ledger(lambda: Memory.load(store, chosen.dimension, reading, capacity), store)
        except BaseException:
            store.close()
            raise
        return learner

    @property
    def _memory(self) -> Memory:
        return self._ledger.memory

    def __repr__(self) -> str:
        where = "in memory" if self._ledger.store is None else str(self._ledger.store.path)
        return f"<TactileLearner {where}, {self.sensor.name}, {len(self.materials)} materials>"

    @property
    def materials(self) -> dict[str, int]:
        """Material → number of observations, in alphabetical order."""
        with self._ledger.lock:
            return self._memory.statistics.materials

    def observe(self, material: str, stream: Readings) -> Receipt:
        """Learn that this stream is how the material feels; it is durable when this returns.

        material: its name, any; a new one needs no announcement. stream: readings of shape (T, n) in the sensor's
        unit, T of at least 0.1 s: an array, a tensor, lists, or an iterable of readings; of a camera frames,
        (T, height, width, 3), the first of the gel at rest (see `Frames`), of which those in contact are kept.

        Raises StreamError (NoContactError where the gel was not pressed), MaterialError (nothing was kept),
        CapacityError, or StoreError.
        """
        require_name(material)
        felt = self._perception.felt(stream)
        image = self._perception.image(felt)
        return self._ledger.observe(material, felt, image.shape[1], self._perception.codes(image, felt.key))

    def describe(self, material: str, constituents: Mapping[str, float | bool | None] | None) -> None:
        """Say what a material is made of, before or after it is touched; durable when this returns.

        constituents: each with its share by mass, from 0 to 1, all together one, and then what is not named is absent;
        or, for attributes that are no masses, True where it is there and False where not. None: it is unknown, and so
        is, of attributes, what is not named; the material takes no part then in what is learned of that constituent.
        None for all: what was said of the material is taken back.

        A later description replaces an earlier one as a whole; the same one again changes nothing. Statistics and
        `digest` stay as they are. `forget` takes the description along, `retract` does not.

        Raises MaterialError, DescriptionError for shares that are negative, not finite or do not sum to one, or names
        that cannot be used (nothing was changed); StoreError.
        """
        require_name(material)
        self._ledger.describe(material, None if constituents is None else checked(material, constituents))

    @property
    def descriptions(self) -> dict[str, Description]:
        """Material → what it was said to be made of, as kept, in alphabetical order; felt or not."""
        with self._ledger.lock:
            return {name: dict(one) for name, one in sorted(self._memory.descriptions.items())}

    @contextmanager
    def batch(self) -> Iterator[None]:
        """Make what is observed, retracted or forgotten in the block durable together, when it ends.

        For a bulk of touches: the disk is waited for once. If the process dies in the block none of it is kept. An
        exception in the block ends it, and what came before it is kept. Other threads wait for the end of it; there is
        no fine-tuning, merging, compacting or closing in it. In a memory without a path it does nothing.

        Raises StoreError where the batch could not be made durable: the memory is then as it was before it.
        """
        with self._ledger.batch():
            yield

    def retract(self, receipt: Receipt | int) -> None:
        """Take one observation back, by its receipt or its sequence; durable when this returns.

        Statistics, exemplars and readouts are then, to the bit, those of a memory that never had it; an f* that was
        made from it is gone. Its features stay in the journal, unused, until `compact`.

        Raises ObservationError (nothing was changed) for one that is not there, was taken back before or was
        compacted, or for a receipt of another memory; InputError in a memory without a path; StoreError.
        """
        self._ledger.retract(receipt)

    def forget(self, material: str) -> int:
        """Take back all observations of a material, as `retract` does one, and its description; returns how many.

        Raises UnknownMaterialError for a material never felt, and ObservationError (nothing was changed) where some
        of them were compacted; InputError in a memory without a path; StoreError.
        """
        return self._ledger.forget(material)

    def merge(
        self,
        other: TactileLearner | str | os.PathLike[str],
        *,
        shared: Literal["once", "twice"],
        descriptions: Choice = "same",
        progress: Callable[[str, int, int], object] | None = None,
    ) -> Merged:
        """Make this memory the one that felt everything that both did; durable, whole, when this returns.

        other: a memory with a path, or its path; it stays as it is. shared: whether a stream that both felt (one
        material, one content hash) counts once or twice. Receipts of the other memory are not receipts of this one.
        descriptions: whose is kept of a material that both describe: "ours", "theirs", or "same", where they must be.

        Raises MismatchError for a memory of another sensor, embedding or grid, or one that describes a material
        otherwise where nobody chose, ObservationError where shared streams
        cannot be told apart any more, CapacityError, InputError, StoreError: nothing was changed then.
        """
        if shared not in ("once", "twice"):
            raise InputError(f"expected shared as 'once' or 'twice'; came {shared!r}")
        if descriptions not in ("same", "ours", "theirs"):
            raise InputError(f"expected descriptions as 'same', 'ours' or 'theirs'; came {descriptions!r}")
        told = progress or (lambda what, done, of: None)
        path = other._ledger.require_store("be merged").path if isinstance(other, TactileLearner) else other
        return self._ledger.merge(path, shared, descriptions, told)

    def compact(self, *, keep: int = 0) -> Compacted:
        """Give up the features and readings of old observations, for space; what was learned from them stays.

        keep: how many of the newest observations can still be taken back afterwards, by `retract` and `forget`; the
        older ones cannot any more. What was taken back before is gone from the disk, too.

        Raises InputError for a keep below 0, in a batch, and in a memory without a path; StoreError.
        """
        return self._ledger.compact(keep)

    def refresh(self) -> bool:
        """In a memory opened to read, take in what was committed since; whether there was anything.

        Raises StoreError; what was known before stays then.
        """
        return self._ledger.refresh()

    def predict(self, stream: Readings, *, scene: Sequence[str] | None = None, tuned: bool = False) -> Prediction:
        """Say what a stream feels like; the memory stays as it is.

        stream: as for `observe`. scene: the materials that can be here; all that were felt where it is None.
        tuned: ask f*, where there is one that was kept (see `fine_tune`), that knows all the candidates, and whose
        last stage the touch reaches; f answers otherwise, and `Prediction.tuned` says which of them did.

        Raises StreamError, UnknownMaterialError for a scene that names a material never felt, InputError for an
        empty one. Before anything was felt the answer is material None, known False.
        """
        felt = self._perception.felt(stream)
        with self._ledger.lock:
            memory = self._memory
            model, longest = self._present(), memory.statistics.longest
            reader = self._tuned() if tuned else None
        candidates = model.names if scene is None else candidates_of(scene, model.names)
        if not candidates:
            return Prediction(None, 0.0, (), float("inf"), False, felt.seconds)
        felt = self._perception.as_far_as(felt, longest)
        image = self._perception.image(felt)
        columns = image.shape[1]
        if (through_noise := self._through_noise(model, candidates, image, felt)) is not None:
            return through_noise
        image = self._mended(image)
        means = self._perception.means(image, model.needed(candidates, columns))
        logits = None
        if (
            reader is not None
            and set(candidates) <= set(reader.tuned.names)
            and model.is_last(columns)
            and reader.reads(columns)
        ):
            logits = reader.logits(image)
        return self._told(model, candidates, means, felt, columns, logits)

    def compose(
        self, stream: Readings, *, constituents: Sequence[str] | None = None, unfamiliar: float = 0.5
    ) -> Composition:
        """Say what a stream feels made of, of all that was described; the memory stays as it is.

        stream: as for `observe`. constituents: those that are asked for; all where it is None. unfamiliar: how probable
        it is beforehand that the touch is of a material never felt: 1 where that is known, 0 where it cannot be.

        A touch of a material that was felt is told by what it feels like and what that is made of, one of a material
        never felt by heads over all that were (see `prediction.composition`); the two are weighed by the touch's
        novelty. A touch through noise, where noisy copies were observed, is told by what it feels like alone. A
        constituent that all or none of the materials have that were felt and of which it is known is named, in
        `Constituent.unlearned`, and not guessed.

        Raises StreamError, DescriptionError where nothing was described, or for a constituent that nothing names, and
        InputError for an unfamiliar that is no probability.
        """
        if not 0 <= unfamiliar <= 1:
            raise InputError(f"expected unfamiliar as a probability from 0 to 1; came {unfamiliar!r}")
        felt = self._perception.felt(stream)
        with self._ledger.lock:
            described, longest = self._memory.descriptions, self._memory.statistics.longest
            known = {name for one in described.values() for name in one}
            if not known:
                raise DescriptionError("nothing was described yet: say with describe() what some material is made of")
            wanted = require_constituents(sorted(known) if constituents is None else constituents, known)
            model = self._present()
            if model.names:
                composer = self._fitted_composer(model)
        if not model.names:
            nothing = tuple(Constituent(name, None, None, (), "nothing was felt yet") for name in wanted)
            return Composition(nothing, 1.0, Prediction(None, 0.0, (), float("inf"), False, felt.seconds))
        felt = self._perception.as_far_as(felt, longest)
        image = self._perception.image(felt)
        if (through_noise := self._through_noise(model, model.names, image, felt)) is not None:
            made_of = composer.through_noise(wanted, dict(through_noise.ranking))
            return Composition(made_of, unfamiliar, through_noise)
        image = self._mended(image)
        columns = image.shape[1]
        means = self._perception.means(image, sorted({*model.needed(model.names, columns), *composer.needed(columns)}))
        prediction = self._told(model, model.names, means, felt, columns, None)
        made_of, new = composer.compose(wanted, dict(prediction.ranking), means, columns, unfamiliar)
        return Composition(made_of, new, prediction)

    def _fitted_composer(self, model: Model) -> Composer:
        described = self._ledger.described
        if self._composer is None or self._composer[0] is not model or self._composer[1] != described:
            self._composer = model, described, Composer.of(model, self._memory)
        return self._composer[2]

    def _mended(self, image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """The image with silent channels filled from the others, where the embedding asks for that."""
        filling = self._filling() if self._reading.filled else None
        return image if filling is None else filling.fill(image)

    def _through_noise(
        self, model: Model, candidates: Sequence[str], image: npt.NDArray[np.float32], felt: Stream
    ) -> Prediction | None:
        """What a touch is taken for that was felt through noise; None of any other, and where none were learned."""
        if model.noisy is None or not self._perception.is_noisy(image):
            return None
        return self._prediction(candidates, model.judge_noisy(candidates, self._perception.noisy_means(image)), felt)

    def _told(
        self,
        model: Model,
        candidates: Sequence[str],
        means: Mapping[Scale, npt.NDArray[np.float64]],
        felt: Stream,
        columns: int,
        logits: Mapping[str, float] | None,
    ) -> Prediction:
        judgement = model.judge(candidates, means, columns, logits)
        return self._prediction(candidates, judgement, felt, tuned=logits is not None)

    def _prediction(
        self, candidates: Sequence[str], judgement: Judgement, felt: Stream, *, tuned: bool = False
    ) -> Prediction:
        ranking = sorted(
            zip(candidates, judgement.probability.tolist(), strict=True),
            key=lambda entry: (-entry[1], entry[0]),
        )
        known = bool(judgement.novelty <= judgement.calibration.threshold(self.false_alarms))
        return Prediction(*ranking[0], tuple(ranking), judgement.novelty, known, felt.seconds, tuned=tuned)

    def model(self) -> Model:
        """The readouts and calibrations of the memory as it is now; fitted where it changed since it was last asked."""
        with self._ledger.lock:
            memory, version = self._memory, self._ledger.version
            if self._model is None or self._model[0] != version:
                self._model = version, Model.of(memory, self.readout)
            return self._model[1]

    def _filling(self) -> Filling | None:
        """As the silent channels of a touch are filled in by the memory as it is now."""
        with self._ledger.lock:
            memory, version = self._memory, self._ledger.version
            if self._filled is None or self._filled[0] != version:
                self._filled = version, Filling.of(memory.statistics, self.sensor.channels, self.embedding.bound)
            return self._filled[1]

    def _present(self) -> Model:
        """The model that predictions are made with: `model`, or one that follows it where `refit` allows."""
        ledger = self._ledger
        if not self.refit:
            return self.model()
        if self._following is not None and self._following[0] == ledger.version:
            return self._following[1].model
        following, added = self._following and self._following[1], ledger.added
        if following is None or added is None or not following.update(ledger.memory, added):
            following = IncrementalModel(self.model(), ledger.memory, self.refit, self.solver)
        self._following = ledger.version, following
        ledger.follow, ledger.added = True, []
        return following.model

    def digest(self) -> str:
        """Hex, equal for two memories if and only if they hold the same bytes of statistics."""
        with self._ledger.lock:
            return self._memory.statistics.digest()

    @property
    def exemplars(self) -> dict[str, list[bytes]]:
        """Material → content hashes of its exemplars, in rank order; materials in alphabetical order."""
        with self._ledger.lock:
            return {name: [one.key for one in those] for name, those in self._ranked().items()}

    def _ranked(self) -> dict[str, list[Exemplar]]:
        memory = self._memory
        if memory.exemplars is None:
            return {}
        statistics = memory.statistics

        def mean(material: str, scale: Scale) -> npt.NDArray[np.int64]:
            total = statistics.sums(scale, [material]).sum(axis=(0, 1))
            return mean_code(total, int(statistics.counts(scale, [material]).sum()))

        return rank(memory.exemplars, mean)

    def fine_tune(
        self,
        *,
        epochs: int | None = None,
        seed: int = 0,
        device: str = "cpu",
        progress: Callable[[str, int, int], object] | None = None,
    ) -> TuneReport:
        """Make f* from f by training on the exemplars; durable when this returns.

        epochs: the most, 8 unless given; how many are taken is decided on exemplars held out. seed: of the order and
        the augmentation. device: torch's name of one. progress: told (what is being done, steps done, steps in all).

        The same memory, seed and device give the same f*, to the bit. f stays as it is, and f* stays what it is when
        more is observed. Where f* does worse than f on the exemplars held out the report says so, and f goes on
        answering. Interrupted, or after an error, the f* before stays.

        Raises InputError where there are no exemplars, fewer of them than materials, one material only, or none long
        enough; FineTuneError where the loss is not finite or the device has no memory left; StoreError.
        """
        if self._reading.beginning or self._reading.noisy or self._reading.filled:
            raise InputError(
                f"f* is made of windows alone, and {self.embedding!r} reads beginnings, noise and silent channels by "
                "statistics that training would not know: it would be asked about less than f. Fine-tune a memory of "
                "the embedding inside it"
            )
        with self._ledger.lock:
            self._ledger.require_writing()
            model, ranked, memory = self.model(), self._ranked(), self._memory
            upto, taken_back = memory.sequence, memory.taken_back
            without = sorted(set(model.names) - set(ranked))
        if without and ranked:
            raise InputError(
                f"expected an exemplar of every material; the buffer has none of {without[:10]} (it was made with "
                f"exemplars={self._capacity.streams}, exemplar_bytes={self._capacity.nbytes}). Make a new memory with "
                f"room for {len(model.names)} or more, or touch again what was felt before exemplars were kept"
            )
        told = progress or (lambda what, done, of: None)
        tuned, report = fine_tune(
            self.embedding, model, ranked, self.sensor, epochs=epochs, seed=seed, device=device, progress=told
        )
        self._ledger.keep_tuned(tuned, memory, upto, taken_back)
        return report

    def tuned_digest(self) -> str | None:
        """Hex of a SHA-256 of f*'s weights, whether it answers or not; None before a fine-tune."""
        with self._ledger.lock:
            tuned = self._memory.tuned
            return None if tuned is None else tuned.digest()

    def _tuned(self) -> TunedReader | None:
        tuned = self._memory.tuned
        if tuned is None or not tuned.kept:
            return None
        if self._tuned_reader is None or self._tuned_reader.tuned is not tuned:
            self._tuned_reader = TunedReader(self.embedding, self._reading, tuned)
        return self._tuned_reader

    def close(self) -> None:
        """Write what opening again would have to replay, and let go of the files; a second call does nothing.

        Nothing is lost without it: what `observe` acknowledged is in the journal. `predict` still answers afterwards,
        `observe` raises StoreClosedError.
        """
        self._ledger.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _usual(sensor: Sensor) -> Embedding:
    """The embedding of a memory that asks for none."""
    return Frames() if sensor.camera else Kernels()

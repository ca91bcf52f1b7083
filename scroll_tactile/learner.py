"""The learner: feels a material once, and knows it from then on."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import numpy as np
import numpy.typing as npt

from scroll_tactile.embeddings import Embedding, Kernels, embed_windows
from scroll_tactile.errors import (
    EmbeddingError,
    InputError,
    MaterialError,
    MismatchError,
    ScrollTactileError,
    UnknownMaterialError,
)
from scroll_tactile.exemplars import Exemplar, mean_code, rank
from scroll_tactile.finetune import fine_tune
from scroll_tactile.identity import capacity_of, identity_of, kept_capacity, require_same
from scroll_tactile.images import tactile_image
from scroll_tactile.memory import OBSERVE, READINGS, Memory, give_back_scratch, pack_codes
from scroll_tactile.model import Model
from scroll_tactile.prediction import Prediction, Receipt
from scroll_tactile.ridge.codes import in_units, to_codes
from scroll_tactile.ridge.readouts import ReadoutName
from scroll_tactile.sensors import Sensor
from scroll_tactile.streams import Stream, validate
from scroll_tactile.tuned import TuneReport
from scroll_tactile.tuning import TunedReader
from scroll_tactile.windows import Reading
from store import ReadOnlyError, Store, StoreClosedError, StoreError

__all__ = ["TactileLearner"]

Readings = npt.ArrayLike | Iterable[npt.ArrayLike] | Stream

logger = logging.getLogger(__name__)

LONGEST_NAME = 200  # characters
SNAPSHOT_EVERY = 1024  # observations between generations: replaying so many takes about a second on opening


class TactileLearner:
    """A memory of how materials feel: exact, durable where it has a path, and honest about what it never felt.

    >>> from scroll_tactile import TactileLearner, sensors
    >>> from scroll_tactile.datasets.simulator import Scene
    >>> scene = Scene(sensor=sensors.BIOTAC)
    >>> learner = TactileLearner(sensor=sensors.BIOTAC)
    >>> receipts = [learner.observe(name, scene.touch(name, at)) for at in range(4) for name in scene.materials[:3]]
    >>> learner.predict(scene.touch(scene.materials[1], 9)).material == scene.materials[1]
    True

    sensor: whose streams it reads. embedding: the frozen features, `Kernels()` unless given.
    readout: "lda" or "ridge" (the paper's); computed from the statistics, so it can differ at every opening.
    false_alarms: the share of touches of known materials that may be called unknown.
    exemplars: streams in the buffer that `fine_tune` trains on, 400 unless given; three times as many are kept raw, to
    choose from. 0: none are. exemplar_bytes: a limit of bytes of raw readings, in place of it or beside it.

    In memory only; `TactileLearner.open` gives one with a path. Methods may be called from any thread.
    """

    def __init__(
        self,
        *,
        sensor: Sensor,
        embedding: Embedding | None = None,
        readout: ReadoutName = "lda",
        false_alarms: float = 0.05,
        exemplars: int | None = None,
        exemplar_bytes: int | None = None,
    ) -> None:
        _require_settings(readout, false_alarms)
        self.sensor = sensor
        self.embedding: Embedding = Kernels() if embedding is None else embedding
        self.readout: ReadoutName = readout
        self.false_alarms = false_alarms
        self._reading = Reading.of(sensor, self.embedding)
        self._capacity = capacity_of(exemplars, exemplar_bytes)
        self._memory = Memory(self.embedding.dimension, self._reading, self._capacity)
        self._tuned_reader: TunedReader | None = None
        self._store: Store | None = None
        self._saved = 0
        self._closed = False
        self._whole = True
        self._model: Model | None = None
        self._lock = threading.RLock()

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        *,
        sensor: Sensor | None = None,
        embedding: Embedding | None = None,
        readout: ReadoutName = "lda",
        false_alarms: float = 0.05,
        exemplars: int | None = None,
        exemplar_bytes: int | None = None,
        mode: Literal["write", "read"] = "write",
    ) -> TactileLearner:
        """Open the memory in folder `path`, or make it where there is nothing; the rest is as for the class.

        sensor: may be left out for a memory that is there, and so may the size of the buffer. mode: "read" for one
        that another process writes; it shows what was committed when it was opened.

        Raises SensorMismatchError, EmbeddingMismatchError for a memory made with others, InputError where a
        new memory is given no sensor, and StoreError (locked, damaged, not a store, a newer version …).
        """
        _require_settings(readout, false_alarms)
        chosen: Embedding = Kernels() if embedding is None else embedding
        if sensor is None and not Path(path).exists():
            raise InputError(f"there is no memory in {path}; to make one, say which sensor it is for")
        asked = capacity_of(exemplars, exemplar_bytes)
        identity = None if sensor is None else identity_of(sensor, chosen, asked)
        store = Store.open(path, identity=identity, mode=mode)
        try:
            if "sensor" not in store.identity:
                raise MismatchError(f"{store.path} is a store, but holds no memory of touch. Take another path")
            kept = Sensor.model_validate(store.identity["sensor"])
            require_same(store, kept, sensor, chosen)
            capacity = kept_capacity(store, asked, given=exemplars is not None or exemplar_bytes is not None)
            learner = cls(
                sensor=kept,
                embedding=chosen,
                readout=readout,
                false_alarms=false_alarms,
                exemplars=capacity.streams,
                exemplar_bytes=capacity.nbytes,
            )
            learner._memory = Memory.load(store, chosen.dimension, learner._reading, capacity)
        except BaseException:
            store.close()
            raise
        learner._store = store
        learner._saved = learner._memory.sequence
        return learner

    def __repr__(self) -> str:
        where = "in memory" if self._store is None else str(self._store.path)
        return f"<TactileLearner {where}, {self.sensor.name}, {len(self.materials)} materials>"

    @property
    def materials(self) -> dict[str, int]:
        """Material → number of observations, in alphabetical order."""
        with self._lock:
            return self._sound().statistics.materials

    def observe(self, material: str, stream: Readings) -> Receipt:
        """Learn that this stream is how the material feels; it is durable when this returns.

        material: its name, any; a new one needs no announcement. stream: readings of shape (T, n) in the sensor's
        unit, T of at least 0.1 s: an array, a tensor, lists, or an iterable of readings.

        Raises StreamError, MaterialError (nothing was kept), CapacityError, or StoreError.
        """
        _require_name(material)
        felt = validate(stream, self.sensor)
        image = tactile_image(felt)
        columns, bound = image.shape[1], self.embedding.bound
        codes = {width: to_codes(rows, bound) for width, rows in self._features(image).items()}
        with self._lock:
            self._require_open()
            # Before the journal has it: what is acknowledged, or found there at the next opening, must fit.
            self._sound().statistics.require_room(codes)
            sequence = self._keep(material, felt, columns, codes)
            self._model = None
            if self._store is not None and sequence - self._saved >= SNAPSHOT_EVERY:
                self._snapshot_later()
        return Receipt(sequence, material, felt.key, felt.seconds, felt.clipped, self._store is not None)

    def predict(self, stream: Readings, *, scene: Sequence[str] | None = None, tuned: bool = False) -> Prediction:
        """Say what a stream feels like; the memory stays as it is.

        stream: as for `observe`. scene: the materials that can be here; all that were felt where it is None.
        tuned: ask f*, where there is one that was kept (see `fine_tune`), that knows all the candidates, and whose
        last stage the touch reaches; f answers otherwise, and `Prediction.tuned` says which of them did.

        Raises StreamError, UnknownMaterialError for a scene that names a material never felt, InputError for an
        empty one. Before anything was felt the answer is material None, known False.
        """
        felt = validate(stream, self.sensor)
        with self._lock:
            memory = self._sound()
            model, longest = self.model(), memory.statistics.longest
            reader = self._tuned() if tuned else None
        candidates = model.names if scene is None else _candidates(scene, model.names)
        if not candidates:
            return Prediction(None, 0.0, (), float("inf"), False, felt.seconds)
        felt = self._as_far_as_learned(felt, longest)
        image = tactile_image(felt)
        columns = image.shape[1]
        places, features = self._reading.places(columns), self._features(image, model.needed(candidates, columns))
        # Not rounded: the grid is for sums, and would only add its error to what is asked about.
        means = {
            width: in_units(rows[places[width]], self.embedding.bound).mean(axis=0) for width, rows in features.items()
        }
        logits = None
        if (
            reader is not None
            and set(candidates) <= set(reader.tuned.names)
            and model.is_last(columns)
            and reader.reads(columns)
        ):
            logits = reader.logits(image)
        judgement = model.judge(candidates, means, columns, logits)
        ranking = sorted(
            zip(candidates, judgement.probability.tolist(), strict=True),
            key=lambda entry: (-entry[1], entry[0]),
        )
        known = bool(judgement.novelty <= judgement.calibration.threshold(self.false_alarms))
        return Prediction(*ranking[0], tuple(ranking), judgement.novelty, known, felt.seconds, tuned=logits is not None)

    def _as_far_as_learned(self, felt: Stream, longest: int) -> Stream:
        """The part of a touch that lies within the longest one learned, of so many columns.

        What comes later was never felt of any material, and the later part of a slide differs: learned from 2 s of
        BioTac, touches of 4 s are told apart in 93.5 % when all of them is read.
        """
        frame = self._reading.widths[0] if self.sensor.camera else 1
        return felt.first(longest // frame / self.sensor.rate)

    def _features(
        self, image: npt.NDArray[np.float32], widths: Sequence[int] | None = None
    ) -> dict[int, npt.NDArray[np.floating]]:
        """The features of a tactile image's windows, (windows, d) by scale: all, or those of some widths."""
        windows = self._reading.extent(image.shape[1])
        if widths is not None:
            windows = {width: windows[width] for width in widths}
        read = embed_windows(self.embedding, image, windows)
        for width, features in read.items():
            expected = (len(windows[width]), self.embedding.dimension)
            if features.shape != expected:
                raise EmbeddingError(
                    f"expected features of shape {expected} from {self.embedding.name!r}; came {features.shape}"
                )
        return read

    def model(self) -> Model:
        """The readouts and calibrations of the memory as it is now; fitted where it changed since it was last asked."""
        with self._lock:
            memory = self._sound()
            if self._model is None:
                self._model = Model.of(memory, self.readout)
            return self._model

    def digest(self) -> str:
        """Hex, equal for two memories if and only if they hold the same bytes of statistics."""
        with self._lock:
            return self._sound().statistics.digest()

    @property
    def exemplars(self) -> dict[str, list[bytes]]:
        """Material → content hashes of its exemplars, in rank order; materials in alphabetical order."""
        with self._lock:
            return {name: [one.key for one in those] for name, those in self._ranked().items()}

    def _ranked(self) -> dict[str, list[Exemplar]]:
        memory = self._sound()
        if memory.exemplars is None:
            return {}
        statistics = memory.statistics

        def mean(material: str, scale: int) -> npt.NDArray[np.int64]:
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
        with self._lock:
            self._require_open()
            self._require_writing()
            model, ranked = self.model(), self._ranked()
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
        with self._lock:
            self._require_open()
            memory = self._sound()
            before, memory.tuned = memory.tuned, tuned
            try:
                self._snapshot()
            except BaseException:
                # Ctrl-C may have come after the generation was current: closing writes the f* before again.
                memory.tuned, self._saved = before, -1
                raise
            self._tuned_reader = None
        return report

    def tuned_digest(self) -> str | None:
        """Hex of a SHA-256 of f*'s weights, whether it answers or not; None before a fine-tune."""
        with self._lock:
            tuned = self._sound().tuned
            return None if tuned is None else tuned.digest()

    def _tuned(self) -> TunedReader | None:
        tuned = self._sound().tuned
        if tuned is None or not tuned.kept:
            return None
        if self._tuned_reader is None or self._tuned_reader.tuned is not tuned:
            self._tuned_reader = TunedReader(self.embedding, self._reading, tuned)
        return self._tuned_reader

    def _require_writing(self) -> None:
        """Raise before anything is trained what would keep f* from being written."""
        if self._store is None:
            return
        if self._store.mode == "read":
            raise ReadOnlyError(f'{self._store.path} was opened with mode="read": open it to write, to fine-tune')
        try:
            self._store.flush()
        except StoreError as error:  # of an earlier generation; a commit would raise it in place of committing
            logger.warning("%s: no generation could be written: %s", self._store.path, error)

    def _require_open(self) -> None:
        if self._closed:
            raise StoreClosedError(f"{self!r} is closed: open its path again")

    def _keep(self, material: str, felt: Stream, columns: int, codes: dict[int, npt.NDArray[np.int32]]) -> int:
        """Write an observation down, then add it; its sequence."""
        sequence = self._memory.sequence + 1
        wanted = self._memory.wants_readings(material, felt.key, felt.readings.nbytes)
        readings = felt.readings if wanted else None
        self._whole = False
        if self._store is not None:
            try:
                arrays = pack_codes(codes) | ({READINGS: felt.readings} if wanted else {})
                record = self._store.append(OBSERVE, material, felt.key, attributes={"columns": columns}, arrays=arrays)
            except StoreError:
                self._whole = True  # the journal refused it, and the memory never had it
                raise
            sequence = record.sequence
        self._memory.add(material, felt.key, columns, codes, sequence, readings)
        self._whole = True
        return sequence

    def _sound(self) -> Memory:
        """The memory; read anew from the store where ctrl-C, say, came while an observation was being added.

        Raises ScrollTactileError where there is no store to read it from.
        """
        if not self._whole:
            if self._store is None:
                raise ScrollTactileError(
                    "an observation was interrupted while it was added, and a memory without a path has nothing to go "
                    "back to: make a new one"
                )
            self._memory = Memory.load(self._store, self.embedding.dimension, self._reading, self._capacity)
            self._model, self._whole = None, True
        return self._memory

    def _snapshot_later(self) -> None:
        assert self._store is not None
        arrays, attributes = self._memory.to_arrays()
        try:
            chunks = self._memory.chunks()
            self._store.commit_later(arrays, upto=self._memory.sequence, attributes=attributes, chunks=chunks)
        except StoreError as error:
            # The observation itself is durable; only the next opening has more to replay.
            logger.warning("%s: no generation could be written: %s", self._store.path, error)
        self._saved = self._memory.sequence
        del arrays
        give_back_scratch()

    def _snapshot(self) -> None:
        if self._store is not None:
            arrays, attributes = self._memory.to_arrays()
            self._saved = self._memory.sequence  # even if it fails: the journal has all, and `close` must end
            self._store.commit(arrays, upto=self._saved, attributes=attributes, chunks=self._memory.chunks())

    def close(self) -> None:
        """Write what opening again would have to replay, and let go of the files; a second call does nothing.

        Nothing is lost without it: what `observe` acknowledged is in the journal. `predict` still answers afterwards,
        `observe` raises StoreClosedError.
        """
        with self._lock:
            store, self._closed = self._store, True
            if store is None:
                return
            try:
                # Half an observation is never saved: the journal has the whole of it, or nothing.
                if store.mode == "write" and self._whole and self._memory.sequence > self._saved:
                    self._snapshot()
            finally:
                store.close()
                give_back_scratch()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _require_settings(readout: str, false_alarms: float) -> None:
    if readout not in ("lda", "ridge"):
        raise InputError(f"readout must be 'lda' or 'ridge'; came {readout!r}")
    if not 0 < false_alarms < 1:
        raise InputError(f"false_alarms must be a share between 0 and 1; came {false_alarms!r}")


def _require_name(material: str) -> None:
    if not isinstance(material, str):
        raise MaterialError(f"expected a material's name as a string; came {type(material).__name__} {material!r:.60}")
    if not material or len(material) > LONGEST_NAME:
        raise MaterialError(f"expected a name of 1 to {LONGEST_NAME} characters; came {len(material)}")
    if not material.isprintable():
        raise MaterialError(f"expected a name of printable characters; came {material!r}")


def _candidates(scene: Sequence[str], names: list[str]) -> list[str]:
    if isinstance(scene, str):
        raise InputError(f"expected a scene as a sequence of names; came the string {scene!r}. Use [{scene!r}]")
    wanted = list(dict.fromkeys(scene))
    if not wanted:
        raise InputError("expected at least one material in the scene; came none. Leave scene out for all of them")
    felt = set(names)
    missing = [name for name in wanted if name not in felt]
    if missing:
        raise UnknownMaterialError(
            f"the scene names {missing}, which were never felt; felt were {names if len(names) <= 30 else len(names)}"
        )
    return sorted(wanted)

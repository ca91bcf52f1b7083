"""The learner: observes a material once, and knows it from then on."""

from __future__ import annotations

import copy
import logging
import math
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar

import numpy as np
import numpy.typing as npt

from scroll_tactile.arguments import require_arguments
from scroll_tactile.embeddings.protocol import Embedding, capabilities_of, window_plan
from scroll_tactile.errors import DescriptionError, EmbeddingMismatchError, InputError, RangeWarning
from scroll_tactile.memory.descriptions import Description, checked, require_constituents
from scroll_tactile.memory.exemplars import Exemplar
from scroll_tactile.memory.identity import Identity, default_kept_touches, usual_embedding, usual_exemplars
from scroll_tactile.memory.kept import Keeping
from scroll_tactile.memory.rows import Codes
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.tuned import TuneReport
from scroll_tactile.persistence.buffer import exemplar_candidates, ranked_exemplars
from scroll_tactile.persistence.contents import Contents
from scroll_tactile.persistence.ledger import Ledger
from scroll_tactile.persistence.merge import Choice, MergeRules
from scroll_tactile.persistence.observations import observations
from scroll_tactile.persistence.packing import pack_memory
from scroll_tactile.persistence.reembed import finish_interrupted
from scroll_tactile.persistence.replaying import load
from scroll_tactile.prediction.current import CurrentModel, FrozenModel
from scroll_tactile.prediction.features import Encoded, FeatureExtractor, Readings
from scroll_tactile.prediction.fitting import Draft
from scroll_tactile.prediction.judging import Touch, answer
from scroll_tactile.prediction.model import Model, enough_memory
from scroll_tactile.prediction.reembedding import reembedding
from scroll_tactile.prediction.stored import NAME
from scroll_tactile.results import Compacted, Composition, Constituent, Merged, Observation, Prediction, Receipt
from scroll_tactile.sensors import Sensor
from scroll_tactile.settings import Settings, candidates_of, names_of, require_name, require_source, require_text
from scroll_tactile.signals.copies import Augmented, require_augmentable
from scroll_tactile.signals.ranges import range_problem
from scroll_tactile.signals.stream import Stream
from scroll_tactile.signals.windows import Scale, WindowPlan
from scroll_tactile.validation.gate import open_store
from store.files import is_there

if TYPE_CHECKING:
    from scroll_tactile.finetune.network import TunedReader
    from scroll_tactile.live.session import LiveSession

__all__ = ["TactileLearner"]

logger = logging.getLogger(__name__)

Answer = TypeVar("Answer")


class TactileLearner:
    """A memory of how materials feel: exact, durable where it has a path, and honest about what it never observed.

    >>> from scroll_tactile import TactileLearner, sensors
    >>> from scroll_tactile.simulation.scene import Scene
    >>> scene = Scene(sensor=sensors.BIOTAC)
    >>> learner = TactileLearner(sensor=sensors.BIOTAC)
    >>> receipts = [learner.observe(name, scene.touch(name, i)) for i in range(4) for name in scene.materials[:3]]
    >>> learner.predict(scene.touch(scene.materials[1], 9)).material == scene.materials[1]
    True

    sensor: whose streams it reads. embedding: the frozen features; `Kernels()` unless given, and `Frames()` for a
    camera. Of a camera's frames only those count in which the gel is pressed (see `signals.contact`).
    augmentation: the copies that each touch is observed with, as one observation; see `Augmented`.
    settings: readout, false_alarms, kept_touches and exemplars, by name; see `scroll_tactile.settings.Settings`.

    A learner made this way is in memory only; `TactileLearner.open` makes one with a path. Methods may be called from
    any thread. `pickle` and `copy.deepcopy` make a snapshot: a learner in memory only that knows what this one knows at
    that moment; its repr names the memory that it was taken of. One of a learner that was closed may not know which
    touches it has: `names_of` then raises StoreClosedError, and so does `observe` without again=True.

    Raises InputError for unknown settings, and for values that do not fit.
    """

    def __init__(
        self,
        *,
        sensor: Sensor,
        embedding: Embedding | None = None,
        augmentation: Augmented | None = None,
        **settings: Any,
    ) -> None:
        require_arguments({"sensor": sensor}, {"embedding": embedding, "augmentation": augmentation})
        require_augmentable(sensor, augmentation)
        chosen = usual_embedding(sensor) if embedding is None else embedding
        given = Settings(**settings)
        exemplars = usual_exemplars(sensor) if given.exemplars is None else given.exemplars
        kept_touches = default_kept_touches(sensor, chosen) if given.kept_touches is None else given.kept_touches
        self._set_up(sensor, chosen, augmentation, given, exemplars, kept_touches)
        self._ledger = Ledger(self._empty_memory, contents=Contents())

    def _set_up(
        self,
        sensor: Sensor,
        embedding: Embedding,
        augmentation: Augmented | None,
        settings: Settings,
        exemplars: int,
        kept_touches: int,
    ) -> None:
        self._sensor = sensor
        self._embedding = embedding
        self._augmentation = augmentation
        self._settings = settings.model_copy(update={"exemplars": exemplars, "kept_touches": kept_touches})
        self._plan = window_plan(sensor, embedding)
        self._extractor = FeatureExtractor(sensor, embedding, self._plan, augmentation)
        self._unverified: tuple[Identity, Path] | None = None
        self._verified_to_read: Embedding | None = None
        self._snapshot_of: str | None = None
        self._range_said = False
        self._current = CurrentModel(self._settings, self._extractor)
        self._tuned_reader: TunedReader | None = None

    def _empty_memory(self, encode: Callable[[npt.NDArray[np.float32]], Codes] | None = None) -> Memory:
        keeping = Keeping(self._sensor, self._settings.kept_touches or 0)
        return Memory(self._embedding.dimension, self._plan, self._settings.exemplars or 0, encode, keeping)

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        *,
        sensor: Sensor | None = None,
        embedding: Embedding | None = None,
        augmentation: Augmented | None = None,
        mode: Literal["write", "read"] = "write",
        **settings: Any,
    ) -> TactileLearner:
        """Open the memory in folder `path`, or make a new one there; the other arguments are those of the class.

        An existing memory knows what it was made with: leave out sensor, augmentation, exemplars, and an embedding that
        ships with scroll-tactile. Nothing is embedded before the first touch.
        mode: "read" shows what was committed when it was opened, also while another process writes the memory.

        Raises SensorMismatchError, EmbeddingMismatchError or MismatchError for a memory made with others, or with a
        user's own embedding that is not passed; InputError where a new memory is given no sensor; StoreError (locked,
        damaged, not a store, a newer version, or one of 0.x …).
        """
        made_with = {"sensor": sensor, "embedding": embedding, "augmentation": augmentation}
        require_arguments({"path": path, "mode": mode}, made_with)
        chosen = Settings(**settings)
        finish_interrupted(Path(path))
        if sensor is None and not is_there(Path(path)):
            raise InputError(f"there is no memory in {path}; to make one, say which sensor it is for")
        store = open_store(path, sensor, embedding, augmentation, chosen.exemplars, chosen.kept_touches, mode)
        try:
            identity = Identity.read(store)
            identity.require(store.path, sensor, augmentation, chosen.exemplars, chosen.kept_touches)
            if embedding is None:
                found = identity.own_embedding(store.path)
                identity.require_plan(store.path, found)
            else:
                found = embedding
                identity.require_embedding(store.path, found)
            store.read_with(window_plan(identity.sensor, found))
            learner = cls.__new__(cls)
            kept = identity.exemplars, identity.kept_touches
            learner._set_up(identity.sensor, found, identity.augmentation, chosen, *kept)
            learner._unverified = (identity, store.path) if embedding is None else None
            bare = identity.embedding.bare
            empty = learner._empty_memory(learner._codes_of if bare or capabilities_of(found).exact else None)
            learner._ledger = Ledger(partial(load, empty, store), store, bare)
        except BaseException:
            store.close()
            raise
        return learner

    def _codes_of(self, readings: npt.NDArray[np.float32]) -> Codes:
        """The rows of codes of a touch whose readings a memory kept."""
        touch = Stream(self._sensor, readings)
        extractor = self._verified()
        return extractor.codes(extractor.image(touch), touch.key)

    @contextmanager
    def _locked(self) -> Iterator[Ledger]:
        """The ledger, and its lock: the one that is there when the lock is had, for `reembed` puts another in place."""
        while True:
            ledger = self._ledger
            with ledger.lock:
                if ledger is self._ledger:
                    yield ledger
                    return

    def __getstate__(self) -> dict[str, Any]:
        with self._locked() as ledger:
            candidates = exemplar_candidates(ledger.memory, ledger.store)
            arrays, attributes = ledger.memory.to_arrays(candidates=candidates)
            name = self._snapshot_of or ("a memory without a path" if self.path is None else str(self.path))
            made_with = self._sensor, self._embedding, self._augmentation, self._settings
            held = arrays, attributes, ledger.memory.sequence
            state = {"made_with": made_with, "unverified": self._unverified, "held": held, "of": name}
            return state | {"contents": ledger.copied_contents()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        sensor, embedding, augmentation, settings = state["made_with"]
        self._set_up(sensor, embedding, augmentation, settings, settings.exemplars, settings.kept_touches)
        self._unverified, self._snapshot_of = state["unverified"], state["of"]
        self._ledger = Ledger(lambda: self._empty_memory().fill(*state["held"]), contents=state["contents"])
        logger.info("a snapshot of %s, in memory only", state["of"])

    def __repr__(self) -> str:
        where = "in memory" if self.path is None else str(self.path)
        snapshot = "" if self._snapshot_of is None else f", a snapshot of {self._snapshot_of}"
        return f"<TactileLearner {where}{snapshot}, {self.sensor.name}, {len(self.materials)} materials>"

    @property
    def sensor(self) -> Sensor:
        """The sensor whose streams it reads."""
        return self._sensor

    @property
    def embedding(self) -> Embedding:
        """The frozen features that it learns."""
        return self._embedding

    @property
    def augmentation(self) -> Augmented | None:
        """The copies that each touch is observed with."""
        return self._augmentation

    @property
    def settings(self) -> Settings:
        """How it reads its memory, with the exemplars that the memory was made with."""
        return self._settings

    @property
    def plan(self) -> WindowPlan:
        """Which windows of a touch are read, and which of them judge."""
        return self._plan

    @property
    def path(self) -> Path | None:
        """The folder of the memory; None where it is in memory only."""
        return None if self._ledger.store is None else self._ledger.store.path

    @property
    def memory(self) -> Memory:
        """What it has learned: statistics, sample, exemplars, descriptions and f*. Read it; never change it."""
        with self._locked() as ledger:
            return ledger.memory

    @property
    def materials(self) -> dict[str, int]:
        """Material → number of observations, in alphabetical order."""
        with self._locked() as ledger:
            return ledger.memory.statistics.materials

    def stream(self, readings: Readings) -> Stream:
        """What `observe` makes of readings before it learns them: sound, and of a camera's the frames in contact.

        Raises StreamError, and SensorMismatchError for another sensor's stream.
        """
        return self._extractor.stream(readings)

    def observe(self, material: str, stream: Readings, *, source: str | None = None, again: bool = False) -> Receipt:
        """Learn that this stream is how the material feels; it is durable when this returns.

        One content is one touch: of readings that the memory has under this name nothing is learned a second time, and
        the receipt is that of the first, `repeated`. again: they count once more all the same.

        material: its name, any; a new one needs no announcement. stream: readings of shape (T, n) in the sensor's
        unit, T of at least two: an array, a tensor, lists, or an iterable of readings; of a camera frames,
        (T, height, width, 3), the first of the gel at rest (see `Frames`), of which those in contact are kept.
        source: where it comes from, such as a file's name: kept in the journal for `observations`, and nothing else.

        Raises StreamError (NoContactError where the gel was not pressed), MaterialError or InputError for a name or a
        source that is none (nothing was kept), CapacityError, or StoreError. Warns once, by a RangeWarning, where a
        touch does not fit the sensor's range; it is learned all the same.
        """
        material, source = require_name(material), None if source is None else require_source(source)
        ledger = self._ledger  # first: `reembed` exchanges it last, and the one before is closed then
        extractor = self._verified()
        touch = extractor.stream(stream)
        image = extractor.image(touch)
        codes = extractor.codes(image, touch.key)
        receipt = ledger.observe(material, touch, image.shape[1], codes, source, again=again)
        with self._locked() as ledger:
            self._current.prepare(ledger)
        if not self._range_said and (problem := range_problem(touch)) is not None:
            self._range_said = True
            warnings.warn(problem, RangeWarning, stacklevel=2)
        return receipt

    def names_of(self, stream: Readings) -> list[str]:
        """The materials of which the memory has these very readings: none for a touch that it never learned.

        stream: as for `observe`. Raises StreamError; SensorMismatchError for another sensor's stream; StoreError.
        """
        touch = self._extractor.stream(stream)
        with self._locked() as ledger:
            return ledger.contents().names(touch.key)

    def describe(self, material: str, constituents: Mapping[str, float | bool | None] | None) -> None:
        """Say what a material is made of, before or after it is touched; durable when this returns.

        constituents: name → share by mass, from 0 to 1, summing to one; a mass that is not named is absent. For
        attributes that are no masses: True or False; one that is not named is unknown. None for a name: unknown, and
        nothing is learned of that constituent from this material. None for all: removes the description.

        A later description replaces an earlier one as a whole; the same one again changes nothing. Statistics and
        `digest` stay as they are. `forget` removes the description too, `retract` does not.

        Raises MaterialError, DescriptionError for shares that are negative, not finite or do not sum to one, or names
        that cannot be used (nothing was changed); StoreError.
        """
        material = require_name(material)
        self._ledger.describe(material, None if constituents is None else checked(material, constituents))

    @property
    def descriptions(self) -> dict[str, Description]:
        """Material → its description, in alphabetical order, whether it was observed or not."""
        with self._locked() as ledger:
            described = ledger.memory.descriptions
            return {name: dict(description) for name, description in sorted(described.items())}

    @contextmanager
    def batch(self) -> Iterator[None]:
        """Make what is observed, retracted or forgotten in the block durable together, when it ends.

        For many touches: it waits for the disk once. If the process dies in the block, none of it is kept; after an
        exception, what came before it is. Other threads wait for its end, and it allows no fine-tuning, merging,
        compacting or closing. In a memory without a path it does nothing.

        Raises StoreError where the batch could not be made durable: the memory is then as it was before it.
        """
        with self._ledger.batch():
            yield

    def retract(self, receipt: Receipt | int) -> None:
        """Take one observation out again, by its receipt or its sequence; durable when this returns.

        Statistics, exemplars and readouts are then, to the bit, those of a memory that never had it; an f* that was
        made from it is gone. Its features stay in the journal, unused, until `compact`.

        Raises ObservationError (nothing was changed) for one that is not there, was retracted before or was
        compacted, or for a receipt of another memory; InputError in a memory without a path; StoreError.
        """
        self._ledger.retract(receipt)

    def relabel(self, receipt: Receipt | int, material: str) -> int:
        """Give an observation another name: retract it and observe its readings under the new one, durable as one.

        Returns its new sequence; it keeps its time and source. A description stays with the name that it was given to.

        Raises what `retract` raises (nothing was changed), also MaterialError for a name that is none; InputError where
        it has that name already, and in a batch.
        """
        return self._ledger.relabel(receipt, require_name(material))

    def forget(self, material: str | None = None, *, source: str | None = None) -> int:
        """Retract all observations of a material, or from a source, as `retract` does one; returns how many.

        A forgotten material loses its description, too. source: a file, as `observations` names it, or a folder or
        address that files lie in, such as a robot's day.

        Raises UnknownMaterialError for a material never observed, and ObservationError (nothing was changed) where some
        of them were compacted, or a source has none; InputError for both or neither, and in a memory without a path;
        StoreError.
        """
        if (material is None) == (source is None):
            raise InputError("say what is to be forgotten: a material, or a source")
        if material is not None:
            require_text(material)
        return self._ledger.forget(material, None if source is None else require_source(source))

    def merge(
        self,
        other: TactileLearner | str | os.PathLike[str],
        *,
        shared: Literal["once", "twice"],
        descriptions: Choice = "same",
        progress: Callable[[str, int, int], object] | None = None,
    ) -> Merged:
        """Add everything that another memory observed; durable, as a whole, when this returns.

        other: a memory with a path, its path, or a file that `pack` wrote; it stays as it is. shared: whether a stream
        that both observed (one material, one content hash) counts once or twice. Receipts of the other memory are not
        receipts of this one.
        descriptions: which to keep of a material that both describe: "ours", "theirs", or "same", if they must agree.

        Raises MismatchError for a memory of another sensor, embedding or grid, and for a different description where
        they must agree; ObservationError where a shared stream was compacted and cannot be left out; CapacityError,
        InputError, StoreError. Nothing was changed then.
        """
        path = other._ledger.require_store("be merged").path if isinstance(other, TactileLearner) else other
        require_arguments({"other": path, "shared": shared, "descriptions": descriptions}, {"progress": progress})
        rules = MergeRules(once=shared == "once", descriptions=descriptions)
        return self._ledger.merge(path, rules, progress or _silent)[0]

    def backup(
        self, destination: str | os.PathLike[str], *, progress: Callable[[str, int, int], object] | None = None
    ) -> None:
        """Copy the memory to a new folder, also while it is in use: whole, as it was at one moment, or not at all.

        Raises InputError in a memory without a path; StoreError where something is there already, or it cannot be
        written or verified.
        """
        require_arguments({"destination": destination}, {"progress": progress})
        self._ledger.require_store("be copied").backup(destination, progress=progress)

    def pack(
        self, path: str | os.PathLike[str], *, rows: bool = True, readings: bool = True, source: str | None = None
    ) -> None:
        """Write the memory as one file that travels, and that `merge` takes; whole and durable, or not there at all.

        It holds what was learned: sums, sampled touches, kept touches and descriptions, and of each observation its
        name, content hash, time and source. f* and retracted observations stay behind.
        rows: also each observation's readings, or codes where the memory has no readings, so that it can be retracted
        where the file is merged, and counted once where it is there already. They are left out of a memory of which any
        were compacted. Without them come the readings of the exemplars. readings: False leaves out all that shows a
        touch as it was read: rows, exemplars and kept touches. Such a file merges into memories made with
        exemplars=0 and kept_touches=0. source: what is said of observations that have none.

        Raises InputError in a memory without a path, and for a source that is none; StoreError.
        """
        require_arguments({"path": path})
        said = None if source is None else require_source(source)
        with self._locked() as ledger:
            store = ledger.require_store("be packed")
            pack_memory(store, ledger.memory, Path(path), rows=rows, readings=readings, source=said)

    def compact(self, *, keep: int = 0) -> Compacted:
        """Give up the features and readings of old observations, for space; what was learned from them stays.

        keep: how many of the newest observations can still be retracted afterwards, by `retract` and `forget`; the
        older ones cannot any more. What was retracted before is gone from the disk, too.

        Raises InputError for a keep below 0, in a batch, and in a memory without a path; StoreError.
        """
        return self._ledger.compact(keep)

    def reembed(
        self, embedding: Embedding | None = None, *, progress: Callable[[str, int, int], object] | None = None
    ) -> Path:
        """Carry the memory over to another embedding, from the readings in its journal; durable when this returns.

        embedding: None for its own as it is now, with the packages and on the machine at hand. progress: called with
        (what is being done, rows done, rows in all).

        The memory is whole and can be used until the new one takes its place; returns the folder in which it lies from
        then on, to be removed once nobody needs it. A call that was cut short is resumed by the next. Observations
        keep their receipts, retractions and descriptions stay; an f* is gone. Other calls that wait meanwhile raise
        StoreClosedError. `reembed_memory` does this with a memory that does not open.

        Raises MismatchError where readings are missing, as in a compacted memory; InputError in a memory without a
        path and in a batch; StoreError. The memory is then as it was; where the exchange itself failed it is closed.
        """
        require_arguments({}, {"embedding": embedding, "progress": progress})
        with self._locked() as ledger:  # not in the midst of another thread's batch
            store = ledger.require_store("be embedded again")
            ledger.require_writing()
        chosen = Identity.read(store).own_embedding(store.path) if embedding is None else embedding
        carried = reembedding(store, chosen)
        try:
            carried.copy(progress or _silent)
            with self._locked() as ledger:
                ledger.require_writing()
                carried.copy(progress or _silent)
                self.close()
                before = carried.put_in_place()
                own: dict[str, Any] = self._settings.model_dump(exclude={"exemplars", "kept_touches"})
                self.__dict__.update(type(self).open(store.path, embedding=chosen, **own).__dict__)
        finally:
            carried.close()
        return before

    def refresh(self) -> bool:
        """In a memory opened to read, take in what was committed since; whether there was anything.

        Raises StoreError; what was known before stays then.
        """
        return self._ledger.refresh()

    def predict(self, *streams: Readings, scene: Sequence[str] | None = None, tuned: bool = False) -> Prediction:
        """Classify a stream among the materials observed; the memory stays as it is, and the answer is of one state.

        streams: one, as for `observe`, or several touches of one thing: what they say adds up, as far as touches of one
        material do not say the same anyway. Their order makes no difference, and one that comes twice counts once.
        scene: the materials that can be here; None: all that were observed.
        tuned: let f* answer (see `fine_tune`), if one was kept, knows all candidates, and the touch is long enough for
        it; f answers otherwise. `Prediction.tuned` says which of them did: of several touches, whether f* did of all.

        Raises StreamError, UnknownMaterialError for a scene that names a material never observed, InputError for an
        empty one, and for no stream. Before anything was observed the answer is material None, known False.
        """
        wanted = names_of("scene", scene)
        if not streams:
            raise InputError("expected a stream to predict, or several of one thing; came none")
        touches = [self._extractor.stream(stream) for stream in streams]

        def begin(model: Model, extractor: FeatureExtractor) -> Callable[[], Prediction]:
            reader, candidates = self._reader() if tuned else None, candidates_of(wanted, model.names, model.known)
            if not candidates:
                seconds = math.fsum({touch.key: touch.seconds for touch in touches}.values())
                return lambda: Prediction(None, 0.0, (), float("inf"), False, seconds)

            def read(touch: Stream) -> Touch:
                encoded = extractor.encode(touch, model.longest, lambda columns: model.scales_for(candidates, columns))
                if reader is None or not model.is_last(encoded.steps):
                    return encoded, None
                return encoded, reader.logits_of(encoded.image, candidates)

            return lambda: self._answer(model, extractor, candidates, [read(touch) for touch in touches])

        return self._of_one_state(begin)

    def live(
        self,
        *,
        risk: float = 0.05,
        contact: Literal["auto", "manual"] = "auto",
        false_contacts: float = 1.0,
        scene: Sequence[str] | None = None,
    ) -> LiveSession:
        """Begin to take readings as they come; see `LiveSession.push`.

        risk: the share of wrong answers among those that are decided. contact: "auto" finds touches by the sensor's own
        noise at rest, which it learns first: for two seconds nothing may touch it. "manual" leaves that to
        `LiveSession.begin` and `end`. false_contacts: an hour, that noise alone may make. scene: as for `predict`.

        Each touch is predicted by the memory as it was when it began, and by itself unless `LiveSession.again` says
        that it is of the same thing as the last.

        Raises InputError for values that cannot be, and for "auto" with frames that have no resting image;
        UnknownMaterialError for a scene that names a material never observed.
        """
        from scroll_tactile.live.session import LiveSession, Memory

        extractor = self._verified_to_predict()
        with self._locked() as ledger:
            current, embedding = self._current, extractor.embedding

        def frozen() -> FrozenModel:
            with ledger.lock, enough_memory():
                return current.frozen(ledger)

        @contextmanager
        def turn(model: Model) -> Iterator[None]:
            if not model.reads_memory:
                yield
                return
            with ledger.lock:
                yield

        def answered(model: Model, candidates: Sequence[str], touches: Sequence[Encoded]) -> Prediction:
            with turn(model), enough_memory():
                return self._answer(model, extractor, candidates, [(touch, None) for touch in touches])

        def require_current() -> None:
            if self._ledger is not ledger:
                raise InputError(
                    "the memory was embedded again: close this session, and begin another with learner.live()"
                )

        memory = Memory(self._sensor, embedding, extractor, frozen, turn, answered, require_current)
        return LiveSession(memory, risk=risk, contact=contact, false_contacts=false_contacts, scene=scene)

    def _of_one_state(self, begin: Callable[[Model, FeatureExtractor], Callable[[], Answer]]) -> Answer:
        """An answer that rests on one state of the memory, which others may change while a touch is embedded.

        begin: reads what it needs of the memory beside its model, and gives what reads the touch and answers.
        """
        with self._locked() as ledger:
            reading = self._current.reading(ledger)
        try:
            with self._verifying(reading.embedding), enough_memory():
                with self._locked() as ledger:
                    frozen = self._current.frozen(ledger)
                    answer = begin(frozen.model, reading)
                    if frozen.model.reads_memory:
                        return answer()
                return answer()
        except EmbeddingMismatchError as error:
            self._disbelieve(reading, error)
            return self._of_one_state(begin)

    def compose(
        self, stream: Readings, *, constituents: Sequence[str] | None = None, unfamiliar: float = 0.5
    ) -> Composition:
        """Estimate what the touched material is made of, from the descriptions; the memory stays as it is.

        stream: as for `observe`. constituents: which of them; None: all that were described. unfamiliar: the
        probability, before the touch, that the material was never observed: 1 where that is certain, 0 where it cannot
        be.

        For a material that was observed the estimate is the composition of the materials it feels like, for one that
        was not that of heads over all described materials (see `prediction.composition`); the touch's novelty weighs
        the two. A constituent that all materials have, or none, cannot be learned: `Constituent.unlearned` says so.

        Raises StreamError; DescriptionError where nothing was described, or for a constituent that no description
        names; InputError for an unfamiliar that is no probability.
        """
        require_arguments({"unfamiliar": unfamiliar})
        named = names_of("constituents", constituents, DescriptionError)
        touch = self._extractor.stream(stream)

        def begin(model: Model, extractor: FeatureExtractor) -> Callable[[], Composition]:
            wanted = require_constituents(self._ledger.memory.descriptions, named)
            if not model.names:
                nothing = tuple(Constituent(name, None, None, (), "nothing was observed yet") for name in wanted)
                unknown = Prediction(None, 0.0, (), float("inf"), False, touch.seconds)
                return lambda: Composition(nothing, 1.0, unknown)
            composer = self._current.composer(self._ledger, model)

            def scales_for(columns: int) -> list[Scale]:
                return sorted({*model.scales_for(model.names, columns), *composer.scales_for(columns)})

            def composed() -> Composition:
                encoded = extractor.encode(touch, model.longest, scales_for)
                prediction = self._answer(model, extractor, model.names, [(encoded, None)])
                made_of, new = composer.compose(wanted, dict(prediction.ranking), encoded, unfamiliar)
                return Composition(made_of, new, prediction)

            return composed

        return self._of_one_state(begin)

    @contextmanager
    def _verifying(self, embedding: Embedding) -> Iterator[None]:
        """Compare the fingerprint of an embedding that was made again, beside what the block does: it embeds, too."""
        unverified = self._unverified
        if unverified is None or embedding is self._verified_to_read:
            yield
            return
        identity, path = unverified
        with ThreadPoolExecutor(1, "scroll-tactile fingerprint") as beside:
            compared = beside.submit(identity.require_embedding, path, embedding)
            try:
                yield
            finally:
                compared.result()  # of another embedding nothing else that the block raised means anything
        self._verified_to_read = embedding
        if embedding is self._embedding:
            self._unverified = None

    def _verified_to_predict(self) -> FeatureExtractor:
        """The extractor that reads the touches that predictions are asked for, after its fingerprint was compared."""
        with self._locked() as ledger:
            reading = self._current.reading(ledger)
        try:
            with self._verifying(reading.embedding):
                return reading
        except EmbeddingMismatchError as error:
            self._disbelieve(reading, error)
            return self._verified()

    def _disbelieve(self, reading: FeatureExtractor, error: EmbeddingMismatchError) -> None:
        """Let go what was read from the disk; raise the error where nothing was."""
        if reading is self._extractor:
            raise error
        with self._locked():
            self._current.disbelieve()

    def _verified(self) -> FeatureExtractor:
        """The extractor of features, after the fingerprint of an embedding that was made again has been compared."""
        unverified = self._unverified
        if unverified is not None:
            identity, path = unverified
            identity.require_embedding(path, self._embedding)
            self._unverified = None
        return self._extractor

    def _answer(
        self, model: Model, extractor: FeatureExtractor, candidates: Sequence[str], touches: Sequence[Touch]
    ) -> Prediction:
        return answer(model, extractor, candidates, touches, self._settings.false_alarms)

    def settle(self) -> None:
        """Fit all that answers rest on to the memory as it is now: they are then a function of what was observed.

        Between two such moments the readouts are those of all that was observed, to rounding; the calibration may rest
        on a sixth fewer touches, or two. The memory itself is always exact, and knows nothing of this.

        Raises CapacityError where the system has no memory left for it; `predict` does, too.
        """
        with self._locked() as ledger, enough_memory():
            self._current.settle(ledger)

    def model(self) -> Model:
        """The readouts and calibrations of the memory as it is now, as after `settle`; later touches are not in it."""
        with self._locked() as ledger, enough_memory():
            model = Draft.of(ledger.memory, self._settings.readout).fit(self._extractor)
            model.freeze(ledger.memory.statistics)
            return model

    def digest(self) -> str:
        """Hex, equal for two memories if and only if they hold the same bytes of statistics."""
        with self._locked() as ledger:
            return ledger.memory.statistics.digest()

    def observations(self) -> list[Observation]:
        """Every observation in the journal, in order, and its state; none in a memory without a path.

        Raises StoreError.
        """
        with self._locked() as ledger:
            return [] if ledger.store is None else observations(ledger.store)

    @property
    def exemplars(self) -> dict[str, list[bytes]]:
        """Material → content hashes of its exemplars, in rank order; materials in alphabetical order."""
        return {name: [exemplar.key for exemplar in ranked] for name, ranked in self.ranked_exemplars().items()}

    def ranked_exemplars(self) -> dict[str, list[Exemplar]]:
        """Material → its exemplars with their readings (T, n) in the sensor's unit, in rank order.

        Raises StoreError; CompactedError in a memory opened to read that was compacted since: `refresh` it first.
        """
        with self._locked() as ledger:
            return ranked_exemplars(ledger.memory, ledger.store)

    def fine_tune(
        self,
        *,
        epochs: int | None = None,
        seed: int = 0,
        device: str = "cpu",
        progress: Callable[[str, int, int], object] | None = None,
    ) -> TuneReport:
        """Make f* from f by training on the exemplars; durable when this returns.

        epochs: the most, 8 unless given; exemplars held out decide how many are taken. seed: of the order and the
        augmentation. device: as torch names it. progress: called with (what is being done, steps done, steps in all).

        The same memory, seed and device give the same f*, to the bit. f stays as it is, and observing more does not
        change f*. Where f* is not clearly better than f on the exemplars held out, the report says so and f answers.
        After an interruption or an error the earlier f* stays.

        Raises InputError where there are no exemplars, fewer of them than materials, one material only, or none long
        enough; FineTuneError where the loss is not finite or the device has no memory left; StoreError.
        """
        from scroll_tactile.finetune.fine_tune import fine_tune

        require_arguments({}, {"progress": progress})
        self._verified()
        with self._locked() as ledger:
            ledger.require_writing()
            model, ranked, memory = self.model(), self.ranked_exemplars(), ledger.memory
            last_sequence, retractions = memory.sequence, memory.retractions
            statistics = copy.deepcopy(memory.statistics)
        tuned, report = fine_tune(
            self._embedding,
            model,
            statistics,
            ranked,
            self._extractor,
            epochs=epochs,
            seed=seed,
            device=device,
            progress=progress or _silent,
        )
        ledger.keep_tuned(tuned, memory, last_sequence, retractions)
        return report

    def tuned_digest(self) -> str | None:
        """Hex of a SHA-256 of f*'s weights, whether it answers or not; None before a fine-tune."""
        with self._locked() as ledger:
            tuned = ledger.memory.tuned
            return None if tuned is None else tuned.digest()

    def _reader(self) -> TunedReader | None:
        from scroll_tactile.finetune.network import TunedReader

        tuned = self._ledger.memory.tuned
        if tuned is None or not tuned.kept:
            return None
        if self._tuned_reader is None or self._tuned_reader.tuned is not tuned:
            self._tuned_reader = TunedReader(self._embedding, self._plan, tuned)
        return self._tuned_reader

    def close(self) -> None:
        """Write a checkpoint, so that opening replays nothing, and release the files; a second call does nothing.

        Where a prediction or `settle` has fitted a model that is kept, too, and the first prediction after opening
        fits nothing.

        Nothing is lost without it: what `observe` acknowledged is in the journal. `predict` still answers afterwards,
        `observe` raises StoreClosedError.
        """
        with self._locked() as ledger:
            ledger.close(NAME, lambda: self._current.kept(ledger))
            self._current.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _silent(what: str, done: int, of: int) -> None:
    """The default progress: shows nothing."""

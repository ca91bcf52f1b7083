"""The learner: observes a material once, and knows it from then on."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy.typing as npt

from scroll_tactile.arguments import require_arguments, silent
from scroll_tactile.embeddings.protocol import Embedding
from scroll_tactile.errors import AnnotationError, DescriptionError, InputError
from scroll_tactile.health.channel_numbers import MOST_CHANNELS, has_numbers
from scroll_tactile.health.watch import WatchRules
from scroll_tactile.memory.descriptions import Description, checked
from scroll_tactile.memory.exemplars import Exemplar
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.tuned import TuneReport
from scroll_tactile.persistence.ledger import Ledger
from scroll_tactile.persistence.merge import Choice, pack_memory
from scroll_tactile.persistence.observations import observations, rows_with
from scroll_tactile.persistence.replaying import ranked_exemplars
from scroll_tactile.persistence.sensor_rows import adapt_to, health_of, known_touches
from scroll_tactile.prediction.features import Readings
from scroll_tactile.prediction.model import Model
from scroll_tactile.prediction.predictor import Predictor, embed_again
from scroll_tactile.quantities import Quantity
from scroll_tactile.recipe import Recipe, RecipeRequest
from scroll_tactile.results import (
    Adaptation,
    Compacted,
    Composition,
    Estimate,
    Health,
    Merged,
    Observation,
    Prediction,
    Receipt,
)
from scroll_tactile.sensors import Sensor
from scroll_tactile.settings import Settings, names_of, require_name, require_source
from scroll_tactile.signals.correction import corrected_stream
from scroll_tactile.signals.facts import Fact, judged, name_fact, touch_facts, warn_of
from scroll_tactile.signals.stream import Stream, validate
from scroll_tactile.signals.windows import WindowPlan
from scroll_tactile.statistics.annotations import NO_ANNOTATION, Annotation

if TYPE_CHECKING:
    from scroll_tactile.clients.firmware.exported_judge import ExportedJudge
    from scroll_tactile.live.session import LiveSession

__all__ = ["TactileLearner"]

logger = logging.getLogger(__name__)


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
    settings: readout, false_alarms, kept_touches and exemplars, by name; see `scroll_tactile.settings.Settings`.

    A learner made this way is in memory only; `TactileLearner.open` makes one with a path. Both keep a journal and do
    the same; the journal of this one grows in RAM. Of each touch it has what takes it out of the sums again: its
    readings (8 to 15 kB for 400 of a BioTac) where the embedding is exact, such as `Kernels`; else its codes, 4 bytes
    for each feature of each window, beside readings where exemplars or kept touches are kept. `compact` gives both up
    for a copy of the sums. Only `backup` and `reembed` take a path.

    Methods may be called from any thread. `pickle` and `copy.deepcopy` make a snapshot: a learner in memory only that
    knows what this one knows at that moment, as if it were compacted; its repr names the memory that it was taken of.
    Of a learner with a path it is made before that is closed: StoreClosedError afterwards.

    Raises InputError for unknown settings, and for values that do not fit.
    """

    def __init__(
        self,
        *,
        sensor: Sensor,
        embedding: Embedding | None = None,
        **settings: Any,
    ) -> None:
        require_arguments({"sensor": sensor})
        self._set_up(Predictor.new(RecipeRequest.of(sensor, embedding, settings).recipe()))

    def _set_up(self, predictor: Predictor, snapshot_of: str | None = None) -> None:
        self._predictor, self._snapshot_of, self._said = predictor, snapshot_of, set[tuple[str, str]]()

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        *,
        sensor: Sensor | None = None,
        embedding: Embedding | None = None,
        mode: Literal["write", "read"] = "write",
        **settings: Any,
    ) -> TactileLearner:
        """Open the memory in folder `path`, or make a new one there; the other arguments are those of the class.

        An existing memory knows what it was made with: leave out sensor, exemplars, and an embedding that ships with
        scroll-tactile. Nothing is embedded before the first touch.
        mode: "read" shows what was committed when it was opened, also while another process writes the memory.

        Raises SensorMismatchError, EmbeddingMismatchError or MismatchError for a memory made with others, or with a
        user's own embedding that is not passed; InputError where a new memory is given no sensor; StoreError (locked,
        damaged, not a store, a newer version, or one of 0.x …).
        """
        require_arguments({"path": path, "mode": mode})
        learner = cls.__new__(cls)
        learner._set_up(Predictor.open(path, RecipeRequest.of(sensor, embedding, settings), mode))
        return learner

    @property
    def _ledger(self) -> Ledger:
        return self._predictor.ledger

    def __getstate__(self) -> dict[str, Any]:
        name = self._snapshot_of or ("a memory without a path" if self.path is None else str(self.path))
        return {"of": name, "memory": self._predictor.snapshot()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._set_up(Predictor.of_snapshot(state["memory"]), state["of"])
        logger.info("a snapshot of %s, in memory only", state["of"])

    def __repr__(self) -> str:
        where = "in memory" if self.path is None else str(self.path)
        snapshot = "" if self._snapshot_of is None else f", a snapshot of {self._snapshot_of}"
        return f"<TactileLearner {where}{snapshot}, {self.sensor.name}, {len(self.materials)} materials>"

    @property
    def _recipe(self) -> Recipe:
        return self._predictor.recipe

    @property
    def sensor(self) -> Sensor:
        """The sensor whose streams it reads."""
        return self._recipe.sensor

    @property
    def embedding(self) -> Embedding:
        """The frozen features that it learns."""
        return self._recipe.embedding

    @property
    def settings(self) -> Settings:
        """How it reads its memory, with the exemplars that the memory was made with."""
        return self._recipe.settings

    @property
    def plan(self) -> WindowPlan:
        """Which windows of a touch are read, and which of them judge."""
        return self._recipe.plan

    @property
    def path(self) -> Path | None:
        """The folder of the memory; None where it is in memory only."""
        return self._ledger.path

    @property
    def has_health(self) -> bool:
        """Whether `health` can be asked: its sensor has 1 to 256 channels."""
        return has_numbers(self.sensor)

    @property
    def memory(self) -> Memory:
        """What it has learned: statistics, sample, exemplars, descriptions and f*. Read it; never change it."""
        return self._ledger.read(lambda memory, _: memory)

    @property
    def materials(self) -> dict[str, int]:
        """Material → number of observations, in alphabetical order."""
        return self._ledger.read(lambda memory, _: memory.statistics.materials)

    @property
    def descriptions(self) -> dict[str, Description]:
        """Material → its description, in alphabetical order, whether it was observed or not."""
        described = self._ledger.read(lambda memory, _: sorted(memory.descriptions.items()))
        return {name: deepcopy(description) for name, description in described}

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Name → the declared quantity, in alphabetical order, whether a touch carries a value of it or not."""
        return self._ledger.read(lambda memory, _: dict(sorted(memory.quantities.items())))

    @property
    def axes(self) -> dict[str, dict[str, int]]:
        """Axis → label → the number of observations that carry it, both in alphabetical order."""
        return self._ledger.read(
            lambda memory, _: {axis: own.materials for axis, own in sorted(memory.targets.axes.items())}
        )

    @property
    def exemplars(self) -> dict[str, list[bytes]]:
        """Material → content hashes of its exemplars, in rank order; materials in alphabetical order."""
        return {name: [exemplar.key for exemplar in ranked] for name, ranked in self.ranked_exemplars().items()}

    def digest(self) -> str:
        """Hex, equal for two memories if and only if they hold the same bytes of statistics."""
        return self._ledger.read(lambda memory, _: memory.digest())

    def tuned_digest(self) -> str | None:
        """Hex of a SHA-256 of f*'s weights, whether it answers or not; None before a fine-tune."""
        tuned = self.memory.tuned
        return None if tuned is None else tuned.digest()

    def stream(self, readings: Readings) -> Stream:
        """What `observe` makes of readings before it learns them: sound, and of a camera's the frames in contact.

        Of a memory that was adapted to a changed skin, read through that, and no second time wherever it is passed.

        Raises StreamError, and SensorMismatchError for another sensor's stream.
        """
        return self._predictor.stream(readings)

    def observe(
        self,
        material: str,
        stream: Readings,
        *,
        values: Mapping[str, float] | None = None,
        labels: Mapping[str, str] | None = None,
        source: str | None = None,
    ) -> Receipt:
        """Learn that this stream is how the material feels; it is durable when this returns.

        One content is one touch: of readings that the memory has under this name nothing is learned a second time, and
        the receipt is that of the first, `repeated`.

        material: its name, any; a new one needs no announcement. stream: readings of shape (T, n) in the sensor's
        unit, T of at least two: an array, a tensor, lists, or an iterable of readings; of a camera frames,
        (T, height, width, 3), the first of the gel at rest (see `Frames`), of which those in contact are kept.
        values: what was measured of the touch, by quantity, each declared before and in its unit; see `declare`.
        labels: what else it is, by axis, such as {"slip": "north"}; axes and labels need no announcement.
        source: where it comes from, such as a file's name: kept in the journal for `observations`, and nothing else.

        Raises StreamError (NoContactError where the gel was not pressed), MaterialError or InputError for a name or a
        source that is none, AnnotationError for a value that is none of its quantity, or other values or labels than
        the memory has of this touch (nothing was kept), CapacityError, or StoreError. Warns by a FactWarning, once of
        each kind, of what is odd about a touch or its name (see `signals.facts.RULES`); it is learned all the same.
        """
        material, source = require_name(material), None if source is None else require_source(source)
        predictor = self._predictor  # one: `reembed` puts another in its place
        noted = Annotation.of(self.quantities, values, labels) if values or labels else NO_ANNOTATION
        predictor.extractor.verified()
        touch = predictor.stream(stream)
        learned = predictor.extractor.learned(touch)
        facts = self._facts_of(touch, material)
        receipt = predictor.ledger.observe(material, touch, *learned, source, noted)
        predictor.prepare()
        for fact in facts:
            if (fact.kind, fact.about) not in self._said:
                self._said.add((fact.kind, fact.about))
                warn_of(fact)
        return receipt

    def _facts_of(self, stream: Readings, material: str | None = None, *, source: str = "") -> list[Fact]:
        """What is odd about a touch, see `signals.facts.RULES`, and about the name that it is to be learned under.

        Raises as `stream` does, and StoreError.
        """
        touch = self.stream(stream)
        facts = touch_facts(touch if touch.raw is None else touch.raw, source)
        if material is not None:
            facts += name_fact(material, self.materials)
            others = [name for name in self.names_of(touch) if name != material]
            facts += judged(
                "known", len(others), source, about=f"{material}\n{touch.key.hex()}", other=(*others, "")[0]
            )
        return facts

    @contextmanager
    def batch(self) -> Iterator[None]:
        """Make what is observed, retracted or forgotten in the block durable together, when it ends.

        For many touches: it waits for the disk once. If the process dies in the block, none of it is kept; after an
        exception, all that came before the exception is. Other threads wait for its end; fine-tuning, merging,
        compacting and closing are refused in it.

        Raises StoreError where the batch could not be made durable: the memory is then as it was before it.
        """
        with self._ledger.batch():
            yield

    def names_of(self, stream: Readings) -> list[str]:
        """The materials of which the memory has these very readings: none for a touch that it never learned.

        stream: as for `observe`. Raises StreamError; SensorMismatchError for another sensor's stream; StoreError.
        """
        touch = self._predictor.stream(stream)
        keys = [of.key for of in (touch.raw, touch) if of is not None]  # it may be from before an adaptation
        return self._ledger.read(lambda memory, store: [*{n: 0 for key in keys for n in rows_with(store, memory, key)}])

    def observations(self) -> list[Observation]:
        """Every observation in the journal, in order, and its state. Raises StoreError."""
        return self._ledger.read(lambda _, store: observations(store))

    def ranked_exemplars(self) -> dict[str, list[Exemplar]]:
        """Material → its exemplars with their readings (T, n) in the sensor's unit, in rank order.

        Raises StoreError; CompactedError in a memory opened to read that was compacted since: `refresh` it first.
        """
        return self._ledger.read(ranked_exemplars)

    def retract(self, receipt: Receipt | Adaptation | int) -> None:
        """Take one observation out again, by its receipt or its sequence; durable when this returns.

        Or one adaptation to a changed skin: touches are read from then on as before it, through the last that is left.
        What was learned meanwhile stays as it was read.

        Statistics, exemplars and readouts are then, to the bit, those of a memory that never had it; an f* that was
        made from it is gone. Its features stay in the journal, unused, until `compact`.

        Raises ObservationError (nothing was changed) for one that is not there, was retracted before or was
        compacted, or for a receipt of another memory; StoreError.
        """
        self._ledger.retract(receipt)

    def relabel(self, receipt: Receipt | int, material: str) -> int:
        """Give an observation another name: retract it and observe its readings under the new one, durable as one.

        Returns its new sequence; it keeps its time and source. Where the memory has these very readings under the new
        name it is retracted alone, and the sequence is that of the one there. A description stays with its name.

        Raises what `retract` raises (nothing was changed), also MaterialError for an invalid name; InputError where
        it has that name already, and in a batch; AnnotationError where the one there has other values or labels.
        """
        return self._ledger.relabel(receipt, require_name(material))

    def forget(self, material: str | None = None, *, source: str | None = None) -> int:
        """Retract all observations of a material, or from a source, as `retract` does one; returns how many.

        A forgotten material loses its description, too. source: a file, as `observations` names it, or a folder or
        address that files lie in, such as a robot's day.

        Raises UnknownMaterialError for a material never observed, and ObservationError (nothing was changed) where some
        of them were compacted, or a source has none; InputError for both or neither; StoreError.
        """
        if (material is None) == (source is None):
            raise InputError("say what is to be forgotten: a material, or a source")
        name = None if material is None else require_name(material)
        return self._ledger.forget(name, None if source is None else require_source(source))

    def describe(
        self, material: str, constituents: Mapping[str, float | bool | tuple[float, str] | None] | None
    ) -> None:
        """Say what a material is made of, before or after it is touched; durable when this returns.

        constituents: name → share by mass, from 0 to 1, summing to one; a mass that is not named is absent. For
        attributes that are no masses: True or False; one that is not named is unknown. None for a name: unknown, and
        nothing is learned of that constituent from this material. For a property of the material, such as its hardness:
        its value and unit, (62, "Shore A"), the same unit for all materials. None for all: removes the description.

        A later description replaces an earlier one as a whole; the same one again changes nothing. Statistics and
        `digest` stay as they are. `forget` removes the description too, `retract` does not.

        Raises MaterialError, DescriptionError for shares that are negative, not finite or do not sum to one, names
        that cannot be used, or a property in another unit (nothing was changed); StoreError.
        """
        material = require_name(material)
        self._ledger.describe(material, None if constituents is None else checked(material, constituents))

    def declare(self, quantity: Quantity) -> None:
        """Have touches carry values of this quantity from now on; durable when this returns. For ever: see `Quantity`.

        The same one again changes nothing. Statistics and `digest` stay as they are.

        Raises AnnotationError for another unit, range or resolution under a name that was declared, and for one of more
        than 64 (nothing was changed); StoreError.
        """
        self._ledger.declare(quantity)

    def predict(
        self,
        *streams: Readings,
        of: str | None = None,
        scene: Sequence[str] | None = None,
        tuned: bool = False,
    ) -> Prediction:
        """Classify a stream among the materials observed; the memory stays as it is, and the answer is of one state.

        streams: one, as for `observe`, or several touches of one thing: what they say adds up, as far as touches of one
        material do not say the same anyway. Their order makes no difference, and one that comes twice counts once.
        of: an axis of labels, such as "slip", to answer by in place of materials: `Prediction.material` is a label
        then, `known` and all else as for materials, from the touches that have a label on it.
        scene: the materials, or labels, that can be here; None: all that were observed.
        tuned: let f* answer (see `fine_tune`), if one was kept, knows all candidates, and the touch is long enough for
        it; f answers otherwise. `Prediction.tuned` says which of them did: of several touches, whether f* did of all.

        Raises StreamError, UnknownMaterialError for a scene that names a material never observed, AnnotationError for
        an axis that no touch has a label on, InputError for an empty scene, for no stream, and for `of` with `tuned`.
        Before anything was observed the answer is material None, known False.
        """
        wanted = names_of("scene", scene)
        if of is not None and tuned:
            raise InputError(f"f* answers by materials, and not by labels on {of!r}: leave out tuned, or of")
        if not tuned:
            return self._by(of).predict(streams, wanted)
        from scroll_tactile.finetune.network import reader_of

        return self._predictor.predict(streams, wanted, reader_of)

    def _by(self, axis: str | None) -> Predictor:
        """What answers by the labels on an axis; by materials where it is None."""
        return self._predictor if axis is None else self._predictor.of_axis(axis)

    def estimate(
        self, stream: Readings, *, of: Sequence[str] | None = None, risk: float = 0.1, known: bool | None = None
    ) -> dict[str, Estimate]:
        """Estimate quantities of a touch, such as its force, by name, with intervals; the memory stays as it is.

        stream: as for `observe`. of: which quantities; None: all that were declared. risk: the share of touches whose
        interval may miss the true value. known: whether the intervals are those for a learned material, or the wider
        ones for a new one; None: as the prediction says. It rests on the sampled touches that carry values, 256 at
        most, whatever the order they came in; where they are too few it gives no number, and says what is missing.

        Raises StreamError; AnnotationError where nothing, or one of these, was not declared; InputError for a risk.
        """
        require_arguments({"risk": risk}, {"known": known})
        return self._predictor.estimate(stream, names_of("of", of, AnnotationError), risk, known)

    def compose(
        self, stream: Readings, *, constituents: Sequence[str] | None = None, unfamiliar: float = 0.5
    ) -> Composition:
        """Estimate what the touched material is made of, from the descriptions; the memory stays as it is.

        stream: as for `observe`. constituents: which of them; None: all that were described. unfamiliar: the
        probability, before the touch, that the material was never observed: 1 where that is certain, 0 where it cannot
        be.

        An observed material has the composition of those it feels like, a new one that of heads over all described ones
        (see `prediction.composition`); the touch's novelty weighs the two. `Constituent.unlearned` says what cannot be.

        Raises StreamError; DescriptionError where nothing was described, or for a constituent that no description
        names; InputError for an unfamiliar that is no probability.
        """
        require_arguments({"unfamiliar": unfamiliar})
        named = names_of("constituents", constituents, DescriptionError)
        return self._predictor.compose(stream, named, unfamiliar)

    def live(
        self,
        *,
        risk: float = 0.05,
        contact: Literal["auto", "manual"] = "auto",
        false_contacts: float = 1.0,
        scene: Sequence[str] | None = None,
        of: str | None = None,
        widths: Mapping[str, float] | None = None,
        changed: Callable[[Health], object] | None = None,
    ) -> LiveSession:
        """Begin to take readings as they come; see `LiveSession.push`.

        risk: the share of wrong answers among those that are decided. contact: "auto" finds touches by the sensor's own
        noise at rest, which it learns first: for two seconds nothing may touch it. "manual" leaves that to
        `LiveSession.begin` and `end`. false_contacts: an hour, that noise alone may make. scene, of: as for `predict`.
        widths: quantity → how narrow its interval is to be, in its unit, before `LiveState.settled` says so. By labels
        nothing is estimated. changed: called when `health` sees a change; for that rest and known touches are noted as
        by `sense`. Each touch is predicted by the memory as it was when it began, and by itself unless
        `LiveSession.again` says that it is of the same thing as the last.

        Raises InputError for values that cannot be, and for "auto" with frames that have no resting image; what
        `predict` raises for scene and of.
        """
        from scroll_tactile.live.session import HealthNotes, LiveSession

        session: dict[str, Any] = {"risk": risk, "contact": contact, "false_contacts": false_contacts, "scene": scene}
        notes = None if changed is None else HealthNotes(self, changed, logger.warning, materials=of is None)
        return LiveSession(self._by(of), **session, widths=widths, notes=notes)

    def exported(self, scene: Sequence[str] | None = None) -> ExportedJudge:
        """The reduced judge of a scene, in whole numbers: what a microcontroller answers, to the bit.

        scene: as for `predict`, at most 64 materials. Write it as C by `firmware.write_firmware`. It rests on windows
        alone: no kept touches, no views of a whole touch, no f*; it is of the memory as it is now.
        Raises UnknownMaterialError, InputError for an empty scene, a greater one, a camera, or an embedding that is not
        `Kernels`.
        """
        from scroll_tactile.clients.firmware.quantising import exported_judge

        names = names_of("scene", scene)
        return self._ledger.read(lambda memory, _: exported_judge(self._recipe, memory, names))

    def settle(self) -> None:
        """Fit all that answers rest on to the memory as it is now: they are then a function of what was observed.

        Between two such moments the readouts are those of all that was observed, to rounding; the calibration may rest
        on a sixth fewer touches, or two. The memory itself is always exact, and knows nothing of this.

        Raises CapacityError where the system has no memory left for it; `predict` does, too.
        """
        self._predictor.settle()

    def model(self) -> Model:
        """The readouts and calibrations of the memory as it is now, as after `settle`; later touches are not in it."""
        return self._predictor.fitted()

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
        from scroll_tactile.finetune.fine_tune import fine_tune_memory

        require_arguments({}, {"progress": progress})
        how: dict[str, Any] = {"epochs": epochs, "seed": seed, "device": device}
        return fine_tune_memory(self._predictor, **how, progress=progress or silent)

    def sense(self, stream: Stream | npt.ArrayLike, material: str | None = None) -> None:
        """Note how a touch of a known material reads, or the sensor at rest, for `health`; nothing is learned of it.

        stream: as for `observe`, of a sensor with channels, three readings or more. material: such as that of a
        prediction that is known; None: the sensor at rest, which alone shows a gain or an offset of all its channels.
        Durable when this returns; some hundred bytes. Such a row stays behind where a memory is merged or packed.

        Raises StreamError, MaterialError; InputError for a camera, and for more than 256 channels; StoreError.
        """
        name = "" if material is None else require_name(material)
        self._ledger.sense(name, corrected_stream(validate(stream, self.sensor), self._ledger.correction))

    def health(
        self, *, bound: float = 0.01, after: int = 0, until: int | None = None, source: str | None = None
    ) -> Health:
        """Whether the sensor is still the one that learned, since which touch not, and in which channels.

        bound: of the probability of a false alarm, over all time, where touches of each material are exchangeable.
        after: the last row of the journal that does not count, such as that at which the sensor was changed. until: the
        last that counts; None: all. source: only observations from there, such as one robot's; as for `forget`.

        It is read from the observations in the order of the journal, and from what `sense` noted, as numbers of each
        channel; touches are compared with earlier ones of the same material, of a similar length and level, so that no
        mixture of materials, lengths and forces is a change. See `health.watch`. The digest knows nothing of it.

        Raises InputError for values that cannot be, for a camera, and for more than 256 channels; StoreError.
        """
        require_arguments({"bound": bound, "after": after}, {"until": until})
        checked = None if source is None else require_source(source)
        if not has_numbers(self.sensor):
            raise InputError(
                f"the health of a sensor is told from its channels, 1 to {MOST_CHANNELS}; sensor {self.sensor.name!r} "
                + ("has pixels" if self.sensor.camera else f"has {self.sensor.channels}")
            )
        return health_of(self._ledger, self.sensor.channels, WatchRules(float(bound), after, until, checked))

    def adapt(
        self,
        touches: Mapping[str, Stream | npt.ArrayLike] | Iterable[tuple[str, Stream | npt.ArrayLike]],
        *,
        until: int | None = None,
    ) -> Adaptation:
        """Take over a changed skin, from a few touches of known materials felt with it; nothing is learned of them.

        touches: pairs of a material and readings as for `observe`, three or more, five are better, of two materials or
        more; or a mapping from materials to readings. until: the last row of the journal that the skin before it felt,
        such as the one before `Health.since`; None: all.

        A gain and an offset of each channel are estimated from them, drawn to none (see `health.skin_fit`), and a
        channel that reads nothing any more is left out: whatever it reads, its values are missing, and the embedding
        sees what the other channels say of it, as far as kept touches tell how they go together. Where that explains
        touches better which it was not estimated from, and most of them are then known, or more than before, later ones
        are read through it: `observe`, `predict`, `estimate`, `compose`, `sense` and touches that begin in live
        sessions. What was learned stays as it is, to the byte; `retract` takes the adaptation back.

        A second one replaces the first: it is made from the readings as they came. It is of this unit: `merge` and
        `pack` leave it behind, a compaction, a backup and `reembed` keep it. An `exported` judge knows nothing of it.

        Raises StreamError, MaterialError; UnknownMaterialError for a material never observed; InputError for too few
        touches or materials, for a camera, or in a memory that does not know how touches of the materials read by
        channel; StoreError.
        """
        require_arguments({}, {"until": until})
        return adapt_to(self._ledger, known_touches(touches, self.sensor), self.sensor, until, self._unknown)

    def _unknown(self, touches: Iterable[Stream]) -> int:
        return sum(self.predict(touch).known is False for touch in touches)

    def merge(
        self,
        other: TactileLearner | str | os.PathLike[str],
        *,
        descriptions: Choice = "same",
        progress: Callable[[str, int, int], object] | None = None,
    ) -> Merged:
        """Add everything that another memory observed; durable, as a whole, when this returns.

        It is the union of both: a stream that both observed, of one material with one content, counts once.

        other: a memory, the path of one, or a file that `pack` wrote; it stays as it is. Receipts of the other memory
        are not receipts of this one.
        descriptions: which to keep of a material that both describe: "ours", "theirs", or "same", if they must agree.

        Raises MismatchError for a memory of another sensor, embedding or grid, or of a quantity with another unit or
        range, for a shared stream with other values or labels, and for a different description where they must agree;
        ObservationError where a shared stream was compacted and cannot be left out; CapacityError, InputError,
        StoreError. Nothing was changed then.
        """
        source = other._ledger.merged_from() if isinstance(other, TactileLearner) else other
        require_arguments({"descriptions": descriptions}, {"progress": progress})
        if not isinstance(other, TactileLearner):
            require_arguments({"other": other})
        return self._ledger.merge(source, progress or silent, choice=descriptions)[0]

    def backup(
        self, destination: str | os.PathLike[str], *, progress: Callable[[str, int, int], object] | None = None
    ) -> None:
        """Copy the memory to a new folder, also while it is in use: whole, as it was at one moment, or not at all.

        Raises InputError in a memory without a path; StoreError where something is there already, or it cannot be
        written or verified.
        """
        require_arguments({"destination": destination}, {"progress": progress})
        self._ledger.require_folder("be copied").backup(destination, progress=progress)

    def pack(
        self, path: str | os.PathLike[str], *, rows: bool = True, readings: bool = True, source: str | None = None
    ) -> None:
        """Write the memory as one file that travels, and that `merge` takes; whole and durable, or not there at all.

        It holds what was learned: sums, sampled touches, kept touches and descriptions, and of each observation its
        name, content hash, time and source. f* and retracted observations stay behind.

        rows: also each observation's
        readings, or codes where the memory has no readings. A memory that merges the file can then retract the
        observation, and count it once if it has it already. A memory of which any rows were compacted is packed without
        rows. Without rows the file has the readings of the exemplars alone. readings: False leaves out all that shows a
        touch as it was read: rows, exemplars and kept touches. Such a file merges into memories made with exemplars=0
        and kept_touches=0. source: for observations that have none.

        Raises InputError for an invalid source; StoreError.
        """
        require_arguments({"path": path})
        checked_source = None if source is None else require_source(source)
        ledger = self._ledger
        with ledger.lock:
            store = ledger.require_open()
            pack_memory(store, ledger.memory, Path(path), rows=rows, readings=readings, source=checked_source)

    def compact(self, *, keep: int = 0) -> Compacted:
        """Give up the features and readings of old observations, for space; what was learned from them stays.

        keep: how many of the newest observations can still be retracted afterwards, by `retract` and `forget`; the
        older ones cannot any more. What was retracted before is gone from the disk, too.

        Raises InputError for a keep below 0, and in a batch; StoreError.
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
        before, self._predictor = embed_again(self._predictor, embedding, progress or silent)
        return before

    def refresh(self) -> bool:
        """Take in the rows committed since, in a memory opened to read; returns whether there were any.

        Raises StoreError; the memory then stays as it was.
        """
        return self._ledger.refresh()

    def close(self) -> None:
        """Write a checkpoint, so that opening replays nothing, and release the files; a second call does nothing.

        A model that a prediction or `settle` has fitted is kept, too: the first prediction after opening fits nothing.
        Nothing is lost without it: what `observe` acknowledged is in the journal. `predict` still answers afterwards,
        `observe` raises StoreClosedError.
        """
        self._predictor.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

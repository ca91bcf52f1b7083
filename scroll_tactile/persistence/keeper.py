"""The learner's methods that embed no touch: changes and copies of its memory, and lists from its journal."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy.typing as npt

from scroll_tactile.arguments import require_arguments, silent
from scroll_tactile.errors import InputError
from scroll_tactile.health.channel_numbers import MOST_CHANNELS, has_numbers
from scroll_tactile.health.watched_rows import WatchRules
from scroll_tactile.memory.descriptions import Description, checked
from scroll_tactile.memory.exemplars import Exemplar
from scroll_tactile.memory.state import Memory
from scroll_tactile.persistence.buffer import ranked_exemplars
from scroll_tactile.persistence.ledger import Ledger
from scroll_tactile.persistence.merge import Choice, MergeRules
from scroll_tactile.persistence.observations import observations
from scroll_tactile.persistence.packing import pack_memory
from scroll_tactile.persistence.sensor_rows import adapt_to, health_of, known_touches
from scroll_tactile.quantities import Quantity
from scroll_tactile.results import Adaptation, Compacted, Health, Merged, Observation, Receipt
from scroll_tactile.sensors import Sensor
from scroll_tactile.settings import require_name, require_source, require_text
from scroll_tactile.signals.correction import corrected_stream
from scroll_tactile.signals.stream import Stream, validate

__all__ = ["MemoryKeeper"]


class MemoryKeeper(ABC):
    """The part of a learner that keeps its memory; it embeds nothing, and answers nothing."""

    @property
    @abstractmethod
    def _ledger(self) -> Ledger:
        """The memory with its journal."""

    @property
    @abstractmethod
    def sensor(self) -> Sensor:
        """The sensor whose streams it reads."""

    @property
    def path(self) -> Path | None:
        """The folder of the memory; None where it is in memory only."""
        return None if self._ledger.store is None else self._ledger.store.path

    @property
    def has_health(self) -> bool:
        """Whether `health` can be asked: the memory has a path, and its sensor 1 to 256 channels."""
        return self.path is not None and has_numbers(self.sensor)

    @property
    def memory(self) -> Memory:
        """What it has learned: statistics, sample, exemplars, descriptions and f*. Read it; never change it."""
        return self._ledger.read(lambda memory, _: memory)

    @property
    def materials(self) -> dict[str, int]:
        """Material → number of observations, in alphabetical order."""
        return self._ledger.read(lambda memory, _: memory.statistics.materials)

    def digest(self) -> str:
        """Hex, equal for two memories if and only if they hold the same bytes of statistics."""
        return self._ledger.read(lambda memory, _: memory.digest())

    @property
    def descriptions(self) -> dict[str, Description]:
        """Material → its description, in alphabetical order, whether it was observed or not."""
        described = self._ledger.read(lambda memory, _: sorted(memory.descriptions.items()))
        return {name: dict(description) for name, description in described}

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

    def declare(self, quantity: Quantity) -> None:
        """Have touches carry values of this quantity from now on; durable when this returns. For ever: see `Quantity`.

        The same one again changes nothing. Statistics and `digest` stay as they are.

        Raises AnnotationError for another unit, range or resolution under a name that was declared, and for one of more
        than 64 (nothing was changed); StoreError.
        """
        self._ledger.declare(quantity)

    def sense(self, stream: Stream | npt.ArrayLike, material: str | None = None) -> None:
        """Note how a touch of a known material reads, or the sensor at rest, for `health`; nothing is learned of it.

        stream: as for `observe`, of a sensor with channels, three readings or more. material: such as that of a
        prediction that is known; None: the sensor at rest, which alone shows a gain or an offset of all its channels.
        Durable when this returns; some hundred bytes. Such a row stays behind where a memory is merged or packed.

        Raises StreamError, MaterialError; InputError in a memory without a path, for a camera, and for more than 256
        channels; StoreError.
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
        mixture of materials, lengths and forces is a change. See `health.betting`. The digest knows nothing of it.

        Raises InputError for values that cannot be, for a camera, for more than 256 channels, and in a memory without a
        path; StoreError.
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
        touches or materials, for a camera, in a memory without a path, or one that does not know how touches of the
        materials read by channel; StoreError.
        """
        require_arguments({}, {"until": until})
        self._ledger.require_store("be adapted")
        return adapt_to(self._ledger, known_touches(touches, self.sensor), self.sensor, until, self._unknown)

    @abstractmethod
    def _unknown(self, touches: Iterable[Stream]) -> int:
        """How many touches are called unknown."""

    @contextmanager
    def batch(self) -> Iterator[None]:
        """Make what is observed, retracted or forgotten in the block durable together, when it ends.

        For many touches: it waits for the disk once. If the process dies in the block, none of it is kept; after an
        exception, all that came before the exception is. Other threads wait for its end; fine-tuning, merging,
        compacting and closing are refused in it. In a memory without a path it does nothing.

        Raises StoreError where the batch could not be made durable: the memory is then as it was before it.
        """
        with self._ledger.batch():
            yield

    def retract(self, receipt: Receipt | Adaptation | int) -> None:
        """Take one observation out again, by its receipt or its sequence; durable when this returns.

        Or one adaptation to a changed skin: touches are read from then on as before it, through the last that is left.
        What was learned meanwhile stays as it was read.

        Statistics, exemplars and readouts are then, to the bit, those of a memory that never had it; an f* that was
        made from it is gone. Its features stay in the journal, unused, until `compact`.

        Raises ObservationError (nothing was changed) for one that is not there, was retracted before or was
        compacted, or for a receipt of another memory; InputError in a memory without a path; StoreError.
        """
        self._ledger.retract(receipt)

    def relabel(self, receipt: Receipt | int, material: str) -> int:
        """Give an observation another name: retract it and observe its readings under the new one, durable as one.

        Returns its new sequence; it keeps its time and source. A description stays with the name that it was given to.

        Raises what `retract` raises (nothing was changed), also MaterialError for an invalid name; InputError where
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
        other: MemoryKeeper | str | os.PathLike[str],
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

        Raises MismatchError for a memory of another sensor, embedding or grid, or of a quantity with another unit or
        range, for a shared stream with other values or labels, and for a different description where they must agree;
        ObservationError where a shared stream was compacted and cannot be left out; CapacityError, InputError,
        StoreError. Nothing was changed then.
        """
        path = other._ledger.require_store("be merged").path if isinstance(other, MemoryKeeper) else other
        require_arguments({"other": path, "shared": shared, "descriptions": descriptions}, {"progress": progress})
        rules = MergeRules(once=shared == "once", descriptions=descriptions)
        return self._ledger.merge(path, rules, progress or silent)[0]

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

        rows: also each observation's
        readings, or codes where the memory has no readings. A memory that merges the file can then retract the
        observation, and count it once if it has it already. A memory of which any rows were compacted is packed without
        rows. Without rows the file has the readings of the exemplars alone. readings: False leaves out all that shows a
        touch as it was read: rows, exemplars and kept touches. Such a file merges into memories made with exemplars=0
        and kept_touches=0. source: for observations that have none.

        Raises InputError in a memory without a path, and for an invalid source; StoreError.
        """
        require_arguments({"path": path})
        checked_source = None if source is None else require_source(source)
        ledger = self._ledger
        with ledger.lock:
            store = ledger.require_store("be packed")
            pack_memory(store, ledger.memory, Path(path), rows=rows, readings=readings, source=checked_source)

    def compact(self, *, keep: int = 0) -> Compacted:
        """Give up the features and readings of old observations, for space; what was learned from them stays.

        keep: how many of the newest observations can still be retracted afterwards, by `retract` and `forget`; the
        older ones cannot any more. What was retracted before is gone from the disk, too.

        Raises InputError for a keep below 0, in a batch, and in a memory without a path; StoreError.
        """
        return self._ledger.compact(keep)

    def refresh(self) -> bool:
        """Take in the rows committed since, in a memory opened to read; returns whether there were any.

        Raises StoreError; the memory then stays as it was.
        """
        return self._ledger.refresh()

    def observations(self) -> list[Observation]:
        """Every observation in the journal, in order, and its state; none in a memory without a path.

        Raises StoreError.
        """
        return self._ledger.read(lambda _, store: [] if store is None else observations(store))

    @property
    def exemplars(self) -> dict[str, list[bytes]]:
        """Material → content hashes of its exemplars, in rank order; materials in alphabetical order."""
        return {name: [exemplar.key for exemplar in ranked] for name, ranked in self.ranked_exemplars().items()}

    def ranked_exemplars(self) -> dict[str, list[Exemplar]]:
        """Material → its exemplars with their readings (T, n) in the sensor's unit, in rank order.

        Raises StoreError; CompactedError in a memory opened to read that was compacted since: `refresh` it first.
        """
        return self._ledger.read(ranked_exemplars)

    def tuned_digest(self) -> str | None:
        """Hex of a SHA-256 of f*'s weights, whether it answers or not; None before a fine-tune."""
        tuned = self.memory.tuned
        return None if tuned is None else tuned.digest()

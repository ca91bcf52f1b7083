"""What a memory was made with, and what it may be opened with."""

from __future__ import annotations

from typing import Any, cast

from scroll_tactile.embeddings.protocol import Embedding, require_rest, window_plan
from scroll_tactile.errors import EmbeddingMismatchError, InputError, MismatchError, SensorMismatchError
from scroll_tactile.memory.state import Capacity
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.copies import Augmented
from scroll_tactile.statistics.grid import BITS
from scroll_tactile.statistics.statistics import FOLDS
from store import Store

__all__ = ["capacity_of", "identity_of", "kept_augmentation", "kept_capacity", "require_same"]


def capacity_of(streams: int | None, nbytes: int | None, *, camera: bool = False) -> Capacity:
    """The size of the buffer that was asked for; a camera has none unless asked. Raises InputError for one below 0."""
    for what, size in (("exemplars", streams), ("exemplar_bytes", nbytes)):
        if size is not None and (isinstance(size, bool) or not isinstance(size, int) or size < 0):
            raise InputError(f"expected {what} as a whole number of 0 or more; came {size!r}")
    if streams is None and nbytes is None:
        return Capacity(0) if camera else Capacity()
    return Capacity(0 if nbytes == 0 else streams, nbytes or None)


def kept_capacity(store: Store, asked: Capacity, *, given: bool) -> Capacity:
    """The size of the buffer that a memory was made with. Raises MismatchError where another one was asked for."""
    told = store.identity.get("exemplars")
    if told is None:  # made before there were any: those felt since it was first opened with some are kept
        generation = store.latest()
        told = None if generation is None else generation.attributes.get("capacity")
    if told is None:
        return asked
    kept = Capacity(*cast(list[int | None], told))
    if given and kept != asked:
        raise MismatchError(
            f"{store.path} was made with exemplars={kept.streams}, exemplar_bytes={kept.nbytes}; it was opened with "
            f"{asked.streams} and {asked.nbytes}. What was not kept cannot be had back: leave them out"
        )
    return kept


def kept_augmentation(store: Store, asked: Augmented | None) -> Augmented | None:
    """The augmentation that a memory was made with, none where it was made before there was any.

    Raises MismatchError where another one was asked for.
    """
    told = store.identity.get("augmentation")
    kept = None if told is None else Augmented(**cast(dict[str, Any], told))
    if asked is not None and asked != kept:
        raise MismatchError(
            f"{store.path} was made with {kept or 'no augmentation'}; it was opened with {asked}. Its touches were not "
            "observed with those copies: leave the augmentation out, or take another path"
        )
    return kept


def identity_of(
    sensor: Sensor, embedding: Embedding, capacity: Capacity, augmentation: Augmented | None = None
) -> dict[str, Any]:
    """What is written into a new memory for good, in JSON's types.

    Raises InputError for an embedding that cannot read the sensor: before anything is written.
    """
    require_rest(embedding, sensor)
    reading = window_plan(sensor, embedding)
    # Memories of cameras that lack it had windows across two frames: another grid, and refused.
    frames = {"frames": True} if reading.frames else {}
    # Left out where there is none: such a memory can be opened by the versions before it.
    copies = {} if augmentation is None else {"augmentation": augmentation.to_json()}
    return copies | {
        "exemplars": [capacity.streams, capacity.nbytes],
        "reading": [reading.partial, reading.judged],
        "sensor": sensor.model_dump(mode="json"),
        "embedding": {
            "name": embedding.name,
            "dimension": embedding.dimension,
            "bound": embedding.bound,
            "fingerprint": embedding.fingerprint,
        },
        "grid": {"bits": BITS, "folds": FOLDS, "scales": list(reading.widths)} | frames,
    }


def require_same(store: Store, kept: Sensor, sensor: Sensor | None, embedding: Embedding) -> None:
    """Compare what a memory was made with to what it is opened with."""
    if sensor is not None and sensor != kept:
        differing = [
            f"{name} {getattr(kept, name)!r} there, {getattr(sensor, name)!r} here"
            for name in Sensor.model_fields
            if getattr(kept, name) != getattr(sensor, name)
        ]
        raise SensorMismatchError(
            f"{store.path} holds the memory of sensor {kept.name!r}; it was opened for {sensor.name!r} "
            f"({'; '.join(differing)}). Open it with its own sensor, or take another path"
        )
    mine = identity_of(kept, embedding, Capacity())
    if (theirs := cast(dict[str, Any], store.identity["embedding"])) != mine["embedding"]:
        ours = mine["embedding"]
        raise EmbeddingMismatchError(
            f"{store.path} was made with embedding {theirs['name']!r} ({theirs['dimension']} features, fingerprint "
            f"{theirs['fingerprint'][:12]}); it was opened with {ours['name']!r} ({ours['dimension']} features, "
            f"fingerprint {ours['fingerprint'][:12]}). Features of one mean nothing to the other: open it with the "
            "embedding that made it, or take another path"
        )
    if store.identity.get("reading", mine["reading"]) != mine["reading"]:
        raise EmbeddingMismatchError(
            f"{store.path} was made with an embedding whose partial_windows and judged_scales are "
            f"{store.identity['reading']}; it was opened with one whose are {mine['reading']}. Open it with those"
        )
    if store.identity["grid"] != mine["grid"]:
        raise MismatchError(
            f"{store.path} was made with {store.identity['grid']}; this version works with {mine['grid']}"
        )

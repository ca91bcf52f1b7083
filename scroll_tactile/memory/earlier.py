"""What versions up to 0.3 could make a memory with and this one cannot, and what to do about such a memory.

These are the embedding `Robust`, and copies of touches through noise, with dead channels, drifting or thinned. Of such
a memory all is shown that needs nothing embedded; the readings that it holds carry it over.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from scroll_tactile.errors import EmbeddingMismatchError, MismatchError
from scroll_tactile.signals.windows import EARLIER, WindowPlan
from scroll_tactile.statistics.sample import SampledTouch, TouchSample

__all__ = ["gone_copies", "gone_embedding", "is_gone", "sample_of_windows", "split_copies"]

BEGINNING: Final = 1  # the number of the one scale that is gone and judged beside windows
ROBUST: Final = "robust"  # the kind in its configuration
NAME: Final = "robust kernels"  # of the one that memories without a configuration had
NEUTRAL: Final = {"dead": 0, "offset": 0, "gain": 0, "noisy": 0, "thinned": False}
"""Settings of copies that are gone, and the values with which they did nothing. A last one was the amplitude of noise
in the `noisy` copies."""


def is_gone(name: str, configuration: Mapping[str, Any] | None) -> bool:
    """Whether a memory's embedding is, or joins, one that is gone: by its configuration, or its name without one."""
    if configuration is None:
        return name == NAME
    waiting: list[Any] = [configuration]
    while waiting:  # of any depth: it is read from a disk
        part = waiting.pop()
        if isinstance(part, Mapping):
            if part.get("kind") == ROBUST:
                return True
            parts = part.get("parts")
            waiting += parts if isinstance(parts, list) else []
    return False


def split_copies(settings: Mapping[str, Any]) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    """The settings of an `Augmented` on disk: those of this version, and those that are gone and did something.

    Where there are any of these, there are none of the others: the copies were drawn together.
    """
    gone = {name: settings[name] for name, nothing in NEUTRAL.items() if settings.get(name, nothing) != nothing}
    if gone:
        return None, gone | ({"noise": settings["noise"]} if "noisy" in gone and "noise" in settings else {})
    return {name: value for name, value in settings.items() if name not in (*NEUTRAL, "noise")}, {}


def sample_of_windows(sample: TouchSample, scales: Collection[int], plan: WindowPlan) -> TouchSample:
    """The sample of a generation that had these numbers of scales, without the rows of those that are gone.

    Beginnings came first wherever the narrow windows judged; noisy copies had a stage behind all others. So a memory of
    a user's own embedding, which once declared these, is judged by its windows alone.
    """
    if EARLIER.isdisjoint(scales):
        return sample
    lengths = plan.milestones()
    before = np.array([BEGINNING in scales and plan.judging(length)[0] == plan.windows[0] for length in lengths])
    kept = TouchSample()
    for material, key, touch in sample:
        own = touch.pairs[:, 0] < len(lengths)
        rows, pairs = touch.rows[own], touch.pairs[own]
        pairs[:, 1] -= before[pairs[:, 0]]
        kept.add(material, key, SampledTouch(rows[pairs[:, 1] >= 0], pairs[pairs[:, 1] >= 0], touch.copies))
    return kept


def gone_embedding(path: Path, made: object) -> EmbeddingMismatchError:
    """The error for a memory whose embedding is gone; made: what describes it."""
    return EmbeddingMismatchError(
        f"{path} was made with embedding {made}, which scroll-tactile has no longer. {_what_to_do(path)}"
    )


def gone_copies(path: Path, settings: Mapping[str, Any]) -> MismatchError:
    """The error for a memory whose touches were observed with copies that are gone."""
    shown = ", ".join(f"{name}={value!r}" for name, value in settings.items())
    return MismatchError(
        f"{path} was made with copies of each touch that scroll-tactile makes no longer ({shown}). {_what_to_do(path)}"
    )


def _what_to_do(path: Path) -> str:
    return (
        "Carry it over from the readings it holds, without such copies, and to the default embedding where its own is "
        f"gone: scroll-tactile memory reembed {path}. Where it was compacted, and gave readings up, open it with the "
        "version that made it"
    )

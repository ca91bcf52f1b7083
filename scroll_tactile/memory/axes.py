"""An axis of labels as a memory of its own: what was learned of the touches with a label on it, by their labels."""

from __future__ import annotations

from dataclasses import replace

from scroll_tactile.memory.state import Memory
from scroll_tactile.statistics.annotations import NO_ANNOTATION

__all__ = ["axis_memory"]


def axis_memory(memory: Memory, axis: str) -> Memory:
    """The memory of an axis: its statistics are those of the axis and follow it; samples are as they are now.

    Empty where no touch has a label on the axis. It has no exemplars, descriptions or f*.
    """
    view = memory.empty_like()
    view.exemplars, view.sequence, view.retractions = None, memory.sequence, memory.retractions
    view.statistics = memory.targets.axes.get(axis, view.statistics)
    for _, key, touch in memory.sample:
        if (label := touch.annotation.label(axis)) is not None:
            view.sample.add(label, key, replace(touch, annotation=NO_ANNOTATION))
    if memory.kept is not None and view.kept is not None:
        for _, key, kept in memory.kept:
            if (label := kept.annotation.label(axis)) is not None:
                view.kept.add(label, key, replace(kept, material=label, annotation=NO_ANNOTATION))
    return view

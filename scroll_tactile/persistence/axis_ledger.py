"""The ledger of an axis of labels: a memory without a path that follows another one."""

from __future__ import annotations

import hashlib

from scroll_tactile_store import Checkpoint

from scroll_tactile.memory.axes import axis_memory
from scroll_tactile.memory.state import Memory
from scroll_tactile.memory.touch_rows import Added
from scroll_tactile.persistence.ledger import Ledger
from scroll_tactile.signals.correction import Correction

__all__ = ["AxisLedger", "axis_name"]


class AxisLedger(Ledger):
    """What a memory learned by the labels on one axis, in place of materials; nobody changes it but the memory itself.

    ledger: of the memory, whose lock is held by whoever reads it. axis: its name.
    """

    def __init__(self, ledger: Ledger, axis: str) -> None:
        self._of, self._axis = ledger, axis
        super().__init__(lambda: axis_memory(ledger.memory, axis))
        self.lock = ledger.lock
        self._seen = ledger.version
        ledger.followers.append(self._follow)

    @property
    def memory(self) -> Memory:
        """The memory of the axis as it is now."""
        of = self._of.memory  # reads it again if a change was cut short
        if self._seen != self._of.version:
            self._memory, self._seen = axis_memory(of, self._axis), self._of.version
        return self._memory

    @property
    def correction(self) -> Correction | None:
        """As of the memory."""
        return self._of.correction

    def derived(self, name: str) -> Checkpoint | None:
        """As of the memory, under the name that `axis_name` gives."""
        return self._of.derived(axis_name(name, self._axis))

    def saved_since(self, memory: Memory) -> bool:
        """As of the memory, whose checkpoints have the axis."""
        del memory
        return self._of.saved_since(self._of.memory)

    def _follow(self, added: list[Added] | None) -> None:
        """Note what the memory changed by: of touches without a label that something did."""
        if added is None:
            self._changed()
            return
        labelled = ((dict(touch.labels).get(self._axis), touch) for touch in added)
        self._changed([Added(label, touch.codes, touch.sign) for label, touch in labelled if label is not None])


def axis_name(name: str, axis: str) -> str:
    """The name of what is derived from an axis, where that of materials has a name: axes may have any characters."""
    return f"{name}-{hashlib.sha256(axis.encode()).hexdigest()[:32]}"

"""What is replaced in a module or a class, for a while: a bug is put in so."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any


class Patches:
    """What was replaced, to be put back."""

    def __init__(self) -> None:
        self._before: list[tuple[Any, str, Any]] = []

    def __call__(self, where: Any, name: str, make: Callable[[Any], Any]) -> None:
        """Replace something by what `make` makes of it."""
        raw = vars(where)[name]
        before = (
            raw.__func__
            if isinstance(raw, classmethod | staticmethod)
            else raw.fget
            if isinstance(raw, property)
            else raw
        )
        made = make(before)
        kind = type(raw) if isinstance(raw, classmethod | staticmethod | property) else None
        self._before.append((where, name, raw))
        setattr(where, name, kind(made) if kind else made)

    def everywhere(self, where: Any, name: str, make: Callable[[Any], Any]) -> None:
        """Replace a function in each module that imported it, too."""
        before = vars(where)[name]
        made = make(before)
        for module in [one for key, one in sys.modules.items() if key.startswith(("store", "scroll_tactile"))]:
            if vars(module).get(name) is before:
                self(module, name, lambda _: made)

    def undo(self) -> None:
        """Put all back."""
        for where, name, before in reversed(self._before):
            setattr(where, name, before)
        self._before = []


def nothing(_: Any) -> Any:
    """What does nothing, in the place of a call."""
    return lambda *given, **named: None

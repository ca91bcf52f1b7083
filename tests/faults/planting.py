"""Bugs to be put in, by name, so that it shows that the simulation finds such ones.

A bug is a list of replacements in modules and classes, which last as long as `planted(name)` does.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any
from unittest import mock


@dataclass(frozen=True)
class Replacement:
    """What stands in the place of an attribute: what `make` makes of it.

    everywhere: also in each module that imported it. spoilt: the function that is called in its place, if any.
    """

    where: Any
    name: str
    make: Callable[[Any], Any]
    everywhere: bool = False
    spoilt: Callable[..., Any] | None = None

    def before(self) -> Any:
        """The attribute as it is; raises KeyError where there is none of its own."""
        return vars(self.where)[self.name]

    def patches(self) -> list[Any]:
        """Of each place the patch."""
        before, places = self.before(), [self.where]
        made = self.make(before)
        if self.everywhere:
            modules = [module for key, module in sys.modules.items() if key.startswith("scroll_tactile")]
            places += [each for each in modules if each is not self.where and vars(each).get(self.name) is before]
        return [mock.patch.object(place, self.name, made) for place in places]


BUGS: dict[str, list[Replacement]] = {}


def bug(title: str, where: Any, name: str, *, everywhere: bool = False) -> Callable[[Any], Any]:
    """Have a function stand in the place of another in bug `title`; it gets the other, then what the call is given."""

    def note(spoilt: Any) -> Any:
        def make(before: Any) -> Any:
            if isinstance(before, property):
                return property(functools.partial(spoilt, before.fget))
            kind = type(before) if isinstance(before, classmethod | staticmethod) else None
            own = before.__func__ if kind else before

            def called(*given: Any, **named: Any) -> Any:
                return spoilt(own, *given, **named)

            return kind(called) if kind else called

        BUGS.setdefault(title, []).append(Replacement(where, name, make, everywhere, spoilt))
        return spoilt

    return note


@contextmanager
def planted(title: str) -> Iterator[None]:
    """While it lasts the bug is there."""
    with ExitStack() as stack:
        for replacement in BUGS[title]:
            for patch in replacement.patches():
                stack.enter_context(patch)
        yield


def nothing(*_: Any, **named: Any) -> None:
    """What does nothing, in the place of a call."""

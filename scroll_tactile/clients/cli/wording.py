"""What errors say of arguments, in the options of the command that was typed: `field='x'` is `--field x` there."""

from __future__ import annotations

import ast
import re
import shlex
import warnings
from collections.abc import Iterable
from contextvars import ContextVar
from typing import Any

__all__ = ["counted", "has_option", "in_options", "typed"]

_ARGUMENTS = (
    *("topic", "field", "clock", "columns", "preset", "rate", "labels", "decimal", "definitions"),  # of `read`
    *("annotate", "again", "material", "by", "intervals", "cut", "sensor", "add", "source", "scene", "risk"),
)
_RENAMED = {"material": "label", "by": "label_by", "intervals": "labels", "labels": "label_topic"}
_TEXT = r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*\""""  # as repr writes one
_NAMED = re.compile(rf"(?<![^\s(])({'|'.join(_ARGUMENTS)})=({_TEXT}|True|(?![\w('\"\[]))")
_UNREADABLE = (SyntaxError, ValueError, RecursionError, MemoryError)  # what parsing and evaluating any text raises

_options: ContextVar[dict[str, str]] = ContextVar("_options")


def counted(number: int, what: str) -> str:
    """A number and what it counts, given in the singular: "1 touch", "2 touches"."""
    plural = "es" if what.endswith("ch") else "s"
    return f"{number} {what}{'' if number == 1 else plural}"


def typed(parameters: Iterable[Any]) -> None:
    """Take note of the parameters of the command that was typed."""
    _options.set({each.name: max(each.opts, key=len) for each in parameters if each.opts[0].startswith("-")})


def has_option(name: str) -> bool:
    """Whether the command that was typed has this option."""
    return name in _options.get({})


def in_options(text: str) -> str:
    """A message with arguments as options of the command that was typed; one that it has not is Python's alone."""
    options = _options.get({})
    if not options:
        return text
    absent: dict[str, None] = {}

    def option(name: str, value: object) -> str | None:
        flag = options.get(_RENAMED.get(name, name)) or options.get(name)
        if flag is None:
            return None
        return flag if value in (None, True) else f"{flag} {shlex.quote(str(value))}"

    def replaced(match: re.Match[str]) -> str:
        name, written = match.groups()
        try:
            found = option(name, ast.literal_eval(_parsed(written)) if written else None)
        except _UNREADABLE:  # of what only looks like an argument, such as in a path
            return match[0]
        if found is None:
            absent[name] = None
        return found or match[0]

    lines = []
    for line in text.split("\n"):
        call = _call(line)
        flags = [option(name, value) for name, value in call.items()]
        if call and all(flags):
            lines.append(" ".join(["such as", *filter(None, flags)]))
        else:
            lines.append(_NAMED.sub(replaced, line))
    note = f" ({', '.join(f'{name}=' for name in absent)}: from Python alone)" if absent else ""
    return "\n".join(lines) + note


def _call(line: str) -> dict[str, object]:
    """The arguments by name of a line read('…', topic='…', …); none of another line."""
    if not line.startswith("read("):
        return {}
    try:
        call = _parsed(line).body
        named = call.keywords if isinstance(call, ast.Call) else []
        return {str(each.arg): ast.literal_eval(each.value) for each in named}
    except _UNREADABLE:
        return {}


def _parsed(text: str) -> ast.Expression:
    """An expression of Python's. Raises _UNREADABLE for anything else, also for escapes that Python warns of."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return ast.parse(text, mode="eval")

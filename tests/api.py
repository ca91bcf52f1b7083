"""Writes scroll_tactile/API.md, all public names with what their docstrings promise: `python tests/api.py`."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import scroll_tactile_store

import scroll_tactile
import scroll_tactile.clients.ros2
from scroll_tactile import errors, recordings, sensors

PAGE = Path(scroll_tactile.__file__).parent / "API.md"
HEAD = """# The public names

Written from the docstrings by `python tests/api.py`, and compared with them by a test. What is not here may change with
any release. Arrays are given with their shape and unit; errors are those of `scroll_tactile.errors` and `store`.
"""
PARTS = {
    "scroll_tactile": (scroll_tactile, scroll_tactile.__all__),
    "scroll_tactile.recordings": (recordings, recordings.__all__),
    "scroll_tactile.clients.ros2": (scroll_tactile.clients.ros2, scroll_tactile.clients.ros2.__all__),
    "scroll_tactile.errors": (errors, [name for name, item in vars(errors).items() if inspect.isclass(item)]),
    "scroll_tactile.sensors": (sensors, [name for name in sensors.__all__ if name != "Sensor"]),
    "scroll_tactile_store": (scroll_tactile_store, scroll_tactile_store.__all__),
}


def page() -> str:
    """The page as it should be."""
    parts = [HEAD]
    for title, (module, names) in PARTS.items():
        parts.append(f"## {title}\n")
        listed = [name for name in names if not name.startswith("_") and not inspect.ismodule(getattr(module, name))]
        parts += [part for name in listed for part in _described(name, getattr(module, name))]
    return "\n".join(parts)


def _described(name: str, item: Any) -> Iterator[str]:
    if inspect.isclass(item):
        yield f"### {name}\n"
        if _is_made_by_users(item):
            yield f"    {name}{_signature(item)}\n"
        yield _text(item)
        if not issubclass(item, BaseException):
            bases = [base for base in reversed(item.__mro__) if base.__module__.startswith("scroll_tactile")]
            for own, member in sorted({own: member for base in bases for own, member in vars(base).items()}.items()):
                if not own.startswith("_"):
                    yield from _member(name, own, member)
    elif inspect.isroutine(item):
        yield f"### {name}\n"
        yield f"    {name}{_signature(item)}\n"
        yield _text(item)
    else:
        value = "" if isinstance(item, dict) else f": {_shown(item)}"
        yield f"- `{name}`{value}\n"


def _member(owner: str, name: str, member: Any) -> Iterator[str]:
    if isinstance(member, property):
        yield f"- `{owner}.{name}`: {_lines(member.fget)}\n"
        return
    function = member.__func__ if isinstance(member, (classmethod, staticmethod)) else member
    if inspect.isfunction(function) and inspect.getdoc(function):
        yield f"- `{owner}.{name}{_signature(function)}`: {_lines(function)}\n"


def _is_made_by_users(item: type) -> bool:
    """Whether its docstring says what it is made with; errors and results come from elsewhere."""
    return not issubclass(item, BaseException) and not getattr(item, "_is_protocol", False) and "Raises" in _text(item)


def _signature(function: Any) -> str:
    """Its parameters with their types, as they stand in the code."""
    signature, parts, kind = inspect.signature(function), [], None
    for one in signature.parameters.values():
        if one.name in ("self", "cls"):
            continue
        if one.kind is one.KEYWORD_ONLY and kind not in (one.KEYWORD_ONLY, one.VAR_POSITIONAL):
            parts.append("*")
        kind = one.kind
        stars = {one.VAR_POSITIONAL: "*", one.VAR_KEYWORD: "**"}.get(kind, "")
        default = "" if one.default is one.empty else f" = {'...' if callable(one.default) else repr(one.default)}"
        typed = "" if one.annotation is one.empty else f": {_annotation(one.annotation)}"
        parts.append(f"{stars}{one.name}{typed}{default}")
    of_class = inspect.isclass(function) or signature.return_annotation is signature.empty
    return f"({', '.join(parts)})" + ("" if of_class else f" -> {_annotation(signature.return_annotation)}")


def _annotation(annotation: Any) -> str:
    """A type as it is written, without the bounds that pydantic checks."""
    if isinstance(annotation, str):
        return annotation.strip("\"'")
    bare = re.sub(
        r"typing\.|scroll_tactile\.(\w+\.)*|<class '(?:\w+\.)*(\w+)'>", r"\2", inspect.formatannotation(annotation)
    )
    while (shorter := re.sub(r"Annotated\[([\w.]+), [^\[\]]*(\[[^\[\]]*\])*[^\[\]]*\]", r"\1", bare)) != bare:
        bare = shorter
    bare = re.sub(r"Optional\[([^\[\]]*)\]", r"\1 | None", bare)  # as newer versions of Python write it
    return re.sub(r"Union\[(\w+), ([\w., \[\]]*)\]$", r"\1 | \2", bare)


def _text(item: Any) -> str:
    """The docstring without its examples."""
    paragraphs = (inspect.getdoc(item) or "").split("\n\n")
    kept = [paragraph for paragraph in paragraphs if not paragraph.lstrip().startswith((">>>", "scroll-tactile "))]
    return "\n\n".join(kept) + "\n"


def _lines(function: Any) -> str:
    return textwrap.indent(_text(function), "  ").strip()


def _shown(item: Any) -> str:
    return re.sub(r"<.* object at 0x[0-9a-f]+>", type(item).__name__, f"`{item!r}`")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")

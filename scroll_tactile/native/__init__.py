"""The compiled kernels, where they were built; without them numpy counts the same numbers, in four times the time.

They are built when the package is installed, if there is a compiler. `available` says whether they are at work,
`reason` why not. The environment variable SCROLL_TACTILE_NUMPY=1 turns them off.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from typing import Any

__all__ = ["available", "count", "described", "reason"]


def _load() -> tuple[Callable[..., None] | None, str]:
    if os.environ.get("SCROLL_TACTILE_NUMPY", "") not in {"", "0"}:
        return None, "turned off by SCROLL_TACTILE_NUMPY"
    try:
        found: Any = importlib.import_module("scroll_tactile.native._kernels")
    except ImportError as error:  # not built, or for another machine
        return None, str(error)
    return found.count, ""


_found, reason = _load()
available = _found is not None


def count(*arguments: Any) -> None:
    """`tactile_count` of kernels.h. Raises ValueError for arrays that do not fit together."""
    assert _found is not None
    _found(*arguments)


def described() -> str:
    """Which kernels are at work, in words."""
    return "compiled" if available else f"by numpy: {reason}"

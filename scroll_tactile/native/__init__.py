"""The compiled kernels, where they were built; without them numpy counts the same numbers, in four times the time.

They are built when the package is installed, if there is a compiler. `available` says whether they are at work,
`reason` why not. The environment variable SCROLL_TACTILE_NUMPY=1 turns them off.
"""

from __future__ import annotations

import importlib
import os
from typing import Any

__all__ = ["available", "count", "described", "distances", "reason", "sum_logs"]


def _load() -> tuple[Any, str]:
    if os.environ.get("SCROLL_TACTILE_NUMPY", "") not in {"", "0"}:
        return None, "turned off by SCROLL_TACTILE_NUMPY"
    try:
        return importlib.import_module("scroll_tactile.native._kernels"), ""
    except ModuleNotFoundError:
        return None, "not built; a compiler was missing or failed when the package was installed"
    except ImportError as error:  # for another machine
        return None, str(error)


_module, reason = _load()
available = _module is not None


# Each raises ValueError for arrays that do not fit together; see kernels.h and matching.h.
count: Any = getattr(_module, "count", None)
sum_logs: Any = getattr(_module, "sum_logs", None)
distances: Any = getattr(_module, "distances", None)


def described() -> str:
    """Which kernels are at work, in words."""
    return "compiled" if available else f"by numpy: {reason}"

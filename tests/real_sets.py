"""Where the data as published lies, for the tests of readers."""

from pathlib import Path

CACHE = Path.home() / ".cache" / "scroll-tactile"

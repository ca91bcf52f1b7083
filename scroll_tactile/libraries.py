"""Optional libraries: each comes with an extra of pyproject.toml, and one that is missing is named with its line."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

from scroll_tactile.errors import MissingLibraryError

__all__ = ["install_line", "missing", "optional", "require"]

PROJECT = "scroll-tactile"


@contextmanager
def optional(library: str, extra: str, what: str, otherwise: str = "") -> Iterator[None]:
    """Import `library` in the block; raise `missing(…)` where that fails."""
    try:
        yield
    except ImportError as error:
        raise missing(library, extra, what, otherwise, error) from error


def require(library: str, extra: str, what: str) -> None:
    """Raise `missing(…)` where a library is not there, without importing it, which may take seconds."""
    if importlib.util.find_spec(library) is None:
        raise missing(library, extra, what)


def missing(
    library: str, extra: str, what: str, otherwise: str = "", cause: ImportError | None = None
) -> MissingLibraryError:
    """The error of a library that is not installed, with the line that installs it; or of a broken one, with the cause.

    library: its name on the index. extra: of pyproject.toml, that it comes with. what: needs it. otherwise: what can be
    done without it. cause: what importing it raised.
    """
    instead = f", or {otherwise}" if otherwise else ""
    if cause is None or _is_absent(library, cause):
        why = f"which is not installed: {install_line(library, extra)}"
    else:
        why = f"which cannot be imported ({cause!s:.300}): mend or reinstall it"
    error = MissingLibraryError(f"{what} needs {library}, {why}{instead}")
    error.name = library
    return error


def _is_absent(library: str, cause: ImportError) -> bool:
    """Whether an import failed because this library is not installed, and not one that it imports itself."""
    if not isinstance(cause, ModuleNotFoundError):
        return False
    names = library.rstrip("]").split("[")
    if (cause.name or "").partition(".")[0] in names:
        return True
    try:
        importlib.metadata.distribution(names[0])
    except importlib.metadata.PackageNotFoundError:
        return True
    return False


def install_line(library: str, extra: str) -> str:
    """The command that installs an extra for this interpreter, from where this package was installed.

    No index has this package: what pip noted when it installed it (PEP 610) says where it came from. Where nothing
    does, the line installs the library alone.
    """
    target = _target(extra) or [library]
    command = [sys.executable, "-m", "pip", "install", *target]
    return subprocess.list2cmdline(command) if os.name == "nt" else shlex.join(command)


def _target(extra: str) -> list[str] | None:
    """What pip is told to install; None where it is not known where this package came from, or it is there no more."""
    try:
        noted = importlib.metadata.distribution(PROJECT).read_text("direct_url.json")
        origin: dict[str, Any] = json.loads(noted or "{}")
        url = str(origin["url"])
    except (importlib.metadata.PackageNotFoundError, KeyError, TypeError, ValueError):
        clone = Path(__file__).parents[1]  # used without being installed
        return ["-e", f"{clone}[{extra}]"] if (clone / "pyproject.toml").exists() else None
    if "dir_info" in origin:
        folder = Path(url2pathname(urlsplit(url).path))
        editable = ["-e"] if origin["dir_info"].get("editable") else []
        return [*editable, f"{folder}[{extra}]"] if folder.is_dir() else None
    if "vcs_info" in origin:
        version: dict[str, str] = origin["vcs_info"]
        url = f"{version['vcs']}+{url}@{version['commit_id']}"
    inside = f"#subdirectory={origin['subdirectory']}" if "subdirectory" in origin else ""
    return [f"{PROJECT}[{extra}] @ {url}{inside}"]

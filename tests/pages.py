"""Pages that run: each block of a page, one after another, in one folder.

- `console`: lines behind `$ ` are commands, those below are what they print; `…` stands for anything. A command ends
  well, or `$ echo $?` follows.
- `pycon`: a session, compared as doctest does; the names of a page are shared.
- `title="FILE"` behind the language: a file, which is written.
- `text`: what nobody runs.

A block that needs what is not here stands behind `<!-- not executed: WHY -->`.
"""

from __future__ import annotations

import doctest
import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from commands import run

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(
    r"^(?P<indent> *)(?:<!-- not executed: (?P<why>[^>]+) -->\n+ *)?"
    r"```(?P<language>\w*)(?: title=\"(?P<file>[^\"]+)\")?\n(?P<text>.*?)^(?P=indent)```$",
    re.MULTILINE | re.DOTALL,
)
ENVIRONMENT = {"COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb", "OPENBLAS_NUM_THREADS": "1"}
PLAIN = re.compile(r"scroll-tactile [^|<>&;$`]*$")  # a command that asks nothing of a shell


@dataclass
class Page:
    """A page being run in the working directory.

    ran: how many blocks were. left: why each of the others was not.
    """

    path: Path
    names: dict[str, Any] = field(default_factory=dict)
    ran: int = 0
    left: list[str] = field(default_factory=list)
    code: int = 0

    def run(self) -> None:
        """Run all of it. Raises AssertionError where something is not as the page shows it."""
        for block in BLOCK.finditer(self.path.read_text(encoding="utf-8")):
            text = re.sub(rf"^{block['indent']}", "", block["text"], flags=re.MULTILINE)
            if block["why"]:
                self.left.append(block["why"])
            elif block["file"]:
                Path(block["file"]).parent.mkdir(parents=True, exist_ok=True)
                Path(block["file"]).write_text(text, encoding="utf-8")
            elif block["language"] == "console":
                self._console(text)
            elif block["language"] == "pycon":
                self._session(text)
            else:
                assert block["language"] == "text", f"{self.path.name}: nobody runs this block:\n{text}"
                continue
            self.ran += not block["why"]

    def _session(self, text: str) -> None:
        session = doctest.DocTestParser().get_doctest(text, self.names, self.path.name, str(self.path), 0)
        assert session.examples, f"{self.path.name}: no session:\n{text}"
        runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
        said: list[str] = []
        runner.run(session, out=said.append, clear_globs=False)
        self.names = session.globs
        assert not runner.summarize(verbose=False).failed, "".join(said)

    def _console(self, text: str) -> None:
        commands = re.split(r"^\$ ", text.replace("\\\n", " "), flags=re.MULTILINE)
        assert not commands[0].strip(), f"{self.path.name}: expected a command behind '$ ':\n{text}"
        for i, entry in enumerate(commands[1:], 1):
            line, _, expected = entry.partition("\n")
            printed = f"{self.code}\n" if line == "echo $?" else self._command(line)
            may_fail = i + 1 < len(commands) and commands[i + 1].startswith("echo $?")
            assert may_fail or line == "echo $?" or not self.code, f"{line}\n{printed}"
            assert not expected.strip() or _is_as_shown(printed, expected), (
                f"$ {line}\n{printed}\nexpected:\n{expected}"
            )

    def _command(self, line: str) -> str:
        if PLAIN.match(line):
            done = run(*shlex.split(line)[1:])
            self.code = done.exit_code
            return str(done.output)
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
        environment = {**os.environ, "PATH": path, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "store")])}
        ended = subprocess.run(["sh", "-c", line], env=environment, capture_output=True, text=True, check=False)
        self.code = ended.returncode
        return ended.stdout + ended.stderr


def _is_as_shown(printed: str, expected: str) -> bool:
    """Whether all lines are as expected, spaces at their ends aside; … is the rest of a line, or any lines."""
    pattern = "".join(
        r"(?:.*\n)*?" if line.strip() == "…" else ".*?".join(map(re.escape, line.rstrip().split("…"))) + r"\n"
        for line in expected.strip("\n").splitlines()
    )
    lines = [line.rstrip() for line in printed.strip("\n").splitlines()]
    return re.fullmatch(pattern, "".join(f"{line}\n" for line in lines)) is not None

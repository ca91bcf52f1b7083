"""README's session and command lines, as they stand, in a folder laid out as they expect it. It needs no pytest."""

import doctest
import os
import re
import shlex
from pathlib import Path

import numpy as np

from scroll_tactile import Kernels, TactileLearner, sensors
from scroll_tactile.recordings import PRESETS
from scroll_tactile.simulation.scene import Scene

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
SCENE = Scene(sensors.BIOTAC)
MATERIALS = ("felt", "oak", "silk")
TOUCHES = 4  # of each, in recordings


def run_session() -> int:
    """Run the session in the working directory; how many of its examples failed."""
    session = doctest.DocTestParser().get_doctest(TEXT, {}, "README.md", "README.md", 0)
    assert len(session.examples) > 10
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    runner.run(session)
    return runner.summarize(verbose=False).failed


def set_up_lines() -> list[str]:
    """The lines that set up and run something at once: the demo, and the tests."""
    return [line.strip() for line in TEXT.splitlines() if line.startswith("    python3 .ci/check_python.py ")]


def command_lines() -> list[list[str]]:
    """The words of each line that begins with the command."""
    return [shlex.split(line) for line in re.findall(r"^    (scroll-tactile .*)$", TEXT, re.MULTILINE)]


def lay_out(folder: Path) -> None:
    """What the command lines name: recordings in folders by material, one touch, and another memory."""
    for name in MATERIALS:
        (folder / "recordings" / name).mkdir(parents=True)
        for i in range(TOUCHES):
            np.save(folder / "recordings" / name / f"{i}.npy", SCENE.touch(name, i).readings)
    np.save(folder / "touch.npy", SCENE.touch("oak", TOUCHES).readings)
    with TactileLearner.open(folder / "other", sensor=PRESETS["biotac"].sensor, embedding=Kernels()) as other:
        other.observe("felt", SCENE.touch("felt", 0).readings)
        other.observe("cork", SCENE.touch("cork", 0).readings)


def promised(words: list[str], folder: Path, output: str) -> bool:
    """Whether a command line that ended well did what README says of it."""
    shown = {
        "learn": f"learned: {len(MATERIALS) * TOUCHES} touches of {len(MATERIALS)} materials",
        "observe": "observed 5 times",
        "predict": "oak with",
        "memory merge": "1 stream observed by both",
        "memory export": "2 materials, ",
        "fleet": "; the memory has ",
        "report": "written: page.html",
    }
    made = {"report": "page.html", "memory export": "chip/touch_memory.c"}
    said = " ".join(words[1:3]) if words[1] == "memory" else words[1]
    return shown[said] in output and (said not in made or (folder / made[said]).exists())


def environment() -> dict[str, str]:
    """That a command is run in: lines are not cut where a terminal would end."""
    return {**os.environ, "COLUMNS": "500"}

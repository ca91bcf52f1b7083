"""Commands in processes of their own, with what a terminal can do to them: none ends in a traceback."""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from commands import refused, run
from rich.console import Console
from scroll_tactile_store import Store
from touches import PAD, SETTINGS, stream

from scroll_tactile import TactileLearner
from scroll_tactile.clients.cli import terminal
from scroll_tactile.clients.cli.terminal import shown
from scroll_tactile.errors import InputError, UnknownMaterialError, printable

COMMAND = [sys.executable, "-m", "scroll_tactile.clients.cli"]
HOSTILE = "\x1b]0;pwned\x07\x1b[2J\x9b31m\u202eevil\nline\x7f\u200b"


def test_progress_shows_names_as_they_are(monkeypatch):
    screen = Console(file=io.StringIO(), force_terminal=True, width=120)
    monkeypatch.setattr(terminal, "console", lambda **_: screen)
    with terminal.progress_bar() as progress:
        progress("3 touches; a[oak].npy", 0, 1)
    assert "a[oak].npy" in screen.file.getvalue()


def process(*words, shell="", env=(), **options):
    """A finished process, and what it wrote on its standard error; `shell` redirects what it writes."""
    typed = [*COMMAND, *map(str, words)]
    if shell:
        typed = ["bash", "-c", f'"$@" {shell}', "bash", *typed]
    done = subprocess.run(
        typed, check=False, capture_output=True, timeout=120, env={**os.environ, **dict(env)}, **options
    )
    errors = done.stderr.decode()
    assert "Traceback" not in errors, errors
    assert "Exception ignored" not in errors, errors
    return done, errors


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A memory of two touches in a folder, and beside it the first of them."""
    folder = tmp_path_factory.mktemp("whole")
    with TactileLearner.open(folder / "m", **SETTINGS) as learner:
        for i, name in enumerate(("naïve", "felt")):
            learner.observe(name, stream((i, 60)))
    np.save(folder / "t.npy", stream((0, 60)))
    return folder / "m"


@pytest.fixture
def path(whole, tmp_path):
    shutil.copytree(whole.parent, tmp_path, dirs_exist_ok=True)
    return tmp_path / "m"


@pytest.fixture
def received(path):
    """A memory with a name that no `observe` lets in, in rows with right checksums."""
    with Store.open(path) as store:
        record = store.record(1)
        store.append(record.kind, HOSTILE, b"k" * 32, attributes=record.attributes, arrays=dict(record.arrays))
    return path


@pytest.mark.parametrize("text", [HOSTILE, "\ud800\udcff", "\u2028\x00\t"])
def test_what_does_not_print_is_escaped(text):
    assert printable(text).isprintable()
    assert printable(text).encode().decode("unicode_escape").encode("utf-16", "surrogatepass") == text.encode(
        "utf-16", "surrogatepass"
    )
    assert printable("Filz, フェルト [b]") == "Filz, フェルト [b]"
    assert shown("[b]\x1b[31m") == r"\[b]\x1b[31m"


def test_messages_escape_names_and_paths_and_keep_their_lines():
    for kind in (InputError, UnknownMaterialError):
        assert str(kind("there is no memory in /tmp/\x1b[2J\udcff\nand none beside it")) == (
            "there is no memory in /tmp/\\x1b[2J\\udcff\nand none beside it"
        )


def test_a_received_name_does_not_drive_the_terminal(received, tmp_path):
    for words in (("inspect", received), ("predict", received, tmp_path / "t.npy"), ("memory", "check", received)):
        result = run(*words)
        assert all(line.isprintable() for line in result.output.splitlines()), repr(result.output)
        assert "evil\nline" not in result.output
        as_json = run(*words, "--json")
        assert as_json.output[:-1].isprintable() and as_json.output.isascii()
        assert as_json.exit_code == 1  # no observation has such a name, so the memory is not opened
    assert "\x1b" not in run("observe", tmp_path / "m\x1b[2J", "felt", tmp_path / "t.npy").output


def test_ascii_output_shows_other_names_escaped(path, tmp_path):
    done, errors = process("observe", path, "grün", tmp_path / "t.npy", env={"PYTHONIOENCODING": "ascii"})
    assert (done.returncode, errors.count("\n")) == (0, 1)  # the touch is there as felt, too
    assert b"gr\\xfcn" in done.stdout
    done, _ = process("inspect", path, "--json", env={"PYTHONIOENCODING": "ascii"})
    assert list(json.loads(done.stdout)["materials"]) == ["felt", "grün", "naïve"]


LINES, JSON, HELP = ("inspect",), ("inspect", "--json"), ("--help",)  # printed by rich, by echo, and while parsing


@pytest.mark.parametrize(
    ("words", "shell", "code", "errors"),
    [
        *((words, ">&-", 0, "") for words in (LINES, HELP)),
        (LINES, ">&- 2>&- <&-", 0, ""),
        *((words, ">/dev/full", 1, "No space left") for words in (LINES, JSON, HELP)),
        (LINES, ">/dev/full 2>/dev/full", 1, ""),
        *((words, "| true", None, "") for words in (LINES, JSON, HELP)),
    ],
)
def test_output_that_is_closed_full_or_read_by_nobody(monkeypatch, whole, words, shell, code, errors):
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)  # a buffer is flushed at the end, and fails there
    done, came = process(*words, *([] if words == HELP else [whole]), shell=shell)
    assert code in (None, done.returncode)
    assert errors in came and len(came.splitlines()) == bool(errors)
    with TactileLearner.open(whole, mode="read") as learner:
        assert sum(learner.materials.values()) == 2


def test_a_working_directory_that_is_gone(path, tmp_path):
    gone = tmp_path / "gone"
    gone.mkdir()
    typed = ["bash", "-c", 'cd "$1" && rmdir "$1" && shift && "$@"', "bash", str(gone), *COMMAND, "inspect", str(path)]
    done = subprocess.run(typed, check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("Error: the working directory cannot be read")
    assert "Traceback" not in done.stderr


def begun(code, *words):
    """A process that runs `code`, which says "ready", and the command."""
    start = f"import sys, time\nfrom scroll_tactile.clients.cli import main\n{code}\nmain()"
    return subprocess.Popen(
        [sys.executable, "-c", start, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def interrupted(running, seconds=0.0):
    """What a process wrote on its standard error that ctrl-C ended, so long after it said that it is ready."""
    try:
        assert running.stdout.readline() == "ready\n"
        time.sleep(seconds)
        running.send_signal(signal.SIGINT)
        return running.communicate(timeout=60)[1]
    finally:
        running.kill()


SLOW_IMPORT = """
import importlib.abc
class Slow(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == {name!r}:
            print("ready", flush=True)
            try:
                time.sleep(30)
            except BaseException as error:
                raise ImportError("what was interrupted is reported as another error") from error
sys.meta_path.insert(0, Slow())
"""


@pytest.mark.parametrize("name", ["typer", "scroll_tactile.learner"])
def test_an_interrupt_during_imports(whole, name):
    running = begun(SLOW_IMPORT.format(name=name), "predict", whole, whole.parent / "t.npy")
    errors = interrupted(running)
    assert (running.returncode, errors) == (130, "Interrupted.\n")


CUT_SHORT = """
import zarr.core.sync
def cut():
    raise KeyboardInterrupt
zarr.core.sync._get_loop = cut
"""


def test_an_interrupt_while_a_checkpoint_is_written(path):
    _, errors = begun(CUT_SHORT, "memory", "compact", path, "--yes").communicate(timeout=60)
    assert errors.splitlines() == [
        "Interrupted. What was observed is kept where there is a memory; start again to go on."
    ]


@pytest.mark.parametrize("seconds", [0.3, 1.2])
def test_an_interrupt_at_any_time(whole, seconds):
    running = begun("print('ready', flush=True)", "predict", whole, whole.parent / "t.npy")
    errors = interrupted(running, seconds)
    assert running.returncode in (0, 130, -signal.SIGINT)  # -2 while Python itself ends; a shell says 130
    assert "Traceback" not in errors and "Exception ignored" not in errors, errors


class TestFiles:
    def test_what_cannot_be_read(self, path, tmp_path):
        (tmp_path / "wide.csv").write_text("1," + "9" * 200_000 + "\n1,2\n")
        (tmp_path / "words.csv").write_text('"' + "x" * 200_000 + '",2\n1,2\n')
        (tmp_path / "null.csv").write_bytes(b"1,\x002\n")
        (tmp_path / "loop.npy").symlink_to(tmp_path / "loop.npy")
        (tmp_path / "folder.npy").mkdir()
        long = "x" * 300 + ".npy"
        short = ("wide.csv", "words.csv", "null.csv", "loop.npy", "folder.npy", "none.npy")
        for name in (*short, long, "/proc/self/mem.npy"):
            assert refused("predict", path, tmp_path / name)
            assert refused("observe", path, "felt", tmp_path / name)
        assert refused("inspect", tmp_path / "t.npy")
        assert refused("inspect", tmp_path / long)
        assert refused("observe", tmp_path / "t.npy", "felt", tmp_path / "t.npy", "--sensor", "biotac")
        assert refused("observe", path, "felt", tmp_path / "t.npy", "--sensor", tmp_path)
        assert refused("observe", path, "felt", tmp_path / "t.npy", "--sensor", long)
        assert refused("memory", "export", path, tmp_path / "t.npy")
        assert refused("memory", "backup", path, tmp_path / "t.npy")
        assert refused("memory", "merge", path, tmp_path / "t.npy")
        assert refused("demo", "--memory", tmp_path / long)

    def test_paths_that_are_no_text(self, path, tmp_path):
        odd = os.fsdecode(os.fsencode(tmp_path) + b"/m\xff\x1b")
        shutil.copytree(path, odd)
        done, errors = process("inspect", odd)
        assert errors.isprintable() or errors[:-1].isprintable()
        done, errors = process("memory", "backup", odd, odd + "2")
        assert b"\x1b" not in done.stdout


class TestFirstTouches:
    """A first touch that is refused leaves no memory."""

    @pytest.mark.parametrize(
        ("name", "readings"),
        [
            *(("felt", wrong) for wrong in (np.zeros((60, 3)), np.full((60, 2), np.nan), np.zeros((60, 2), complex))),
            *((name, stream((0, 60))) for name in ("", "a\nb")),
        ],
    )
    def test_of_a_pad(self, tmp_path, name, readings):
        np.save(tmp_path / "t.npy", readings)
        (tmp_path / "pad.json").write_text(PAD.model_dump_json())
        before = sorted(tmp_path.iterdir())
        assert refused("observe", tmp_path / "m", name, tmp_path / "t.npy", "--sensor", tmp_path / "pad.json")
        assert sorted(tmp_path.iterdir()) == before

"""Commands in processes of their own, with what a terminal can do to them: none ends in a traceback."""

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
from touches import PAD, SETTINGS, stream

from scroll_tactile import TactileLearner
from scroll_tactile.cli.terminal import shown
from scroll_tactile.errors import InputError, UnknownMaterialError, printable
from store import Store

COMMAND = [sys.executable, "-m", "scroll_tactile.cli"]
HOSTILE = "\x1b]0;pwned\x07\x1b[2J\x9b31m\u202eevil\nline\x7f\u200b"


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


def made(folder):
    """A memory of two touches in a folder, and beside it the first of them."""
    with TactileLearner.open(folder / "m", **SETTINGS) as learner:
        for i, name in enumerate(("naïve", "felt")):
            learner.observe(name, stream((i, 60)))
    np.save(folder / "t.npy", stream((0, 60)))
    return folder / "m"


@pytest.fixture
def path(tmp_path):
    return made(tmp_path)


@pytest.fixture(scope="module")
def seconds(tmp_path_factory):
    """How long a prediction takes that nothing interrupts."""
    folder = tmp_path_factory.mktemp("whole")
    typed, began = ("predict", made(folder), folder / "t.npy"), time.monotonic()
    process(*typed)
    return time.monotonic() - began


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
    for words in (
        ("inspect", path),
        ("predict", path, tmp_path / "t.npy"),
        ("observe", path, "grün", tmp_path / "t.npy"),
    ):
        done, errors = process(*words, env={"PYTHONIOENCODING": "ascii"})
        assert (done.returncode, errors) == (0, "")
        assert (b"na\\xefve" in done.stdout) or (b"gr\\xfcn" in done.stdout)
    done, _ = process("inspect", path, "--json", env={"PYTHONIOENCODING": "ascii"})
    assert list(json.loads(done.stdout)["materials"]) == ["felt", "grün", "naïve"]


@pytest.mark.parametrize("words", [("inspect",), ("inspect", "--json"), ("memory", "check"), ("--help",)])
class TestOutput:
    def typed(self, words, path):
        return words if words == ("--help",) else (*words, path)

    def test_closed(self, path, words):
        done, errors = process(*self.typed(words, path), shell=">&-")
        assert (done.returncode, errors) == (0, "")
        done, _ = process(*self.typed(words, path), shell=">&- 2>&- <&-")
        assert done.returncode == 0
        with TactileLearner.open(path) as learner:
            assert sum(learner.materials.values()) == 2

    def test_full(self, path, words):
        done, errors = process(*self.typed(words, path), shell=">/dev/full")
        assert done.returncode == 1
        assert len(errors.splitlines()) == 1 and "No space left" in errors
        assert process(*self.typed(words, path), shell=">/dev/full 2>/dev/full")[0].returncode == 1

    def test_nobody_reads(self, path, words):
        _, errors = process(*self.typed(words, path), shell="| true")
        assert errors == ""


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
    start = f"import sys, time\nfrom scroll_tactile.cli import main\n{code}\nmain()"
    return subprocess.Popen(
        [sys.executable, "-c", start, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


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


@pytest.mark.parametrize("name", ["typer", "numpy", "scroll_tactile.learner"])
def test_an_interrupt_during_imports(path, tmp_path, name):
    running = begun(SLOW_IMPORT.format(name=name), "predict", path, tmp_path / "t.npy")
    try:
        assert running.stdout.readline() == "ready\n"
        running.send_signal(signal.SIGINT)
        _, errors = running.communicate(timeout=30)
    finally:
        running.kill()
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


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5, 0.7, 0.9])
def test_an_interrupt_at_any_time(path, tmp_path, seconds, share):
    running = begun("print('ready', flush=True)", "predict", path, tmp_path / "t.npy")
    try:
        assert running.stdout.readline() == "ready\n"
        time.sleep(share * seconds)
        running.send_signal(signal.SIGINT)
        _, errors = running.communicate(timeout=60)
    finally:
        running.kill()
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
        for name in (
            "wide.csv",
            "words.csv",
            "null.csv",
            "loop.npy",
            "folder.npy",
            "none.npy",
            long,
            "/proc/self/mem.npy",
        ):
            assert refused("predict", path, tmp_path / name)
            assert refused("observe", path, "felt", tmp_path / name)
        assert refused("inspect", tmp_path / "t.npy")
        assert refused("inspect", tmp_path / long)
        assert refused("observe", tmp_path / "t.npy", "felt", tmp_path / "t.npy", "--sensor", "biotac")
        assert refused("observe", path, "felt", tmp_path / "t.npy", "--sensor", tmp_path)
        assert refused("observe", path, "felt", tmp_path / "t.npy", "--sensor", long)
        assert refused("memory", "export", path, tmp_path / "t.npy")
        assert refused("memory", "backup", path, tmp_path / "t.npy")
        assert refused("memory", "merge", path, tmp_path / "t.npy", "--shared", "once")
        assert refused("demo", "--memory", tmp_path / long)

    @pytest.mark.parametrize("number", [b"\xff", b"\x1b"])
    def test_paths_that_are_no_text(self, path, tmp_path, number):
        odd = os.fsdecode(os.fsencode(tmp_path) + b"/m" + number)
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
            ("felt", np.zeros((60, 3))),
            ("felt", np.full((60, 2), np.nan)),
            ("felt", np.zeros((1, 2))),
            ("felt", np.zeros((60, 2), dtype=complex)),
            ("", stream((0, 60))),
            ("a\nb", stream((0, 60))),
        ],
    )
    def test_of_a_pad(self, tmp_path, name, readings):
        np.save(tmp_path / "t.npy", readings)
        (tmp_path / "pad.json").write_text(PAD.model_dump_json())
        before = sorted(tmp_path.iterdir())
        assert refused("observe", tmp_path / "m", name, tmp_path / "t.npy", "--sensor", tmp_path / "pad.json")
        assert sorted(tmp_path.iterdir()) == before

    def test_of_a_camera_that_is_not_pressed(self, tmp_path):
        eye = {"name": "eye", "channels": 24 * 32 * 3, "rate": 25, "low": 0, "high": 255, "unit": "counts"}
        eye |= {"duration": 0.2, "layout": [24, 32, 3], "camera": True}
        (tmp_path / "eye.json").write_text(json.dumps(eye))
        np.save(tmp_path / "t.npy", np.full((5, 24, 32, 3), 100.0))
        assert refused("observe", tmp_path / "m", "felt", tmp_path / "t.npy", "--sensor", tmp_path / "eye.json")
        assert not (tmp_path / "m").exists()

    def test_of_the_demo(self, tmp_path):
        for words in (("--seed", "-1"), ("--sensor", "gelsight"), ("--sensor", "nose")):
            assert refused("demo", "--memory", tmp_path / "m", *words)
            assert not (tmp_path / "m").exists()

"""The command line: `scroll-tactile`, or `python -m scroll_tactile.clients.cli`.

Here is only what a process begins and ends with, so that ctrl-C during the imports finds it in place.
"""

from __future__ import annotations

import os
import signal
import sys
import traceback
import warnings
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    import typer

__all__ = ["INTERRUPTED", "application", "main"]

INTERRUPTED = 130  # what a shell reports for a command ended by ctrl-C: 128 + SIGINT
IMPORT = "<frozen importlib._bootstrap>"


def main() -> NoReturn:
    """Run the command that was typed, and exit: 0, 1 after an error, 2 for a wrong option, 130 after ctrl-C."""
    # Where a parent has it ignored, as nohup does, it stays so.
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if ours:
        signal.signal(signal.SIGINT, _interrupt)
    sys.unraisablehook = _unraisable
    # zarr's, of a call that ctrl-C cut short before it began.
    warnings.filterwarnings("ignore", "coroutine .* was never awaited", RuntimeWarning)
    _require_streams()
    code = 1
    try:
        _require_directory()
        application()(prog_name="scroll-tactile")
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except KeyboardInterrupt:
        _leave()
    except OSError as error:  # of what is printed while a command is parsed, such as --help
        if not isinstance(error, BrokenPipeError):
            _show(f"Error: {error}")
    except Exception as error:
        if sys.flags.dev_mode:
            raise
        code = _report_fault(error)
    finally:
        if ours:
            signal.signal(signal.SIGINT, _leave)  # nothing of ours is left to be ended in order
    for number, stream in ((1, sys.stdout), (2, sys.stderr)):
        try:
            stream.flush()
        except (OSError, ValueError):  # reported where it was printed
            _to_nowhere(number)
            code = code or 1
    sys.exit(code)


def application() -> typer.Typer:
    """The commands, put together."""
    import typer

    from scroll_tactile.clients.cli.bulk import demo, evaluate, fleet, learn, report, sensor
    from scroll_tactile.clients.cli.everyday import compose, describe, inspect, live, observe, predict
    from scroll_tactile.clients.cli.terminal import Commands, version
    from scroll_tactile.clients.cli.upkeep import PASSED_ON, mcp, memory, ros2

    app = typer.Typer(
        cls=Commands,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        help="A robot's memory of how things feel. It learns a material from one touch, forgets nothing, and says when "
        "it has never felt something. Start with: scroll-tactile demo",
    )
    app.callback()(version)
    everyday = (demo, sensor, observe, learn, fleet, predict, evaluate, live, inspect, describe, compose, report, mcp)
    for command in everyday:
        app.command()(command)
    app.command(context_settings=PASSED_ON)(ros2)
    app.add_typer(memory, name="memory")
    return app


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt; but leave at once during an import, which would make another error of it, or lose it."""
    while frame is not None:
        if frame.f_code.co_filename == IMPORT:
            _leave()
        frame = frame.f_back
    raise KeyboardInterrupt


def _leave(*_: Any) -> NoReturn:
    try:
        os.write(2, b"Interrupted.\n")
    finally:
        os._exit(INTERRUPTED)


def _unraisable(raised: Any) -> None:
    """Ctrl-C that came in a finalizer, where Python loses it, comes again; what else is lost there is shown."""
    if issubclass(raised.exc_type, KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    else:
        sys.__unraisablehook__(raised)


def _require_streams() -> None:
    """Open what was closed (`>&-`) to nowhere: a file of a memory would get its number, and the output with it."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        stream: Any = getattr(sys, name)
        if stream is None:
            _to_nowhere(number)
            setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115
        elif mode == "w":
            stream.reconfigure(errors="backslashreplace")  # names that the terminal's encoding does not have


def _to_nowhere(number: int) -> None:
    nowhere = os.open(os.devnull, os.O_RDWR)
    if nowhere != number:
        os.dup2(nowhere, number)
        os.close(nowhere)


def _require_directory() -> None:
    try:
        os.getcwd()  # noqa: PTH109  # libraries read it while they are imported, and end the process where they cannot
    except OSError as error:
        _show(f"Error: the working directory cannot be read ({error.strerror}): change to one that is there")
        raise SystemExit(1) from None


def _report_fault(error: Exception) -> int:
    *_, (frame, line) = traceback.walk_tb(error.__traceback__)
    where = f"{os.path.basename(frame.f_code.co_filename)}:{line}"  # noqa: PTH119
    _show(
        f"Error: a fault of scroll-tactile, {type(error).__name__} in {where}: {str(error)!a:.300}. Please report it; "
        "PYTHONDEVMODE=1 shows where it came from"
    )
    return 1


def _show(text: str) -> None:
    try:
        print(text, file=sys.stderr, flush=True)
    except OSError:
        _to_nowhere(2)

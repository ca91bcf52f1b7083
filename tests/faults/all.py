"""Every fault study in turn, each in a fork of one process that has everything imported; the record has that of each.

`--only kill "power_cut --without log"`: these, with these options. One that fails does not keep the others from
running, nor does one that hangs: a quick run gives each ten minutes. The exit code is 1 where one failed, where a
figure is empty that says how much was tried, and where `HARSH` ones, from which something is taken that has to be
missed, found too little; a quick run does these, too.
"""

from __future__ import annotations

import faulthandler
import json
import os
import runpy
import shlex
import signal
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from faults.common import parser, progress
from faults.learners import warm
from faults.shim import begin_again_watched

HERE = Path(__file__).parent
# The figures of each study that say what was tried.
STUDIES = {
    "kill": ["kills", "landed in", "counts"],
    "each_call": ["calls", "steps", "outcomes"],
    "power_cut": ["disks", "histories", "calls written down", "cut in", "styles"],
    "bit_flips": ["flips", "outcomes", "by file"],
    "disk": ["operations", "outcomes"],
    "processes": ["locks", "readers"],
    "latency": ["tiny, 64 features, exemplars=0", "bulk: tiny, 64 features, exemplars=0"],
    "space": ["rows", "large"],
    "threads": ["rounds", "calls", "answers looked up"],
    "simulate": ["seeds", "events", "plants"],
}
# What is taken from a memory, or from its disk, must be missed: this many failures are found at least.
HARSH = {"power_cut --without log": 3}
LONGEST = 600  # seconds that a study may take in a quick run; the slowest takes one minute


def study(words: list[str], record: Path, longest: int) -> dict[str, Any]:
    """Run a command in a fork; its record, or how it ended where it left none. longest: seconds; 0 for ever."""
    sys.stdout.flush()
    if (pid := os.fork()) == 0:
        status = 1
        try:
            os.setpgrp()
            faulthandler.register(signal.SIGALRM, chain=True)  # says where each thread is, and ends
            signal.alarm(longest)
            sys.argv = [f"{words[0]}.py", *words[1:], "--json", str(record)]
            runpy.run_path(str(HERE / f"{words[0]}.py"), run_name="__main__")
            status = 0
        except SystemExit as ended:
            status = int(ended.code or 0)
        finally:
            sys.stdout.flush()
            os._exit(status)
    try:
        _, status, used = os.wait4(pid, 0)
    except KeyboardInterrupt:
        os.killpg(pid, signal.SIGINT)
        raise
    with suppress(ProcessLookupError):  # what it started and left would keep a pipe open that others read to its end
        os.killpg(pid, signal.SIGKILL)
    found = {"name": words[0], "seconds": 0, "failures": [f"ended with {status}, and left no record"]}
    if record.exists():
        found = dict(json.loads(record.read_text(encoding="utf-8")))
    else:
        progress(f"{words[0]}: {found['failures']}")
    return found | {"processor seconds": round(used.ru_utime + used.ru_stime, 1)}


def is_right(name: str, record: dict[str, Any]) -> bool:
    """Whether a study tried what it has to, and found as much as it has to."""
    if name in HARSH:
        return len(record["failures"]) >= HARSH[name]
    return not record["failures"] and all(map(record.get, STUDIES.get(name, ())))


def main() -> int:
    """Run them all."""
    made = parser(__doc__, seed=None)
    made.add_argument("--only", nargs="*", metavar="STUDY")
    options = made.parse_args()
    more = [*(["--quick"] if options.quick else []), *([f"--home={options.home}"] if options.home else [])]
    warm()
    records, longest = {}, LONGEST if options.quick else 0
    with tempfile.TemporaryDirectory() as scratch:
        only = options.only or [*STUDIES, *(HARSH if options.quick else ())]
        for number, name in enumerate(only):
            progress(f"--- {name}")
            # Of a simulation a seed replays one.
            seed = [] if options.seed is None else [f"--{'first' if name == 'simulate' else 'seed'}={options.seed}"]
            records[name] = study([*shlex.split(name), *more, *seed], Path(scratch, f"{number}.json"), longest)
            if options.json is not None:
                options.json.write_text(json.dumps(records, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    for name, record in records.items():
        took = f"{record['seconds']:>8} s  {record['processor seconds']:>8} s of processor"
        said = "" if is_right(name, record) else "  WRONG"
        print(f"{name:<22} {took}  {len(record['failures'])} failures{said}")
    return int(not all(is_right(name, record) for name, record in records.items()))


if __name__ == "__main__":
    begin_again_watched()
    sys.exit(main())

"""Every fault study in turn, each in a fork of one process that has everything imported; the record has that of each.

One that fails does not keep the others from running; the exit code is 1 where one failed.
"""

from __future__ import annotations

import json
import os
import runpy
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from faults.common import parser, progress
from faults.model import warm
from faults.shim import begin_again_watched

HERE = Path(__file__).parent
NAMES = ("kill", "each_call", "power_cut", "bit_flips", "disk", "processes", "latency", "space", "hostile", "threads")


def study(name: str, arguments: list[str], record: Path) -> dict[str, Any]:
    """Run a command in a fork; its record, or how it ended where it left none."""
    sys.stdout.flush()
    if (pid := os.fork()) == 0:
        status = 1
        try:
            sys.argv = [f"{name}.py", *arguments, "--json", str(record)]
            runpy.run_path(str(HERE / f"{name}.py"), run_name="__main__")
            status = 0
        except SystemExit as ended:
            status = int(ended.code or 0)
        finally:
            sys.stdout.flush()
            os._exit(status)
    _, status = os.waitpid(pid, 0)
    if record.exists():
        return dict(json.loads(record.read_text(encoding="utf-8")))
    return {"name": name, "seconds": 0, "failures": [f"ended with {status}, and left no record"]}


def main() -> int:
    """Run them all."""
    made = parser(__doc__)
    made.add_argument("--only", nargs="*", choices=NAMES, default=NAMES)
    options = made.parse_args()
    arguments = ["--seed", str(options.seed), *(["--quick"] if options.quick else [])]
    arguments += ["--home", str(options.home)] if options.home else []
    warm()
    records = {}
    with tempfile.TemporaryDirectory() as scratch:
        for name in options.only:
            progress(f"--- {name}")
            records[name] = study(name, arguments, Path(scratch, f"{name}.json"))
            if options.json is not None:
                options.json.write_text(json.dumps(records, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    for name, record in records.items():
        print(f"{name:<12} {record['seconds']:>8} s  {len(record['failures'])} failures")
    return int(any(record["failures"] for record in records.values()))


if __name__ == "__main__":
    begin_again_watched()
    sys.exit(main())

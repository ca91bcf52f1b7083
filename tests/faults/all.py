"""Every fault study in turn; each writes its record, and the folder holds all of them in the end.

One that fails does not keep the others from running. The record has that of each; the exit code is 1 where one failed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from faults.common import parser, progress

HERE = Path(__file__).parent
NAMES = ("kill", "each_call", "power_cut", "bit_flips", "disk", "processes", "latency", "space")


def one(name: str, options: argparse.Namespace, record: Path) -> dict[str, Any]:
    """Run a command; its record, or what it said where it left none."""
    command = [sys.executable, str(HERE / f"{name}.py"), "--seed", str(options.seed), "--json", str(record)]
    command += ["--quick"] if options.quick else []
    command += ["--home", str(options.home)] if options.home else []
    begun = time.perf_counter()
    done = subprocess.run(command, check=False, stdout=subprocess.PIPE, text=True)
    print(done.stdout, flush=True)
    if record.exists():
        return dict(json.loads(record.read_text(encoding="utf-8")))
    failure = f"ended with {done.returncode}, and left no record: {done.stdout[-2000:]}"
    return {"name": name, "seconds": round(time.perf_counter() - begun, 1), "failures": [failure]}


def main() -> int:
    """Run them all."""
    made = parser(__doc__)
    made.add_argument("--only", nargs="*", choices=NAMES, default=NAMES)
    options = made.parse_args()
    records = []
    with tempfile.TemporaryDirectory() as scratch:
        for name in options.only:
            progress(f"--- {name}")
            records.append(one(name, options, Path(scratch, f"{name}.json")))
            if options.json is not None:
                text = json.dumps({record["name"]: record for record in records}, indent=1, ensure_ascii=False)
                options.json.write_text(text + "\n", encoding="utf-8")
    for record in records:
        print(f"{record['name']:<12} {record['seconds']:>8} s  {len(record['failures'])} failures")
    return int(any(record["failures"] for record in records))


if __name__ == "__main__":
    sys.exit(main())

"""`python -m examples.benchmarks numerics`: speed against error, the exact form beside its alternatives, on hard cases.

Every record is one method on one case: the relative error of its weights, decisions that it flips, seconds of the
processor for each row, and what it says of itself.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from examples.benchmarks.numerics.cases import Case, make_cases
from examples.benchmarks.numerics.long_runs import run_scatter, run_schedules, run_updates
from examples.benchmarks.numerics.measures import bars, measure
from examples.benchmarks.numerics.recorded import NIST, nist_cases, real_case
from examples.benchmarks.solvers.methods import SOLVERS
from examples.benchmarks.timing import circumstances
from scroll_tactile.errors import DatasetError

__all__ = ["find_nist", "run_numerics"]

Record = dict[str, Any]
Progress = Callable[[str, int, int], None]

QUICK = 0.2  # of the cases' sizes
# One-row updates at d = 512 cost the recursive forms half a millisecond to one each: 10⁶ of them would take minutes.
UPDATES = {
    32: {"covariance": 10**6, "covariance-symmetric": 10**5, "qr": 10**5, "gram64": 10**6, "gram32": 10**6}
    | {"exact": 10**6, "exact24": 10**5, "exact20": 10**5},
    512: {"covariance": 10**6, "qr": 10**4, "gram64": 10**6, "exact": 10**6},
}
QUICK_UPDATES = {32: dict.fromkeys(SOLVERS, 10**4)}
SCHEDULED = ("exact", "exact24", "exact20", "gram64", "gram32", "qr", "covariance")


def find_nist(data: Path | None) -> Path | None:
    """NIST's file in the folder of the data, or beside a checkout of the project; None where it is in neither."""
    places = [Path(__file__).resolve().parents[4] / "shared" / "data" / NIST]
    if data is not None:
        places.insert(0, data / NIST)
    return next((place for place in places if place.is_file()), None)


def run_numerics(
    *,
    seed: int = 0,
    quick: bool = False,
    data: Path | None = None,
    nist: Path | None = None,
    progress: Progress = lambda what, done, of: None,
) -> Record:
    """Measure every method on every case. Returns records, which bars are met, and what was not measured, and why.

    data: a folder with biotac_slide_20_50; nist: the file of certified regressions. Without them these are left out.
    """
    result = {"bench": "numerics", **circumstances(seed), "quick": quick}
    missing: dict[str, str] = {}
    cases = [*make_cases(seed, QUICK if quick else 1.0), *_from_files(seed, quick, data, nist, missing)]
    steps = len(cases) * len(SOLVERS) + 40
    done = 0

    def note(what: str) -> None:
        nonlocal done
        progress(what, done, max(steps, done + 1))
        done += 1

    records: list[Record] = []
    for case in cases:
        for method in SOLVERS:
            note(f"{case.name}: {method}")
            records.append(measure(case, method, seed))
        if case.family == "offset":
            records += run_scatter(case, note)
    for dimension, most in (QUICK_UPDATES if quick else UPDATES).items():
        records += run_updates(seed, dimension, most, note)
    records += run_schedules(seed, SCHEDULED, 20 if quick else 1000, 32, note)
    return result | {"records": records, "bars": bars(records), "not_measured": missing}


def _from_files(seed: int, quick: bool, data: Path | None, nist: Path | None, missing: dict[str, str]) -> list[Case]:
    """Cases that are read; `missing` is told of those that are not, and why."""
    found: list[Case] = []
    if nist is None:
        missing["NIST StRD"] = f"no file {NIST}"
    else:
        found += nist_cases(nist)
    names: tuple[Literal["biotac", "roboskin"], ...] = ("biotac", "roboskin")
    for name in names:
        if data is None:
            missing[name] = "no --data with biotac_slide_20_50 in it"
            continue
        try:
            found.append(real_case(name, data, seed, 64 if quick else 512, 200 if quick else None))
        except DatasetError as error:
            missing[name] = str(error)
    return found

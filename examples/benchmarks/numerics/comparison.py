"""`python -m examples.benchmarks numerics`: what the learner runs on hard memories, what its grid costs, and its peers.

Every record is one method on one case: the errors of its answers and weights, answers that it flips, seconds of the
processor for each row, and what it says of itself. Methods are "learner", its readout solved from the integers;
"grid", true answers for the codes against true answers for the features; and the solvers of any
doubles, which are given the same codes, and regressions of their own that no learner meets.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from examples.benchmarks.numerics.learned import AGREED, measure_learned
from examples.benchmarks.numerics.long_runs import run_schedules, run_updates
from examples.benchmarks.numerics.memories import Memory, make_memories
from examples.benchmarks.numerics.peers import as_case, measure
from examples.benchmarks.numerics.recorded import NIST, nist_cases, real_memory
from examples.benchmarks.numerics.regressions import Case, make_cases
from examples.benchmarks.solvers.methods import SOLVERS
from examples.paper.runs.options import Json, Seed
from examples.paper.runs.results import show, write
from scroll_tactile.clients.cli.terminal import progress_bar, say
from scroll_tactile.errors import DatasetError

__all__ = ["claims", "find_nist", "numerics", "run_numerics"]

Record = dict[str, Any]
Progress = Callable[[str, int, int], None]

QUICK = 0.2  # of the cases' sizes
OBSERVATIONS, QUICK_OBSERVATIONS = 10**6, 10**4
DIMENSION = 16  # of the long run
SCHEDULED = ("learner", *SOLVERS)


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
    """Measure every method on every case. Returns records, what the learner claims, and what was not measured, and why.

    data: a folder with biotac_slide_20_50; nist: the file of certified regressions. Without them these are left out.
    """
    missing: dict[str, str] = {}
    memories = [*make_memories(seed, QUICK if quick else 1.0), *_real(seed, quick, data, missing)]
    regressions = [*make_cases(seed), *_certified(nist, missing)]
    steps = (len(memories) + len(regressions)) * (1 + len(SOLVERS))
    done = 0

    def note(what: str) -> None:
        nonlocal done
        progress(what, done, max(steps, done + 1))
        done += 1

    records: list[Record] = []
    for memory in memories:
        note(f"{memory.name}: the learner")
        records += (learned := measure_learned(memory))
        records += _peers(as_case(memory, learned[0]["penalty"]), seed, note)
    for case in regressions:
        records += _peers(case, seed, note)
    observations = QUICK_OBSERVATIONS if quick else OBSERVATIONS
    records += run_updates(seed, DIMENSION, observations, tuple(SOLVERS), note)
    records += run_schedules(seed, SCHEDULED, 20 if quick else 1000, 32, note)
    result = {"bench": "numerics", "quick": quick}
    return result | {"records": records, "claims": claims(records), "not_measured": missing}


def claims(records: list[Record]) -> Record:
    """The worst errors of what the learner runs, within the bound and below the grid, and whether they are below 1e-9.

    Of the scores of both readouts and of novelty; of scores of touches left out; of ρ. What the
    grid costs is no arithmetic: its errors stand beside.
    """
    ours = [record for record in records if record["method"] == "learner" and record["family"] != "schedules"]
    fields = ("answers_error", "ridge_error", "novelty_error", "left_out_error", "share_error")
    worst = {
        name: max((record[name], record["case"]) for record in ours if record.get(name) is not None) for name in fields
    }
    found: Record = {name: {"error": error, "case": case} for name, (error, case) in worst.items()}
    grid = [record for record in records if record["method"] == "grid"]
    for family in ("within the bound", "below the grid"):
        mine = [record for record in grid if record["family"] == family]
        found[f"grid, {family}"] = {
            "weights_error": max(record["weights_error"] for record in mine),
            "answers_error": max(record["answers_error"] for record in mine),
            "flipped": sum(record["flipped"] for record in mine),
        }
    agreed = all(worst[name][0] <= AGREED for name in fields if name != "left_out_error")
    return found | {"agreed": agreed, "limit": AGREED, "flipped": sum(record["flipped"] for record in ours)}


def _peers(case: Case, seed: int, note: Callable[[str], None]) -> Iterator[Record]:
    for method in SOLVERS:
        note(f"{case.name}: {method}")
        yield measure(case, method, seed)


def _certified(nist: Path | None, missing: dict[str, str]) -> Iterator[Case]:
    if nist is None:
        missing["NIST StRD"] = f"no file {NIST}"
    else:
        yield from nist_cases(nist)


def _real(seed: int, quick: bool, data: Path | None, missing: dict[str, str]) -> Iterator[Memory]:
    """Memories of recorded touches; `missing` is told of those that are not there, and why."""
    names: tuple[Literal["biotac", "roboskin"], ...] = ("biotac", "roboskin")
    for name in names:
        if data is None:
            missing[name] = "no --data with biotac_slide_20_50 in it"
            continue
        try:
            yield real_memory(name, data, seed, 64 if quick else 256, 200 if quick else None)
        except DatasetError as error:
            missing[name] = str(error)


def numerics(
    context: typer.Context,
    data: Annotated[
        Path | None, typer.Option(help="Folder with biotac_slide_20_50: also cases of real features.")
    ] = None,
    nist: Annotated[
        Path | None, typer.Option(help="NIST's linear regressions, nist_strd.json; looked for with the data.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Every case and method, small: under a minute.")] = False,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Compare exact sums with RLS, QR and plain ones on hard cases: errors in weights against the truth, and time.

    The whole takes ten minutes or so. Ends with 1 where the learner's errors exceed what it claims, or an answer flips.
    """
    with progress_bar() as progress:
        result = run_numerics(seed=seed, quick=quick, data=data, nist=nist or find_nist(data), progress=progress)
    cases: dict[str, Record] = {}
    for record in result["records"]:
        if record["family"] == "schedules":
            say(f"{record['case']}: {record['method']}: {record['diagnosis']}")
        else:
            cases.setdefault(record["case"], {"case": record["case"]})[record["method"]] = record
    columns = {"case": "{./case}"}
    for method in dict.fromkeys(record["method"] for record in result["records"]):
        columns[method] = f"{{?./{method}/answers_error or ./{method}/weights_error|.0e??–}}"
    show("relative error of the answers, or where a case has none of the weights", columns, cases.values())
    for what, why in result["not_measured"].items():
        say(f"[yellow]not measured:[/] {what}: {why}")
    claimed = result["claims"]
    verdict = "stay below" if claimed["agreed"] else "[red]exceed[/]"
    say(f"scores, novelty and ρ of the learner {verdict} {claimed['limit']:.0e}; flipped: {claimed['flipped']}")
    write(context, result)
    if not claimed["agreed"] or claimed["flipped"]:
        raise typer.Exit(1)

"""`python -m examples.benchmarks chips`: the exported judge beside the learner, and on chips that QEMU plays.

Of both sensors the learner observes four folds, and its exported judge of all twenty materials, and of a scene of five,
answers the fifth: right, calibrated and unknown beside the learner's own. All thousand touches of a set go through the
exported C on every board, whole, and each also cut somewhere; the answers have to be those of Python, to the last bit
of every score. Instructions are counted by QEMU; what they take at a clock is reckoned, one a cycle.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from examples.benchmarks.chips.boards import BOARDS, Board, missing_tools
from examples.paper.readers.biotac_slide import load
from examples.paper.readers.labelled import Recordings, hold_out
from examples.paper.runs.options import Data, Json, Seed, folds_of
from examples.paper.runs.results import show, write
from scroll_tactile import Stream, TactileLearner
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.clients.firmware.c_files import flash_bytes, touches_to_check, write_firmware
from scroll_tactile.clients.firmware.exported_judge import ExportedJudge, LevelRows
from scroll_tactile.clients.learning.metrics import accuracy, calibration_error, mean_and_spread

__all__ = ["chips", "run_chips"]

Record = dict[str, Any]
Note = Callable[[str], None]

SETS = {"biotac-20": "biotac", "roboskin-20": "roboskin"}
SCENE = 5  # materials
COUNTED = 24  # touches whose instructions are counted


def run_chips(data: Path, *, folds: str = "all", seed: int = 0, note: Note = lambda _: None) -> Record:
    """Accuracy of exported judges by set and fold, and what boards answer and need. Raises DatasetError."""
    records, boards = [], []
    for name, sensor in SETS.items():
        recordings = load(data, sensor, seed)  # type: ignore[arg-type]  # one of its literals
        for fold in folds_of(folds, recordings):
            note(f"{name}, fold {fold}")
            learner, tested = _learned(recordings, fold)
            records.append({"set": name, "fold": fold, **_accuracies(learner, tested)})
            if fold == 0:
                boards += [record | {"set": name} for record in _on_boards(learner, recordings, seed, note)]
    return {"bench": "chips", "judges": judges(records), "boards": boards, "records": records}


def judges(records: Sequence[Record]) -> list[Record]:
    """Means over the folds of a set of the exported judge and of the learner, of all materials and of a scene."""
    found = []
    for name in dict.fromkeys(record["set"] for record in records):
        own = [record for record in records if record["set"] == name]
        for judge in [key for key in own[0] if "/" in key]:
            row: Record = {"set": name, "scene": judge.partition("/")[0], "judge": judge.partition("/")[2]}
            for figure in own[0][judge]:
                mean, spread = mean_and_spread([record[judge][figure] for record in own])
                row[figure] = {"mean": mean, "sd": spread, "folds": len(own)}
            found.append(row)
    return found


def _learned(recordings: Recordings, fold: int) -> tuple[TactileLearner, list[tuple[str, Stream]]]:
    learned, tested = hold_out(recordings, recordings.fold == fold)
    learner = TactileLearner(sensor=recordings.sensor)
    for name, stream in learned:
        learner.observe(name, stream)
    learner.settle()
    return learner, tested


def _accuracies(learner: TactileLearner, tested: Sequence[tuple[str, Stream]]) -> Record:
    """The learner and its exported judge, of all materials and of a scene; touches of others are new there."""
    found: Record = {}
    for case, scene in (("all", sorted(learner.materials)), ("scene", sorted(learner.materials)[:SCENE])):
        judge = learner.exported(scene)
        exported = [judge.predict(stream) for _, stream in tested]
        own = [learner.predict(stream, scene=scene) for _, stream in tested]
        for who, answers in (("exported", exported), ("learner", own)):
            found[f"{case}/{who}"] = _scores([name for name, _ in tested], answers, scene)
        early = [judge.predict(stream.first(0.3)) for _, stream in tested]
        found[f"{case}/exported, 0.3 s"] = _scores([name for name, _ in tested], early, scene)
    return found


def _scores(truth: Sequence[str], answers: Iterable[Any], scene: Sequence[str]) -> Record:
    pairs = list(zip(truth, answers, strict=True))
    own, new = ([pair for pair in pairs if (pair[0] in scene) is inside] for inside in (True, False))
    right = [answer.material == name for name, answer in own]
    found = {
        "accuracy": accuracy([name for name, _ in own], [answer.material for _, answer in own]),
        "ece": calibration_error([answer.probability for _, answer in own], right),
        "unknown": float(np.mean([answer.known is False for _, answer in own])),
    }
    return found | ({"new found": float(np.mean([answer.known is False for _, answer in new]))} if new else {})


def _on_boards(learner: TactileLearner, recordings: Recordings, seed: int, note: Note) -> list[Record]:
    rng, found = np.random.default_rng(seed), []
    for materials in (len(learner.materials), SCENE):
        judge = learner.exported(sorted(learner.materials)[:materials])
        touches = [judge.levels(stream) for stream in recordings.streams]
        touches += [touch[: rng.integers(1, len(touch) + 1)] for touch in touches]
        for board in BOARDS:
            if lacking := missing_tools(board):
                note(f"{board.name} is left out: {', '.join(lacking)} are not there")
                continue
            note(f"{board.name}, {materials} materials")
            found.append({"materials": materials, "board": board.name, **_measured(board, judge, touches)})
    return found


def _measured(board: Board, judge: ExportedJudge, touches: Sequence[LevelRows]) -> Record:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "exported"
        write_firmware(judge, folder, touches)
        program = board.build(folder)
        record: Record = board.judge(program, folder / "touches.bin")
        record["tables"] = flash_bytes(judge)
        if board.machine:
            (folder / "counted.bin").write_bytes(touches_to_check(judge, touches[:COUNTED]))
            counted = board.judge(program, folder / "counted.bin", COUNTED)["instructions"]
            readings, pushing, judging = (float(np.median([row[i] for row in counted])) for i in range(3))
            million = (pushing + judging) / 1e6
            record |= board.sizes(folder)
            record |= {
                "readings": readings,
                "million_instructions": million,
                "most": max(row[2] for row in counted) / 1e6,
            }
            record |= {"megahertz": board.megahertz, "milliseconds": 1e3 * million / board.megahertz}
    return record


def chips(
    context: typer.Context,
    data: Data,
    folds: Annotated[str, typer.Option(help="Those that are measured: all, or numbers with commas between.")] = "all",
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Compare the exported judge with the learner, and its C on chips that QEMU plays with Python.

    Boards whose compiler or emulator is missing are left out; Debian has gcc-arm-none-eabi, qemu-system-arm, qemu-user
    and gcc-aarch64-linux-gnu.
    """
    with progress_bar() as progress:
        result = run_chips(data, folds=folds, seed=seed, note=lambda what: progress(what, 0, 1))
    columns = {name: f"{{./{name}}}" for name in ("set", "board", "materials", "touches", "differ")}
    columns |= {"million instructions": "{?./million_instructions|.1f}", "flash": "{?./flash}", "RAM": "{?./ram}"}
    show("the exported judge on boards", columns, result["boards"])
    write(context, result)

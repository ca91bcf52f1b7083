"""A LeRobot data set (v3), written anew with what a memory answers at each frame, for a policy to be trained on.

    python examples/lerobot_annotate.py DATASET MEMORY OUTPUT --field observation.tactile

It needs the extra lerobot (pyarrow). Each episode is one touch; with --contacts touches are found in it, after two
seconds at rest. A frame has what a live session would have said after it, and no more: a policy sees in training what
the robot will know when it acts. The last frame of an episode that is one touch has the answer to the whole touch.

- observation.touch.material, int64: the name's place in `info.materials` of the feature; -1 without an answer
- observation.touch.probability, float32: of that material; 0 without an answer
- observation.touch.known, int64: 1 learned, 0 never observed, -1 where that cannot be told

The old data set stays as it is; the new one is there once it is whole.
"""

import json
import re
import shutil
import sys
import tempfile
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import typer
from pyarrow import parquet

from scroll_tactile import TactileLearner
from scroll_tactile.errors import InputError, NotFiniteError, ScrollTactileError
from scroll_tactile.live.answers import LiveState
from scroll_tactile.recordings import read
from scroll_tactile.results import Prediction

PREFIX = "observation.touch."
TYPES = {"material": np.int64, "probability": np.float32, "known": np.int64}
Columns = dict[str, npt.NDArray[Any]]


def annotate(learner: TactileLearner, dataset: Path, output: Path, field: str, *, contacts: bool = False) -> Columns:
    """Write the data set with answers into a new folder; the answers are also returned, by column.

    Raises InputError for an output that is there or lies in the data set, for frames far from the sensor's rate, and
    for a data set that has answers already; and what `recordings.read` raises.
    """
    if output.exists() or output.resolve().is_relative_to(dataset.resolve()):
        raise InputError(f"expected a new folder outside the data set; came {output}: give another")
    learner.settle()  # equal memories then give equal columns
    recording = read(dataset, field=field)
    files = sorted(dataset.glob("data/**/*.parquet"), key=lambda path: [*map(int, re.findall(r"\d+", str(path)))])
    episodes = np.concatenate([parquet.ParquetFile(path).read(["episode_index"])[0].to_numpy() for path in files])
    if len(episodes) != len(recording):
        raise InputError(f"{dataset} has {len(episodes)} frames, of which {len(recording)} are in its episodes")
    answers = {PREFIX + name: np.full(len(episodes), -1, kind) for name, kind in TYPES.items()}
    answers[f"{PREFIX}probability"][:] = 0
    names, spans = sorted(learner.materials), [0, *(np.flatnonzero(np.diff(episodes)) + 1).tolist(), len(episodes)]
    for begin, end in pairwise(spans):
        said = predictions(learner, recording.readings[begin:end], recording.times[begin:end], contacts)
        for frame, prediction in enumerate(said, start=begin):
            if prediction is not None and prediction.material is not None:
                answers[f"{PREFIX}material"][frame] = names.index(prediction.material)
                answers[f"{PREFIX}probability"][frame] = prediction.probability
                answers[f"{PREFIX}known"][frame] = -1 if prediction.known is None else int(prediction.known)
    with tempfile.TemporaryDirectory(dir=output.parent, prefix=f"{output.name}.") as folder:
        new, at = Path(folder) / "set", 0
        shutil.copytree(dataset, new)
        for path in (new / file.relative_to(dataset) for file in files):
            table = parquet.ParquetFile(path).read()
            for name, column in answers.items():
                if name in table.schema.names:
                    raise InputError(f"{dataset} has a column {name!r} already: take the data set without it")
                table = table.append_column(name, pa.array(column[at : at + table.num_rows]))
            parquet.write_table(table, path)
            at += table.num_rows
        write_metadata(new, answers, episodes, {"materials": names, "memory": learner.digest()})
        new.rename(output)
    return answers


def predictions(learner: TactileLearner, readings: Any, times: Any, contacts: bool) -> list[Prediction | None]:
    """What a live session says after each frame of an episode."""
    step, rate = float(np.median(np.diff(times))) if len(times) > 1 else 0.0, learner.sensor.rate
    if step and not 0.48 < step * rate < 2.1:  # most frames would be left out, or made up between others
        raise InputError(f"expected frames at about the sensor's {rate:g} readings a second; these come every {step} s")
    state, said = LiveState(), []
    with learner.live(contact="auto" if contacts else "manual") as session:
        for frame, (reading, time) in enumerate(zip(readings, times.tolist(), strict=True), start=1):
            if not contacts and not state.contact:  # at the beginning, and after a gap in time
                session.begin()
            with suppress(NotFiniteError):  # the session goes on, and knows what it knew
                state = session.push(reading.reshape(learner.sensor.shape), time)
            if not contacts and frame == len(times):
                state = session.end()
            said.append(state.prediction)
    return said


def write_metadata(folder: Path, answers: Columns, episodes: npt.NDArray[Any], about: dict[str, Any]) -> None:
    """Add the columns to the features, and their statistics to those that the data set keeps, of all and by episode."""
    info = json.loads((folder / "meta/info.json").read_text("utf-8"))
    for name, column in answers.items():
        more = about if name == f"{PREFIX}material" else {}
        info["features"][name] = {"dtype": str(column.dtype), "shape": [1], "names": None, "info": more}
    (folder / "meta/info.json").write_text(json.dumps(info, indent=4), "utf-8")
    if (folder / "meta/stats.json").is_file():
        kept = json.loads((folder / "meta/stats.json").read_text("utf-8"))
        wanted = {statistic for own in kept.values() for statistic in own}
        kept |= {name: statistics(column, wanted) for name, column in answers.items()}
        (folder / "meta/stats.json").write_text(json.dumps(kept, indent=4), "utf-8")
    for path in folder.glob("meta/episodes/**/*.parquet"):
        table = parquet.ParquetFile(path).read()
        wanted = {name.rpartition("/")[2] for name in table.schema.names if name.startswith("stats/")}
        for name, column in answers.items():
            rows = [statistics(column[episodes == each], wanted) for each in table["episode_index"].to_pylist()]
            for statistic in sorted(rows[0] if rows else ()):
                table = table.append_column(f"stats/{name}/{statistic}", pa.array([row[statistic] for row in rows]))
        parquet.write_table(table, path)


def statistics(column: npt.NDArray[Any], wanted: set[str]) -> dict[str, list[Any]]:
    """The wanted statistics of a column, by LeRobot's names."""
    values = column.astype(np.float64)
    found: dict[str, Any] = {"min": column.min(), "max": column.max(), "mean": values.mean(), "std": values.std()}
    found |= {f"q{share:02d}": np.quantile(values, share / 100) for share in (1, 10, 50, 90, 99)}
    found["count"] = np.int64(len(column))
    return {name: [found[name].item()] for name in found if name in wanted}


def main(
    dataset: Path,
    memory: Path,
    output: Path,
    field: Annotated[str, typer.Option(help="The column of readings, such as observation.tactile.")],
    contacts: Annotated[bool, typer.Option("--contacts", help="Find touches in each episode.")] = False,
) -> None:
    """Write a LeRobot data set anew with what a memory answers at each frame."""
    try:
        with TactileLearner.open(memory, mode="read") as learner:
            answers = annotate(learner, dataset, output, field, contacts=contacts)
    except (ScrollTactileError, OSError) as error:
        sys.exit(f"Error: {error}")
    print(f"written: {output}; {np.count_nonzero(answers[f'{PREFIX}material'] >= 0)} frames have an answer")


if __name__ == "__main__":
    typer.run(main)

"""A live session in the Rerun viewer: readings, contacts, answers as they grow, their novelty, and what was decided.

    pip install rerun-sdk                  # 0.32 or newer; start `rerun` in another terminal, then
    python -m examples.rerun_live memory readings.npy
    python stream.py | python -m examples.rerun_live memory - --to session.rrd

The readings are those of a recording (--field says where in it), or lines of comma-separated numbers as they come. --to
is the viewer that runs here, the address of another (rerun+http://robot:9876/proxy), or a new file that ends with .rrd.
"""

import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import typer

from scroll_tactile import TactileLearner
from scroll_tactile.errors import ScrollTactileError, printable
from scroll_tactile.live.answers import LiveState
from scroll_tactile.recordings import read
from scroll_tactile.results import Prediction
from scroll_tactile.signals.image import tactile_image

HERE = "rerun+http://127.0.0.1:9876/proxy"
DATES = 1e8  # seconds: larger times are dates, smaller ones count from some moment
SHOWN = 5  # likeliest materials of an answer


class SessionLog:
    """Writes to a stream of Rerun what a live session takes and says. camera: whether readings are pictures."""

    def __init__(self, stream: rr.RecordingStream, *, camera: bool = False) -> None:
        self.stream, self.camera, self.before = stream, camera, LiveState()
        self.names: set[str] = set()  # whose probabilities are shown, of the touch under way
        views: dict[str, Any] = {"readings": rrb.Spatial2DView if camera else rrb.TimeSeriesView}
        views |= dict.fromkeys(["contact", "answer/probability", "answer/novelty"], rrb.TimeSeriesView)
        views |= {"touch": rrb.TensorView, "events": rrb.TextLogView}
        stream.send_blueprint(rrb.Blueprint(rrb.Grid(*(kind(origin=f"/{path}") for path, kind in views.items()))))
        stream.log("contact", rr.SeriesLines(interpolation_mode="StepAfter"), static=True)

    def take(self, reading: Any, now: LiveState, at: float) -> None:
        """Show a reading, at a time in seconds, and what is new in the session's state after it."""
        self.at(at, "readings", rr.Image(np.uint8(np.clip(reading, 0, 255))) if self.camera else rr.Scalars(reading))
        for touch in now.touches:
            image, end = tactile_image(touch.stream), touch.at + touch.stream.seconds
            self.at(touch.at, "touch", rr.Tensor(image, dim_names=("channel", "time"), value_range=(-1, 1)))
            self.answer(touch.prediction, end)
            how = "revised" if touch.revised is not None else "decided" if touch.decided else "undecided"
            self.at(end, "events", in_words(f"touched for {touch.stream.seconds:.2f} s", touch.prediction, how))
            for path in ("answer/novelty", *map(probability_of, self.names)):
                self.at(end, path, rr.Scalars(math.nan))  # no line leads from one touch to the next
            self.names.clear()
        before = LiveState() if now.ended else self.before
        if now.contact != self.before.contact or now.ended:
            self.at(at, "contact", rr.Scalars(float(now.contact)))
        if now.contact and now.prediction is not None and now.prediction is not before.prediction:
            self.answer(now.prediction, at)
        if now.contact and now.decided and not before.decided and now.prediction is not None:
            self.at(at, "events", in_words(f"after {now.seconds:.2f} s", now.prediction, "decided"))
        self.before = now

    def answer(self, prediction: Prediction, at: float) -> None:
        """Show the probabilities of an answer, and its novelty."""
        self.names |= {name for name, _ in prediction.ranking[:SHOWN]}
        for name, probability in prediction.ranking:
            if name in self.names:
                self.at(at, probability_of(name), rr.Scalars(probability))
        self.at(at, "answer/novelty", rr.Scalars(prediction.novelty))

    def at(self, seconds: float, path: str, what: Any) -> None:
        """Write something at a time in seconds."""
        self.stream.set_time("time", **{"timestamp" if seconds > DATES else "duration": seconds})
        self.stream.log(path, what)


def probability_of(name: str) -> str:
    """The path of a material's probability; a name cannot leave its place in the tree."""
    return f"answer/probability/{rr.escape_entity_path_part(printable(name))}"


def in_words(when: str, prediction: Prediction, how: str) -> rr.TextLog:
    """An answer as a line of the log."""
    name = "never felt this" if prediction.known is False else printable(str(prediction.material))
    return rr.TextLog(f"{when}: {name}, {prediction.probability:.1%}, {how}")


def readings(source: str, field: str | None, rate: float) -> Iterator[tuple[float, Any]]:
    """Each reading with its time, of a recording or of lines on the standard input."""
    if source == "-":
        yield from ((count / rate, np.array(line.split(","), np.float64)) for count, line in enumerate(sys.stdin))
    else:
        recording = read(source, field=field, rate=rate)
        yield from zip(recording.times.tolist(), recording.readings, strict=True)


def main(memory: Path, source: str, to: str = HERE, field: str | None = None) -> None:
    """Show a live session of a memory in Rerun."""
    if to.endswith(".rrd") and Path(to).exists():
        sys.exit(f"Error: {to} is there already: give another file")
    stream = rr.RecordingStream("scroll-tactile")
    (stream.save if to.endswith(".rrd") else stream.connect_grpc)(to)
    try:
        with TactileLearner.open(memory, mode="read") as learner, learner.live() as session:
            log = SessionLog(stream, camera=learner.sensor.camera)
            for time, reading in readings(source, field, learner.sensor.rate):
                shaped = reading.reshape(learner.sensor.shape)
                log.take(shaped, session.push(shaped, time), time)
    except (ScrollTactileError, OSError) as error:
        sys.exit(f"Error: {error}")
    finally:
        stream.disconnect()


if __name__ == "__main__":
    typer.run(main)

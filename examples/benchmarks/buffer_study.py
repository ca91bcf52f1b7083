"""`scroll-tactile bench buffers`: what each way of choosing exemplars is worth, on recorded touches.

Beside the gap to the class means and the overlap of two schedules stands the accuracy of an f* fine-tuned on the
buffer, by itself: also where the learner would not let it answer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from examples.benchmarks.buffers import Buffer, compare
from examples.benchmarks.timing import circumstances
from scroll_tactile.datasets import Recordings
from scroll_tactile.embeddings import Embedding
from scroll_tactile.finetune.fine_tune import fine_tune
from scroll_tactile.finetune.network import TunedReader
from scroll_tactile.learner import TactileLearner
from scroll_tactile.memory.exemplars import Exemplar
from scroll_tactile.pipelines.classification import hold_out
from scroll_tactile.signals.image import tactile_image

__all__ = ["run_buffers"]

Note = Callable[[str], None]


def run_buffers(
    recordings: Recordings,
    embedding: Embedding,
    capacities: Sequence[int] = (100, 200, 400),
    *,
    seed: int = 0,
    note: Note = lambda _: None,
) -> dict[str, Any]:
    """Learn all folds but the first, choose buffers of these capacities in every way, and fine-tune on each.

    Returns circumstances and a list of records: capacity, way, gap, ratio to full herding's, overlap of two schedules,
    accuracy of f* by itself and of f, on the first fold.
    """
    lessons, exam = hold_out(recordings, recordings.fold == 0)
    learner = TactileLearner(sensor=recordings.sensor, embedding=embedding, exemplars=len(recordings))
    note("learning")
    for touch in lessons:
        learner.observe(*touch)
    assert learner.memory.exemplars is not None
    kept = list(learner.memory.exemplars)
    codes, keys = np.stack([one.code for one in kept]), [one.key for one in kept]
    f = float(np.mean([learner.predict(stream).material == name for name, stream in exam]))
    records = []
    for capacity in capacities:
        for way, choice in compare(codes, keys, [one.material for one in kept], capacity, seed).items():
            note(f"{capacity} exemplars, {way}: fine-tuning")
            records.append(
                {
                    "capacity": capacity,
                    "way": way,
                    "gap": choice.gap,
                    "ratio": choice.to_full,
                    "overlap": choice.shared,
                    "tuned": _tuned(learner, choice.buffer, kept, exam, seed),
                    "f": f,
                }
            )
    return {"bench": "buffers", "dataset": recordings.name, **circumstances(seed), "records": records}


def _tuned(
    learner: TactileLearner, buffer: Buffer, kept: Sequence[Exemplar], exam: Sequence[tuple[str, Any]], seed: int
) -> float:
    """Accuracy of an f* fine-tuned on a buffer, whether it would be kept or not."""
    of = {one.key: one for one in kept}
    exemplars = {name: [of[key] for key in those] for name, those in buffer.items()}
    tuned, _ = fine_tune(learner.embedding, learner.model(), exemplars, learner.sensor, seed=seed)
    reader = TunedReader(learner.embedding, learner.plan, tuned)
    right = []
    for name, stream in exam:
        logits = reader.logits(tactile_image(stream))
        right.append(max(logits, key=logits.__getitem__) == name)
    return float(np.mean(right))

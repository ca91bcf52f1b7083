"""From f to f*: training on the exemplars alone, from the closed form on; f* is used where it is clearly better.

As in SCROLL (Wang et al. 2022, arXiv 2210.05561) f* restarts each time from the pre-trained weights with its head set
from the readout, and is trained by cross-entropy on the buffer only. Small buffers train residual adapters (Li et al.
2022, arXiv 2107.00358), a 1 × 1 convolution beside each 3 × 3 one, and the head; larger ones the whole network. How
long to train, and whether f* is used at all, is decided on three folds of the buffer: a fold is taken out of the
statistics, exactly, and every exemplar in it is classified by an f, and by an f* that began from that f, that never saw
it. The temperature is learned there, too: on touches that f was solved from it would only sharpen what is certain
already.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import logsumexp

from scroll_tactile.embeddings.protocol import Embedding
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.network import TouchFeatures, TrainingSample
from scroll_tactile.finetune.training import (
    FOLDS,
    Progress,
    Trained,
    Trainer,
    named_out_of_memory,
    repeatable,
    start_of,
)
from scroll_tactile.libraries import optional
from scroll_tactile.memory.exemplars import Exemplar
from scroll_tactile.memory.tuned import Tuned, TuneMode, TuneReport
from scroll_tactile.persistence.replaying import ranked_exemplars
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.model import Model
from scroll_tactile.prediction.predictor import Predictor
from scroll_tactile.statistics.statistics import Statistics

with optional("torch", "torch", "a fine-tune"):
    import torch

__all__ = ["EPOCHS", "WHOLE_NETWORK_FROM", "fine_tune", "fine_tune_memory"]

FloatArray = npt.NDArray[np.float64]

EPOCHS = 8
# Exemplars from which the whole network is trained. With RoboSkin's 400 its best held-out log loss was 0.148 (rate
# 3e-6; 0.154 with 3e-7) and adapters' 0.151, but by itself it had 96.0 % on the touches of the test, adapters 98.5 like
# f. So it begins beyond what the recorded sets can show.
WHOLE_NETWORK_FROM = 2000
# Of mean log loss, in nats: where f is all but certain already, f* can be so by a billionth more, and mean nothing.
LEAST_GAIN = 1e-3
# Standard errors that f* has to be better by: epoch and temperature were chosen as the best of hundreds on these same
# exemplars. With one, two of thirty buffers of RoboSkin kept an f* that lost half a point and one and a half.
CLEARLY = 2.0
TEMPERATURES = np.exp(np.linspace(-2.0, 2.0, 81))


def fine_tune(
    embedding: Embedding,
    model: Model,
    statistics: Statistics,
    exemplars: Mapping[str, Sequence[Exemplar]],
    extractor: FeatureExtractor,
    *,
    epochs: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    mode: TuneMode | None = None,
    progress: Progress = lambda what, done, of: None,
) -> tuple[Tuned, TuneReport]:
    """Fine-tune on exemplars; the same arguments give the same bytes on the same device.

    model: of the memory that the exemplars come from. statistics: a copy of that memory's. extractor: as the exemplars
    were observed with. epochs: the most, `EPOCHS` unless given; fewer are taken where
    the exemplars held out say so. device: torch's name of one. mode: what to train; by the number of exemplars unless
    given.

    Raises InputError for fewer than two materials, no exemplar long enough for the widest scale, or settings that
    cannot be; FineTuneError where the loss is not finite or the device is out of memory.
    """
    begun = time.perf_counter()
    most = EPOCHS if epochs is None else epochs
    _require_settings(most, seed, device, exemplars, model.names)
    touches = TouchFeatures(embedding, model.plan)
    samples = list(_samples(touches, model, exemplars, extractor, progress))
    names = sorted({sample.material for sample in samples})
    if len(names) < 2:
        raise InputError(
            f"expected exemplars of at least two materials of {model.plan.milestones()[-1]} columns or more; there "
            f"are some of {names}. Observe longer touches, or more materials"
        )
    chosen = mode or _mode(touches, len(samples))
    with repeatable(device), named_out_of_memory(device):
        spreads = touches.spreads(samples)
        trainer = Trainer(touches, spreads, most, seed, torch.device(device), chosen, progress)
        best, temperature, scores = _best(*trainer.held_out(model, statistics, samples), most)
        progress("training", 0, best)
        final = trainer.train(start_of(model, names), samples, [], best, salt=FOLDS)
    kept, reason = _verdict(scores)
    heads = {scale: head * temperature for scale, head in final.heads.items()}
    tuned = Tuned(names, heads, final.bias * temperature, final.network, chosen, kept)
    report = TuneReport(kept, reason, chosen, len(samples), best, scores, time.perf_counter() - begun, tuned.digest())
    return replace(tuned, report=Tuned.described(report)), report


def fine_tune_memory(
    predictor: Predictor, *, epochs: int | None, seed: int, device: str, progress: Progress
) -> TuneReport:
    """Fine-tune on a memory's exemplars, and keep what came of it; raises as `TactileLearner.fine_tune`."""
    extractor, ledger = predictor.extractor.verified(), predictor.ledger
    with ledger.lock:
        ledger.require_writing()
        memory = ledger.memory
        model, ranked = predictor.fitted(), ranked_exemplars(memory, ledger.store)
        last_sequence, retractions = memory.sequence, memory.retractions
        statistics = copy.deepcopy(memory.statistics)
    how: dict[str, Any] = {"epochs": epochs, "seed": seed, "device": device, "progress": progress}
    tuned, report = fine_tune(predictor.recipe.embedding, model, statistics, ranked, extractor, **how)
    ledger.keep_tuned(tuned, memory, last_sequence, retractions)
    return report


def _require_settings(
    epochs: int, seed: int, device: str, exemplars: Mapping[str, Sequence[Exemplar]], names: Sequence[str]
) -> None:
    for what, number, least in (("epochs", epochs, 1), ("seed", seed, 0)):
        if isinstance(number, bool) or not isinstance(number, int) or number < least:
            raise InputError(f"expected {what} as a whole number of {least} or more; came {number!r}")
    if sum(map(len, exemplars.values())) == 0:
        raise InputError("expected exemplars to fine-tune on; the buffer is empty. Open a memory with exemplars > 0")
    if without := sorted(set(names) - set(exemplars)):
        raise InputError(
            f"expected an exemplar of every material; the buffer has none of {without[:10]}. Make a new memory with "
            f"exemplars={len(names)} or more, or touch again what was observed before exemplars were kept"
        )
    if len(exemplars) < 2:
        raise InputError(f"expected at least two materials; the buffer has exemplars of {list(exemplars)} only")
    try:
        torch.zeros(1, dtype=torch.float64, device=torch.device(device)).item()
    except (RuntimeError, AssertionError, TypeError) as error:
        raise InputError(
            f"expected a device of torch's that computes in float64, such as cpu or cuda; came {device!r}: {error}"
        ) from error


def _mode(touches: TouchFeatures, count: int) -> TuneMode:
    if not touches.tunable:
        return "head"
    return "adapters" if count < WHOLE_NETWORK_FROM else "network"


def _samples(
    touches: TouchFeatures,
    model: Model,
    exemplars: Mapping[str, Sequence[Exemplar]],
    extractor: FeatureExtractor,
    progress: Progress,
) -> Iterator[TrainingSample]:
    """The exemplars that reach the last stage, by material and rank."""
    if len(model.calibrations) < len(model.stages):  # nothing was observed for long enough
        return
    known = {name for name in model.names if all(name in model.readouts[s].places for s in model.stages[-1])}
    total, done = sum(map(len, exemplars.values())), 0
    for material, buffered in sorted(exemplars.items()):
        for exemplar in buffered:
            image = extractor.image(extractor.stream(exemplar.readings))
            columns = image.shape[1]
            if material in known and model.is_last(columns) and touches.reads(columns):
                codes = extractor.codes(image)
                yield TrainingSample(material, exemplar.key, image, touches.frozen(image), codes)
            done += 1
            progress("reading exemplars", done, total)


@dataclass(frozen=True)
class _Score:
    """Mean log loss at the best temperature, and share of wrong answers, of logits held out; each touch's loss."""

    loss: float
    wrong: float
    temperature: float
    losses: FloatArray

    @classmethod
    def of(cls, folds: Sequence[tuple[FloatArray, npt.NDArray[np.intp]]], temperatures: FloatArray) -> _Score:
        losses = np.concatenate([_losses(logits, targets, temperatures) for logits, targets in folds], axis=1)
        wrong = sum(int((logits.argmax(axis=1) != targets).sum()) for logits, targets in folds)
        best = int(np.argmin(losses.mean(axis=1)))
        return cls(float(losses[best].mean()), wrong / losses.shape[1], float(temperatures[best]), losses[best])


def _losses(logits: FloatArray, targets: npt.NDArray[np.intp], temperatures: FloatArray) -> FloatArray:
    """Log loss (temperatures, touches)."""
    heated = temperatures[:, None, None] * logits
    losses: FloatArray = logsumexp(heated, axis=2) - heated[:, np.arange(len(targets)), targets]
    return losses


def _best(trials: list[Trained], before: list[Trained], most: int) -> tuple[int, float, dict[str, dict[str, float]]]:
    """The number of epochs and the temperature of least held-out loss, and what f and f* come to there."""
    if not trials:
        return most, 1.0, {}
    f = _Score.of([(trial.logits[0], trial.targets) for trial in before], TEMPERATURES)
    epochs = [
        _Score.of([(trial.logits[i], trial.targets) for trial in trials], TEMPERATURES)
        for i in range(len(trials[0].logits))
    ]
    best = min(range(len(epochs)), key=lambda i: epochs[i].loss)
    scores = {name: {"loss": score.loss, "wrong": score.wrong} for name, score in (("f", f), ("f*", epochs[best]))}
    gain = f.losses - epochs[best].losses
    scores["f*"]["margin"] = float(gain.std() / np.sqrt(len(gain)))
    return best + 1, epochs[best].temperature, scores


def _verdict(scores: Mapping[str, Mapping[str, float]]) -> tuple[bool, str]:
    if not scores:
        return False, "no exemplar could be held out to compare them: f answers"
    f, tuned = scores["f"], scores["f*"]
    figures = (
        f"log loss {tuned['loss']:.4f} against {f['loss']:.4f}, wrong {tuned['wrong']:.2%} against {f['wrong']:.2%}"
    )
    if tuned["wrong"] > f["wrong"] or tuned["loss"] + max(CLEARLY * tuned["margin"], LEAST_GAIN) >= f["loss"]:
        return False, f"on exemplars held out f* is not better than f ({figures}): f answers"
    return True, f"on exemplars held out f* is better than f ({figures})"

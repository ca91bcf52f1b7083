"""From f to f*: a pass over the exemplars alone that starts from the closed form and ends no worse than it.

As in SCROLL (Wang et al. 2022, arXiv 2210.05561) f* restarts each time from the pre-trained weights with its head set
from the readout, and is trained by cross-entropy on the buffer only. Small buffers train
residual adapters (Li et al. 2022, arXiv 2107.00358), a 1 × 1 convolution beside each 3 × 3 one, and the head; larger
ones the whole network. How long to train, and whether f* is used at all, is decided on the buffer's own folds: every
exemplar is answered by an f* whose training did not see it, and which began from a readout that did not either. On
these the temperature is learned, too: learned where f has been solved it only sharpens what is certain already.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.special import logsumexp
from torch import nn
from torch.nn import functional

from scroll_tactile.augment import Augmentation
from scroll_tactile.embeddings import Embedding
from scroll_tactile.embeddings.kernels import one_torch_thread
from scroll_tactile.errors import FineTuneError, InputError
from scroll_tactile.exemplars import Exemplar
from scroll_tactile.images import tactile_image
from scroll_tactile.model import Model
from scroll_tactile.ridge.codes import BITS
from scroll_tactile.ridge.readouts import Readout
from scroll_tactile.ridge.statistics import FOLDS, fold_of
from scroll_tactile.sensors import Sensor
from scroll_tactile.streams import validate
from scroll_tactile.tuned import Tuned, TuneMode, TuneReport
from scroll_tactile.tuning import Backbone, Lesson, TouchFeatures, adapted

__all__ = ["EPOCHS", "WHOLE_NETWORK_FROM", "fine_tune"]

FloatArray = npt.NDArray[np.float64]
Progress = Callable[[str, int, int], object]

EPOCHS = 8
BATCH = 32
# Exemplars from which the whole network is trained. With 400 it lost more than adapters (RoboSkin, rates of 3e-5: 96.0
# to 97.5 % where f has 99.0, adapters 97.5 to 99.5), so it begins beyond what the recorded sets can show.
WHOLE_NETWORK_FROM = 2000
# Larger rates train faster away from what f has solved: on RoboSkin's exemplars held out f is wrong on 4.3 %, f* on
# 5.5 to 6.3 % with rates of 2e-5 to 2e-4 and on 12.8 % with 5e-4.
RATES: dict[TuneMode, float] = {"head": 0.0, "adapters": 5e-5, "network": 3e-6}
HEAD_RATE = 3e-5  # in units of a feature's spread
# A tenth of the touches is augmented, gently: at the strengths of offline training, where nothing else is known, f*
# lost 2 to 3 points on clean touches more.
AUGMENTED = 0.1
AUGMENTATION = Augmentation(flip=0.05, speed=(0.97, 1.03), keep=0.97, noise=0.002, drift=0.002)
TEMPERATURES = np.exp(np.linspace(-2.0, 2.0, 81))


@dataclass(frozen=True)
class _Start:
    """Where training starts from: a linear readout of mean features, in the order of `names`."""

    names: list[str]
    heads: dict[int, FloatArray]
    bias: FloatArray


@dataclass
class _Trained:
    """One training: logits (touches, C) of the exemplars held out after every epoch, and its state after the last.

    targets: the places of their materials among the C.
    """

    logits: list[FloatArray]
    targets: npt.NDArray[np.intp]
    heads: dict[int, FloatArray]
    bias: FloatArray
    network: dict[str, npt.NDArray[np.float32]]


def fine_tune(
    embedding: Embedding,
    model: Model,
    exemplars: Mapping[str, Sequence[Exemplar]],
    sensor: Sensor,
    *,
    epochs: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    mode: TuneMode | None = None,
    progress: Progress = lambda what, done, of: None,
) -> tuple[Tuned, TuneReport]:
    """Fine-tune on exemplars; the same arguments give the same bytes on the same device.

    model: of the memory that the exemplars come from. epochs: the most, `EPOCHS` unless given; fewer are taken where
    the exemplars held out say so. device: torch's name of one. mode: what to train; by the number of exemplars unless
    given.

    Raises InputError for fewer than two materials, no exemplar long enough for the widest scale, or settings that
    cannot be; FineTuneError where the loss is not finite or the device is out of memory.
    """
    begun = time.perf_counter()
    most = EPOCHS if epochs is None else epochs
    _require_settings(most, seed, device, exemplars)
    touches = TouchFeatures(embedding, model.reading)
    lessons = list(_lessons(touches, model, exemplars, sensor, progress))
    names = sorted({lesson.material for lesson in lessons})
    if len(names) < 2:
        raise InputError(
            f"expected exemplars of at least two materials of {model.reading.milestones()[-1]} columns or more; there "
            f"are some of {names}. Observe longer touches, or more materials"
        )
    chosen = mode or _mode(touches, len(lessons))
    with _repeatable(device):
        spreads = touches.spreads(lessons)
        trainer = _Trainer(touches, spreads, most, seed, torch.device(device), chosen, progress)
        best, temperature, scores = _best(*trainer.held_out(model, lessons), most)
        progress("training", 0, best)
        final = trainer.train(_start(model, names), lessons, [], best, salt=FOLDS)
    kept, reason = _verdict(scores)
    heads = {scale: head * temperature for scale, head in final.heads.items()}
    tuned = Tuned(names, heads, final.bias * temperature, final.network, chosen, kept)
    report = TuneReport(kept, reason, chosen, len(lessons), best, scores, time.perf_counter() - begun, tuned.digest())
    return replace(tuned, report=Tuned.described(report)), report


def _require_settings(epochs: int, seed: int, device: str, exemplars: Mapping[str, Sequence[Exemplar]]) -> None:
    if epochs < 1 or seed < 0:
        raise InputError(f"expected 1 epoch or more and a seed of 0 or more; came {epochs} and {seed}")
    if sum(map(len, exemplars.values())) == 0:
        raise InputError("expected exemplars to fine-tune on; the buffer is empty. Open the memory with exemplars > 0")
    if len(exemplars) < 2:
        raise InputError(
            f"expected at least two materials, to be told apart; the buffer has exemplars of {list(exemplars)} only"
        )
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"expected a device that torch can use, such as cpu; came {device!r}: {error}") from error


def _mode(touches: TouchFeatures, count: int) -> TuneMode:
    if not touches.tunable:
        return "head"
    return "adapters" if count < WHOLE_NETWORK_FROM else "network"


def _lessons(
    touches: TouchFeatures,
    model: Model,
    exemplars: Mapping[str, Sequence[Exemplar]],
    sensor: Sensor,
    progress: Progress,
) -> Iterator[Lesson]:
    """The exemplars that reach the last stage, by material and rank."""
    felt = {name for name in model.names if all(name in model.selections[s].places for s in model.stages[-1])}
    total, done = sum(map(len, exemplars.values())), 0
    for material, those in sorted(exemplars.items()):
        for one in those:
            image = tactile_image(validate(one.readings, sensor))
            columns = image.shape[1]
            if material in felt and len(model.reading.stages(columns)) == len(model.stages):
                yield Lesson(material, one.key, image, touches.frozen(image))
            done += 1
            progress("reading exemplars", done, total)


def _start(model: Model, names: Sequence[str], fold: int | None = None) -> _Start:
    """f's own readout at the last stage as one linear head; of the other folds where one is held out."""
    heads, bias = {}, np.zeros(len(names))
    for scale, weight in zip(model.stages[-1], model.calibrations[-1].weights, strict=True):
        selection = model.selections[scale]
        known = list(selection.names)
        readout: Readout = selection.readout
        if fold is not None:
            places, readout = selection.held_out[fold]
            known = [selection.names[at] for at in places]
        at = [known.index(name) for name in names]
        mixing = np.eye(len(known)) if model.kind == "lda" else readout.ridge
        slopes = readout.weights @ mixing[:, at]
        offset = readout.scores(np.zeros(len(known)), model.kind)[at]
        heads[scale] = weight * slopes * 2.0**BITS
        bias += weight * (offset - readout.center @ slopes)
    return _Start(list(names), heads, bias)


def _held_names(model: Model, fold: int, names: Sequence[str]) -> list[str]:
    """Those of the names that the readouts of the other folds know."""
    known = set(names)
    for scale in model.stages[-1]:
        selection = model.selections[scale]
        if fold not in selection.held_out:
            return []
        known &= {selection.names[at] for at in selection.held_out[fold][0]}
    return sorted(known)


@dataclass(frozen=True)
class _Score:
    """Mean log loss at the best temperature, and share of wrong answers, of logits held out."""

    loss: float
    wrong: float
    temperature: float

    @classmethod
    def of(cls, folds: Sequence[tuple[FloatArray, npt.NDArray[np.intp]]], temperatures: FloatArray) -> _Score:
        count = sum(len(targets) for _, targets in folds)
        losses = np.zeros(len(temperatures))
        wrong = 0
        for logits, targets in folds:
            heated = temperatures[:, None, None] * logits
            losses += (logsumexp(heated, axis=2) - heated[:, np.arange(len(targets)), targets]).sum(axis=1)
            wrong += int((logits.argmax(axis=1) != targets).sum())
        best = int(np.argmin(losses))
        return cls(float(losses[best]) / count, wrong / count, float(temperatures[best]))


def _best(trials: list[_Trained], before: list[_Trained], most: int) -> tuple[int, float, dict[str, dict[str, float]]]:
    """The number of epochs and the temperature of least held-out loss, and what f and f* come to there."""
    if not trials:
        return most, 1.0, {}
    f = _Score.of([(trial.logits[0], trial.targets) for trial in before], TEMPERATURES)
    epochs = [
        _Score.of([(trial.logits[at], trial.targets) for trial in trials], TEMPERATURES)
        for at in range(len(trials[0].logits))
    ]
    best = min(range(len(epochs)), key=lambda at: epochs[at].loss)
    scores = {name: {"loss": one.loss, "wrong": one.wrong} for name, one in (("f", f), ("f*", epochs[best]))}
    return best + 1, epochs[best].temperature, scores


def _verdict(scores: Mapping[str, Mapping[str, float]]) -> tuple[bool, str]:
    if not scores:
        return False, "no exemplar could be held out to compare them: f answers"
    f, tuned = scores["f"], scores["f*"]
    told = f"log loss {tuned['loss']:.4f} against {f['loss']:.4f}, wrong {tuned['wrong']:.2%} against {f['wrong']:.2%}"
    if tuned["wrong"] > f["wrong"] or tuned["loss"] >= f["loss"]:
        return False, f"on exemplars held out f* is not better than f ({told}): f answers"
    return True, f"on exemplars held out f* is better than f ({told})"


@contextmanager
def _repeatable(device: str) -> Iterator[None]:
    """One thread, no shortened floats, no algorithm whose sums depend on timing."""
    with ExitStack() as stack:
        stack.enter_context(one_torch_thread())
        stack.enter_context(torch.autocast(torch.device(device).type, enabled=False))
        stack.enter_context(torch.backends.cudnn.flags(deterministic=True, benchmark=False, allow_tf32=False))
        yield


class _Trainer:
    """Trainings of one fine-tune: they differ in what is held out."""

    def __init__(
        self,
        touches: TouchFeatures,
        spreads: Mapping[int, FloatArray],
        epochs: int,
        seed: int,
        device: torch.device,
        mode: TuneMode,
        progress: Progress,
    ) -> None:
        self.touches = touches
        self.spreads = spreads
        self.epochs = epochs
        self.seed = seed
        self.device = device
        self.mode = mode
        self.progress = progress

    def held_out(self, model: Model, lessons: list[Lesson]) -> tuple[list[_Trained], list[_Trained]]:
        """For each fold what training on the others gives for it, and what f gives."""
        trials, before = [], []
        names = sorted({lesson.material for lesson in lessons})
        for fold in range(FOLDS):
            known = _held_names(model, fold, names)
            taught = [one for one in lessons if fold_of(one.key) != fold and one.material in known]
            exam = [one for one in lessons if fold_of(one.key) == fold and one.material in known]
            if len(known) < 2 or not taught or not exam:
                continue
            start = _start(model, known, fold)
            head = _Head(start, self.spreads).to(self.device)
            before.append(_Trained([self._judge(head, None, exam)], _targets(head, exam), {}, start.bias, {}))
            what = f"held out {fold + 1}/{FOLDS}"
            trials.append(self.train(start, taught, exam, self.epochs, salt=fold, what=what))
        return trials, before

    def train(
        self,
        start: _Start,
        taught: list[Lesson],
        exam: list[Lesson],
        until: int,
        *,
        salt: int,
        what: str = "training",
    ) -> _Trained:
        """Train for `until` epochs of a schedule of `epochs`, and judge the exam after each."""
        random = np.random.default_rng([self.seed, salt])
        head = _Head(start, self.spreads).to(self.device)
        net = None if self.mode == "head" else self._network()
        optimiser, schedule = self._optimiser(head, net, -(-len(taught) // BATCH) * self.epochs)
        logits = []
        for epoch in range(until):
            order = random.permutation(len(taught))
            for first in range(0, len(order), BATCH):
                batch = [self._augmented(taught[at], random) for at in order[first : first + BATCH]]
                self._step(head, net, batch, optimiser, f"{what}, epoch {epoch + 1}")
                schedule.step()
            if exam:
                logits.append(self._judge(head, net, exam))
            self.progress(what, epoch + 1, until)
        heads, bias = head.arrays()
        network = {} if net is None else net.tensors()
        if not all(np.isfinite(array).all() for array in (bias, *heads.values(), *network.values())):
            raise FineTuneError(f"the weights are not finite after {what}: nothing was changed; take another seed")
        return _Trained(logits, _targets(head, exam), heads, bias, network)

    def _network(self) -> Backbone:
        net = adapted(self.touches.network()) if self.mode == "adapters" else self.touches.network()
        return net.to(self.device)

    def _optimiser(
        self, head: _Head, net: Backbone | None, steps: int
    ) -> tuple[torch.optim.Optimizer, torch.optim.lr_scheduler.LRScheduler]:
        groups: list[dict[str, Any]] = [
            {"params": [*head.changes.values()], "lr": HEAD_RATE},
            {"params": [head.offset], "lr": HEAD_RATE},
        ]
        if net is not None:
            groups.append({"params": [p for p in net.parameters() if p.requires_grad], "lr": RATES[self.mode]})
        optimiser = torch.optim.AdamW(groups, weight_decay=0.0)
        return optimiser, torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)

    def _augmented(self, lesson: Lesson, random: np.random.Generator) -> Lesson:
        if random.random() >= AUGMENTED:
            return lesson
        image = AUGMENTATION.augment(lesson.image, random, columns=lesson.image.shape[1])
        return Lesson(lesson.material, lesson.key, image, self.touches.frozen(image))

    def _step(
        self, head: _Head, net: Backbone | None, batch: list[Lesson], optimiser: torch.optim.Optimizer, where: str
    ) -> None:
        targets = torch.from_numpy(_targets(head, batch)).to(self.device)
        try:
            loss = functional.cross_entropy(head(self.touches.means(net, batch, self.device)), targets)
            value = float(loss.detach())
            if not np.isfinite(value):
                raise FineTuneError(
                    f"the loss became {value} in {where}: nothing was changed, and the f* before stays. Are the "
                    "exemplars' readings sound? Another seed, or fewer epochs, may do"
                )
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
        except torch.OutOfMemoryError as error:
            raise FineTuneError(
                f"{self.device} is out of memory in {where}: nothing was changed, and the f* before stays. Free some, "
                f"or take device='cpu' ({error})"
            ) from error
        optimiser.step()

    def _judge(self, head: _Head, net: Backbone | None, exam: list[Lesson]) -> FloatArray:
        """Logits (touches, C)."""
        with torch.no_grad():
            parts = [
                head(self.touches.means(net, exam[first : first + BATCH], self.device))
                for first in range(0, len(exam), BATCH)
            ]
        logits: FloatArray = torch.cat(parts).cpu().numpy()
        return logits


def _targets(head: _Head, lessons: Sequence[Lesson]) -> npt.NDArray[np.intp]:
    return np.array([head.names.index(one.material) for one in lessons], dtype=np.intp)


class _Head(nn.Module):
    """f's readout, with changes to be learned in units of the features' spread."""

    def __init__(self, start: _Start, spreads: Mapping[int, FloatArray]) -> None:
        super().__init__()
        self.names = start.names
        self.scales = sorted(start.heads)
        self.bases: dict[int, torch.Tensor] = {}
        self.spreads: dict[int, torch.Tensor] = {}
        self.changes = nn.ParameterDict()
        for scale in self.scales:
            self.bases[scale] = torch.from_numpy(start.heads[scale])
            self.spreads[scale] = torch.from_numpy(1.0 / spreads[scale])[:, None]
            self.changes[str(scale)] = nn.Parameter(torch.zeros(start.heads[scale].shape, dtype=torch.float64))
        self.bias = torch.from_numpy(start.bias)
        self.offset = nn.Parameter(torch.zeros(len(start.names), dtype=torch.float64))

    def weights(self, scale: int) -> torch.Tensor:
        """The weights of a scale, (d, C), before the temperature."""
        change = self.changes[str(scale)]
        weights: torch.Tensor = self.bases[scale].to(change.device) + self.spreads[scale].to(change.device) * change
        return weights

    def forward(self, means: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """Logits (B, C) of mean features by scale, each (B, d)."""
        logits: torch.Tensor = self.bias.to(self.offset.device) + self.offset
        for scale in self.scales:
            logits = logits + means[scale] @ self.weights(scale)
        return logits

    def arrays(self) -> tuple[dict[int, FloatArray], FloatArray]:
        """The weights by scale and the bias."""
        with torch.no_grad():
            heads = {scale: self.weights(scale).cpu().numpy() for scale in self.scales}
            return heads, (self.bias.to(self.offset.device) + self.offset).cpu().numpy()

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import logsumexp

from scroll_tactile.embeddings.protocol import Embedding
from scroll_tactile.embeddings.steady import full_float32, one_torch_thread
from scroll_tactile.errors import FineTuneError, InputError
from scroll_tactile.finetune.network import Backbone, TouchFeatures, TrainingSample, adapted
from scroll_tactile.libraries import optional
from scroll_tactile.memory.exemplars import Exemplar
from scroll_tactile.memory.tuned import Tuned, TuneMode, TuneReport
from scroll_tactile.persistence.replaying import ranked_exemplars
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.prediction.model import Model
from scroll_tactile.prediction.predictor import Predictor
from scroll_tactile.readouts.readout import Readout
from scroll_tactile.readouts.task import Task
from scroll_tactile.signals.augmentation import Augmentation
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.grid import BITS
from scroll_tactile.statistics.statistics import Statistics

with optional("torch", "torch", "a fine-tune"):
    import torch
    from torch import nn
    from torch.nn import functional

__all__ = ["EPOCHS", "WHOLE_NETWORK_FROM", "Progress", "fine_tune", "fine_tune_memory"]

FloatArray = npt.NDArray[np.float64]
Progress = Callable[[str, int, int], object]

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
FOLDS = 3  # of the exemplars
BATCH = 32
# Larger rates train faster away from what f has solved. Held out, with 400 exemplars of RoboSkin, f's log loss is
# 0.171; f*'s is 0.151 with adapters' rates of 5e-6 and 5e-5, 0.159 with 1e-6. BioTac tells them apart: f 0.060, f*
# 0.060 at 5e-6 and 0.073 at 5e-5, which had 92.0 % on the touches of the test where f has 99.5.
RATES: dict[TuneMode, float] = {"adapters": 5e-6, "network": 3e-6}
HEAD_RATE = 3e-5  # in units of a feature's spread
# A tenth of the touches is augmented, gently: at the strengths of offline training, where nothing else is known, f*
# lost 2 to 3 points on clean touches more.
AUGMENTED = 0.1
AUGMENTATION = Augmentation(flip=0.05, speed=(0.97, 1.03), keep=0.97, noise=0.002, drift=0.002)


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
    progress: Progress = lambda what, done, of: None,
) -> tuple[Tuned, TuneReport]:
    """Fine-tune on exemplars; the same arguments give the same bytes on the same device.

    model: of the memory that the exemplars come from. statistics: a copy of that memory's. extractor: as the exemplars
    were observed with. epochs: the most, `EPOCHS` unless given; fewer are taken where the exemplars held out say so.
    device: torch's name of one.

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
    trained: TuneMode = "adapters" if len(samples) < WHOLE_NETWORK_FROM else "network"
    chosen: TuneMode = trained if touches.tunable else "head"
    with repeatable(device), named_out_of_memory(device):
        spreads = touches.spreads(samples)
        trainer = Trainer(touches, spreads, most, seed, torch.device(device), chosen, progress)
        best, temperature, scores = _best(*trainer.held_out(model, statistics, samples), most)
        progress("training", 0, best)
        final = trainer.train(start_of(model, names), samples, [], best, salt=FOLDS)
    kept, reason = _verdict(scores)
    heads = {scale: head * temperature for scale, head in final.heads.items()}
    tuned = Tuned(
        names=names, heads=heads, bias=final.bias * temperature, network=final.network, mode=chosen, kept=kept
    )
    report = TuneReport(
        kept=kept,
        reason=reason,
        mode=chosen,
        exemplars=len(samples),
        epochs=best,
        held_out=scores,
        seconds=time.perf_counter() - begun,
        digest=tuned.digest(),
    )
    return replace(tuned, report={k: own for k, own in vars(report).items() if k not in ("seconds", "digest")}), report


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
    tuned, report = fine_tune(
        predictor.recipe.embedding,
        model,
        statistics,
        ranked,
        extractor,
        epochs=epochs,
        seed=seed,
        device=device,
        progress=progress,
    )
    ledger.keep_tuned(tuned, last_sequence, retractions)
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
    try:
        torch.zeros(1, dtype=torch.float64, device=torch.device(device)).item()
    except (RuntimeError, AssertionError, TypeError) as error:
        raise InputError(
            f"expected a device of torch's that computes in float64, such as cpu or cuda; came {device!r}: {error}"
        ) from error


def _samples(
    touches: TouchFeatures,
    model: Model,
    exemplars: Mapping[str, Sequence[Exemplar]],
    extractor: FeatureExtractor,
    progress: Progress,
) -> Iterator[TrainingSample]:
    """The exemplars that reach the last stage, by material and rank."""
    if len(model.fitted.rows) < len(model.stages):  # nothing was observed for long enough
        return
    known = {name for name in model.names if all(name in model.readouts[s].places for s in model.stages[-1])}
    buffered = [(name, exemplar) for name in sorted(exemplars) for exemplar in exemplars[name]]
    for done, (material, exemplar) in enumerate(buffered, start=1):
        image = extractor.image(extractor.stream(exemplar.readings))
        columns = image.shape[1]
        if material in known and model.is_last(columns) and touches.reads(columns):
            yield TrainingSample(material, exemplar.key, image, touches.frozen(image), extractor.codes(image))
        progress("reading exemplars", done, len(buffered))


@dataclass(frozen=True)
class _Score:
    """Mean log loss at the best temperature, and share of wrong answers, of logits held out; each touch's loss."""

    loss: float
    wrong: float
    temperature: float
    losses: FloatArray

    @classmethod
    def of(cls, folds: Sequence[tuple[FloatArray, npt.NDArray[np.intp]]]) -> _Score:
        losses = np.concatenate([_losses(logits, targets) for logits, targets in folds], axis=1)
        wrong = sum(int((logits.argmax(axis=1) != targets).sum()) for logits, targets in folds)
        best = int(np.argmin(losses.mean(axis=1)))
        return cls(float(losses[best].mean()), wrong / losses.shape[1], float(TEMPERATURES[best]), losses[best])


def _losses(logits: FloatArray, targets: npt.NDArray[np.intp]) -> FloatArray:
    """Log loss (temperatures, touches)."""
    heated = TEMPERATURES[:, None, None] * logits
    return np.asarray(logsumexp(heated, axis=2) - heated[:, np.arange(len(targets)), targets])


def _best(trials: list[Trained], before: list[Trained], most: int) -> tuple[int, float, dict[str, dict[str, float]]]:
    """The number of epochs and the temperature of least held-out loss, and what f and f* come to there."""
    if not trials:
        return most, 1.0, {}
    f = _Score.of([(trial.logits[0], trial.targets) for trial in before])
    epochs = [_Score.of([(trial.logits[i], trial.targets) for trial in trials]) for i in range(len(trials[0].logits))]
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


@dataclass(frozen=True)
class Start:
    """Where training starts from: a linear readout of mean features, in the order of `names`."""

    names: list[str]
    heads: dict[int, FloatArray]
    bias: FloatArray


@dataclass
class Trained:
    """The result of a training.

    logits: (touches, C) of the exemplars held out, after every epoch. targets: the places of their materials among the
    C. heads, bias, network: as in `Tuned`, after the last epoch.
    """

    logits: list[FloatArray]
    targets: npt.NDArray[np.intp]
    heads: dict[int, FloatArray]
    bias: FloatArray
    network: dict[str, npt.NDArray[np.float32]]


def start_of(model: Model, names: Sequence[str], readouts: Mapping[Scale, Readout] | None = None) -> Start:
    """f's own readouts at the last stage as one linear head; or others in their place."""
    heads, bias = {}, np.zeros(len(names))
    for scale, weight in zip(model.stages[-1], model.fitted.rows[-1].calibration.weights, strict=True):
        readout = (readouts or model.readouts)[scale]
        slopes, offsets = readout.linear(names, model.kind)
        heads[scale.width] = np.ascontiguousarray(weight * slopes * 2.0**BITS)  # as it will lie when it is read again
        bias += weight * (offsets - readout.origin @ slopes)
    return Start(list(names), heads, bias)


def start_without(
    model: Model, statistics: Statistics, samples: Sequence[TrainingSample], names: Sequence[str]
) -> Start:
    """The head that f would be had it never observed some samples; of those of the names that it would know then.

    statistics: of the memory; they are as before when this returns.
    """
    for sample in samples:
        statistics.remove(sample.material, sample.codes, sample.image.shape[1])
    scales = model.stages[-1]
    known = sorted(set(names).intersection(*(statistics.names(scale) for scale in scales)))
    if len(known) < 2:
        start = Start(known, {}, np.zeros(len(known)))
    else:
        reference = names if model.kind == "lda" else list(statistics.materials)
        readouts = {scale: Task.of(statistics, scale, reference).solve() for scale in scales}
        start = start_of(model, known, readouts)
    for sample in samples:
        statistics.add(sample.material, sample.codes, sample.image.shape[1])
    return start


def fold_of(key: bytes) -> int:
    """The fold of an exemplar, from its content hash: the same wherever and whenever it was observed."""
    return int.from_bytes(key[:8], "little") % FOLDS


@contextmanager
def repeatable(device: str) -> Iterator[None]:
    """One thread, no shortened floats, no algorithm whose sums depend on timing."""
    with (
        one_torch_thread(),
        full_float32(),
        torch.autocast(torch.device(device).type, enabled=False),
        torch.backends.cudnn.flags(deterministic=True, benchmark=False, allow_tf32=False),
    ):
        yield


@contextmanager
def named_out_of_memory(device: str) -> Iterator[None]:
    """Raise what a device without memory left raises as a FineTuneError."""
    try:
        yield
    except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
        text = str(error)
        if not isinstance(error, torch.OutOfMemoryError | MemoryError) and "alloc" not in text.casefold():
            raise
        raise FineTuneError(
            f"{device} is out of memory: nothing was changed, and the f* before stays. Free some, or take "
            f"device='cpu' ({text})"
        ) from error


class Trainer:
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
        self.touches, self.spreads, self.epochs, self.seed = touches, spreads, epochs, seed
        self.device, self.mode, self.progress = device, mode, progress

    def held_out(
        self, model: Model, statistics: Statistics, samples: list[TrainingSample]
    ) -> tuple[list[Trained], list[Trained]]:
        """For each fold of the samples what training on the others gives for it, and what f gives that never saw it."""
        trials, before = [], []
        names = sorted({sample.material for sample in samples})
        for fold in range(FOLDS):
            held = [sample for sample in samples if fold_of(sample.key) == fold]
            start = start_without(model, statistics, held, names)
            train = [s for s in samples if fold_of(s.key) != fold and s.material in start.names]
            test = [sample for sample in held if sample.material in start.names]
            if len(start.names) < 2 or not train or not test:
                continue
            head = LinearHead(start, self.spreads).to(self.device)
            before.append(
                Trained(
                    logits=[self._judge(head, None, test)],
                    targets=_targets(head, test),
                    heads={},
                    bias=start.bias,
                    network={},
                )
            )
            trials.append(self.train(start, train, test, self.epochs, salt=fold, what=f"held out {fold + 1}/{FOLDS}"))
        return trials, before

    def train(
        self,
        start: Start,
        train: list[TrainingSample],
        test: list[TrainingSample],
        until: int,
        *,
        salt: int,
        what: str = "training",
    ) -> Trained:
        """Train for `until` epochs of a schedule of `epochs`, and test it after each."""
        random = np.random.default_rng([self.seed, salt])
        head = LinearHead(start, self.spreads).to(self.device)
        groups: list[dict[str, Any]] = [{"params": [*head.parameters()], "lr": HEAD_RATE}]
        net = None if self.mode == "head" else self.touches.network().to(self.device)
        if net is not None:
            if self.mode == "adapters":
                adapted(net)
            groups.append({"params": [p for p in net.parameters() if p.requires_grad], "lr": RATES[self.mode]})
        optimiser = torch.optim.AdamW(groups, weight_decay=0.0)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, -(-len(train) // BATCH) * self.epochs)
        logits = []
        for epoch in range(until):
            order = random.permutation(len(train))
            for first in range(0, len(order), BATCH):
                batch = [self._augmented(train[i], random) for i in order[first : first + BATCH]]
                self._step(head, net, batch, optimiser, f"{what}, epoch {epoch + 1}")
                schedule.step()
            if test:
                logits.append(self._judge(head, net, test))
            self.progress(what, epoch + 1, until)
        heads, bias = head.arrays()
        network = {} if net is None else net.tensors()
        arrays: list[npt.NDArray[Any]] = [bias, *heads.values(), *network.values()]
        if not all(np.isfinite(array).all() for array in arrays):
            raise FineTuneError(f"the weights are not finite after {what}: nothing was changed; take another seed")
        return Trained(logits=logits, targets=_targets(head, test), heads=heads, bias=bias, network=network)

    def _augmented(self, sample: TrainingSample, random: np.random.Generator) -> TrainingSample:
        if random.random() >= AUGMENTED:
            return sample
        image = AUGMENTATION.augment(sample.image, random, steps=sample.image.shape[1])
        return replace(sample, image=image, frozen=self.touches.frozen(image))

    def _step(
        self,
        head: LinearHead,
        net: Backbone | None,
        batch: list[TrainingSample],
        optimiser: torch.optim.Optimizer,
        where: str,
    ) -> None:
        targets = torch.from_numpy(_targets(head, batch)).to(self.device)
        loss = functional.cross_entropy(head(self.touches.means(net, batch, self.device)), targets)
        value = float(loss.detach())
        if not np.isfinite(value):
            raise FineTuneError(
                f"the loss became {value} in {where}: nothing was changed, and the f* before stays. Are the "
                "exemplars' readings sound? Another seed, or fewer epochs, may do"
            )
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()

    def _judge(self, head: LinearHead, net: Backbone | None, test: list[TrainingSample]) -> FloatArray:
        """Logits (touches, C)."""
        with torch.no_grad():
            parts = [
                head(self.touches.means(net, test[first : first + BATCH], self.device))
                for first in range(0, len(test), BATCH)
            ]
        return np.asarray(torch.cat(parts).cpu())


def _targets(head: LinearHead, samples: Sequence[TrainingSample]) -> npt.NDArray[np.intp]:
    return np.array([head.names.index(sample.material) for sample in samples], dtype=np.intp)


class LinearHead(nn.Module):
    """f's readout, with changes to be learned in units of the features' spread."""

    def __init__(self, start: Start, spreads: Mapping[int, FloatArray]) -> None:
        super().__init__()
        self.names = start.names
        self.bases = {scale: torch.from_numpy(head) for scale, head in sorted(start.heads.items())}
        self.spreads = {scale: torch.from_numpy(1.0 / spreads[scale])[:, None] for scale in self.bases}
        self.changes = nn.ParameterDict(
            {str(scale): nn.Parameter(torch.zeros_like(base)) for scale, base in self.bases.items()}
        )
        self.bias = torch.from_numpy(start.bias)
        self.offset = nn.Parameter(torch.zeros(len(start.names), dtype=torch.float64))

    def weights(self, scale: int) -> torch.Tensor:
        """The weights of a scale, (d, C), before the temperature."""
        change = self.changes[str(scale)]
        moved: torch.Tensor = self.spreads[scale].to(change.device) * change
        return self.bases[scale].to(change.device) + moved

    def forward(self, means: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """Logits (B, C) of mean features by scale, each (B, d)."""
        logits: torch.Tensor = self.bias.to(self.offset.device) + self.offset
        for scale in self.bases:
            logits = logits + means[scale] @ self.weights(scale)
        return logits

    def arrays(self) -> tuple[dict[int, FloatArray], FloatArray]:
        """The weights by scale and the bias."""
        with torch.no_grad():
            heads = {scale: self.weights(scale).cpu().numpy() for scale in self.bases}
            return heads, (self.bias.to(self.offset.device) + self.offset).cpu().numpy()

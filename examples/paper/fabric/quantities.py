"""`fabric quantities`: how hard and how fast a fabric was slid over, with intervals, on fabrics learned and never felt.

FabricSlide's force and speed, as numbers of a touch: five random folds, and each fabric left out. Beside ours stands
scikit-learn's ridge on the same features with the intervals of MAPIE (CV+) and of crepes (split conformal).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from examples.paper.readers import fabric_slide
from examples.paper.readers.fabric_slide import CPM_FINGER, Slides
from examples.paper.runs.cells import Cell, Figures, run_cells, silent
from examples.paper.runs.options import Data, Json, Run, Seed
from examples.paper.runs.results import show, write
from scroll_tactile import Kernels
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.embeddings.protocol import window_plan
from scroll_tactile.errors import InputError
from scroll_tactile.finetune.fine_tune import Progress
from scroll_tactile.libraries import optional
from scroll_tactile.prediction.features import FeatureExtractor
from scroll_tactile.quantities import Quantity
from scroll_tactile.readouts.estimation import Estimator
from scroll_tactile.signals.stream import Stream
from scroll_tactile.signals.windows import Scale
from scroll_tactile.statistics.annotations import Annotation
from scroll_tactile.statistics.sample import CAPACITY, SampledTouch, TouchSample

__all__ = ["MOMENTS", "Quantities", "quantities", "summary"]

FloatArray = npt.NDArray[np.float64]
Intervals = tuple[FloatArray, FloatArray, FloatArray]
"""Said values, and the ends of their intervals, each of shape (N,)."""

MOMENTS = {"0.3 s": 11, "0.8 s": 28, "4 s": 144}
"""From how many readings: two milestones, and all that is learned."""

SIZES = (64, 128, CAPACITY, 1024)  # of the sample; the last holds every touch
RISK = 0.1
QUANTITIES = {
    "force": Quantity(name="force", unit="publisher's unit", low=100, high=270, resolution=1),
    "speed": Quantity(name="speed", unit="mm/s", low=0, high=160, resolution=1),
}


@dataclass(frozen=True)
class EncodedSlide:
    """The first 4 s of a slide: what a sample holds of it, and its steps and mean features at each moment."""

    material: str
    key: bytes
    touch: SampledTouch
    steps: dict[str, int]
    means: dict[str, dict[Scale, FloatArray]]


@dataclass(frozen=True)
class Quantities:
    """Force and speed of slides that were held out, at random or with all slides over their fabric.

    slides: of `fabric_slide`. peers: whether scikit-learn's, MAPIE's and crepes' are measured too. seed: of the peers'
    folds. folder: where finished parts are noted, so that an interrupted run resumes; or None.

    Raises InputError for fewer than three fabrics: with one left out, one would be left to hold out.
    """

    slides: Slides
    peers: bool = True
    seed: int = 0
    folder: Path | None = None

    def __post_init__(self) -> None:
        if (count := len(set(self.slides.recordings.materials))) < 3:
            raise InputError(f"expected slides over three fabrics or more; came {count}")

    @property
    def plan(self) -> dict[str, Any]:
        """All that the figures depend on, beside the data."""
        return {"run": "quantities", "risk": RISK, "moments": [*MOMENTS], "peers": self.peers, "seed": self.seed}

    def run(self, progress: Progress = silent) -> Iterator[tuple[Cell, Figures]]:
        """The figures of each split, as they are finished. Raises MissingLibraryError for a peer that is not there."""
        recordings = self.slides.recordings
        cells = [Cell(recordings.name, 0, name) for name in self._splits]
        yield from run_cells(self.folder, self.plan, [recordings], cells, self._measure, progress)

    @cached_property
    def _splits(self) -> dict[str, npt.NDArray[np.bool_]]:
        fold, names = self.slides.recordings.fold, np.array(self.slides.recordings.materials)
        out = {f"without {name}": names == name for name in dict.fromkeys(self.slides.recordings.materials)}
        return {f"fold {i}": fold == i for i in range(5)} | out

    @cached_property
    def _targets(self) -> dict[str, FloatArray]:
        return {"force": self.slides.force.astype(float), "speed": np.abs(self.slides.speed).astype(float)}

    @cached_property
    def _encoded(self) -> list[EncodedSlide]:
        embedding = Kernels()
        plan = window_plan(CPM_FINGER, embedding)
        extractor = FeatureExtractor(CPM_FINGER, embedding, plan)

        def encoded(place: int, material: str, slide: Stream) -> EncodedSlide:
            stream = slide.first(CPM_FINGER.duration)
            steps, codes = extractor.learned(stream)
            parts = {name: extractor.image(stream)[:, :most] for name, most in MOMENTS.items()}
            means = {name: extractor.means(image, plan.scales) for name, image in parts.items()}
            values = ((of, QUANTITIES[of].integer(own[place])) for of, own in sorted(self._targets.items()))
            touch = SampledTouch.of(plan.scored_stages(steps), codes, Annotation(tuple(values)))
            return EncodedSlide(material, stream.key, touch, {name: i.shape[1] for name, i in parts.items()}, means)

        recordings = self.slides.recordings
        slides = zip(recordings.materials, recordings.streams, strict=True)
        return [encoded(place, *slide) for place, slide in enumerate(slides)]

    def _measure(self, cell: Cell, progress: Progress) -> Figures:
        tested = self._splits[cell.system]
        train, test = np.flatnonzero(~tested), np.flatnonzero(tested)
        known = cell.system.startswith("fold")
        systems: dict[str, Callable[[str, str], Intervals]] = {}
        for size in SIZES:
            estimator = self._estimator(train, size)
            systems["ours" if size == CAPACITY else f"ours, {size}"] = self._ours(estimator, test, known)
        if self.peers:
            systems |= {
                "MAPIE": self._peer(mapie, train, test, known),
                "crepes": self._peer(crepes, train, test, known),
            }
        figures: dict[str, Any] = {"learned": len(train), "tested": len(test)}
        for done, (name, system) in enumerate(systems.items()):
            progress(name, done, len(systems))
            figures[name] = {
                moment: {of: self._figures(of, test, system(moment, of)) for of in QUANTITIES} for moment in MOMENTS
            }
        return figures

    def _estimator(self, train: npt.NDArray[np.intp], size: int) -> Estimator:
        sample = TouchSample(size)
        for i in train:
            sample.add(self._encoded[i].material, self._encoded[i].key, self._encoded[i].touch)
        lengths = sorted(self._encoded[i].steps["4 s"] for i in train)
        return Estimator.of(window_plan(CPM_FINGER, Kernels()), sample, QUANTITIES, lengths[len(lengths) // 20])

    def _ours(self, estimator: Estimator, test: npt.NDArray[np.intp], known: bool) -> Callable[[str, str], Intervals]:
        def asked(moment: str, of: str) -> Intervals:
            slides = [self._encoded[i] for i in test]
            answers = [
                estimator.estimate([of], slide.means[moment], slide.steps[moment], RISK, known=known)[of]
                for slide in slides
            ]
            said = np.array([(a.value, a.low, a.high) for a in answers], dtype=np.float64)
            return said[:, 0], said[:, 1], said[:, 2]

        return asked

    def _peer(
        self, peer: Peer, train: npt.NDArray[np.intp], test: npt.NDArray[np.intp], known: bool
    ) -> Callable[[str, str], Intervals]:
        def asked(moment: str, of: str) -> Intervals:
            scales = sorted(set.intersection(*(set(self._encoded[i].means[moment]) for i in (*train, *test))))
            if moment != "4 s":  # the views of a whole touch are of a part of it
                scales = [scale for scale in scales if scale.kind == "window"]
            rows = np.stack([np.concatenate([one.means[moment][s] for s in scales]) for one in self._encoded])
            groups = np.unique(self.slides.recordings.materials, return_inverse=True)[1]
            return peer(rows[train], self._targets[of][train], None if known else groups[train], rows[test], self.seed)

        return asked

    def _figures(self, of: str, test: npt.NDArray[np.intp], said: Intervals) -> dict[str, float]:
        truth, every = self._targets[of][test], self._targets[of]
        value, low, high = said
        return {
            "squares": float(np.square(value - truth).sum()),
            "spread": float(np.square(truth - every.mean()).sum()),
            "off": float(np.abs(value - truth).mean()),
            "covers": float(((low <= truth) & (truth <= high)).mean()),
            "width": float((high - low).mean()),
        }


Peer = Callable[[FloatArray, FloatArray, "npt.NDArray[np.intp] | None", FloatArray, int], Intervals]


def _ridge() -> Any:
    with optional("scikit-learn", "bench", "the comparison with scikit-learn's ridge"):
        from sklearn.linear_model import RidgeCV
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler
    return make_pipeline(StandardScaler(), RidgeCV(alphas=np.logspace(-1, 5, 13)))


def mapie(
    rows: FloatArray, targets: FloatArray, groups: npt.NDArray[np.intp] | None, asked: FloatArray, seed: int
) -> Intervals:
    """Ridge with MAPIE's CV+ intervals (Barber et al. 2021): five folds of touches, or each material a fold."""
    with optional("mapie", "peers", "the comparison with MAPIE's intervals"):
        from mapie.regression import CrossConformalRegressor
    from sklearn.model_selection import KFold, LeaveOneGroupOut

    folds = KFold(5, shuffle=True, random_state=seed) if groups is None else LeaveOneGroupOut()
    model = CrossConformalRegressor(_ridge(), confidence_level=1 - RISK, method="plus", cv=folds)
    said, ends = model.fit_conformalize(rows, targets, groups).predict_interval(asked)
    return said, ends[:, 0, 0], ends[:, 1, 0]


def crepes(
    rows: FloatArray, targets: FloatArray, groups: npt.NDArray[np.intp] | None, asked: FloatArray, seed: int
) -> Intervals:
    """Ridge with crepes' split conformal intervals: a fifth of the touches, or one material, is kept to calibrate."""
    with optional("crepes", "peers", "the comparison with crepes' intervals"):
        from crepes import WrapRegressor
    drawn = np.random.default_rng(seed).permutation(len(rows)) % 5 == 0
    held = drawn if groups is None else groups == groups.max()
    model = WrapRegressor(_ridge())
    model.fit(rows[~held], targets[~held])
    model.calibrate(rows[held], targets[held])
    ends = model.predict_int(asked, confidence=1 - RISK)
    return model.predict(asked), ends[:, 0], ends[:, 1]


def summary(parts: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """R², mean absolute error, coverage and mean width of each system, moment and quantity, by kind of split."""
    rows = []
    for kind in ("fold", "without"):
        own = [part for part in parts if part["part"].startswith(kind)]
        for name in [key for key in own[0] if key not in ("part", "learned", "tested", "seconds")]:
            for moment in MOMENTS:
                for of in QUANTITIES:
                    each = [part[name][moment][of] for part in own]
                    sizes = [part["tested"] for part in own]
                    row = {figure: float(np.average([e[figure] for e in each], weights=sizes)) for figure in FIGURES}
                    row["r2"] = 1 - sum(e["squares"] for e in each) / sum(e["spread"] for e in each)
                    row["least"] = min(e["covers"] for e in each)
                    held = "at random" if kind == "fold" else "a fabric"
                    rows.append({"held out": held, "system": name, "from": moment, "of": of} | row)
    return rows


FIGURES = ("off", "covers", "width")


def quantities(
    context: typer.Context,
    data: Data,
    peers: Annotated[bool, typer.Option(help="Measure MAPIE's and crepes' intervals too.")] = True,
    seed: Seed = 0,
    run: Run = None,
    json: Json = None,
) -> None:
    """Estimate the force and speed of slides, with intervals, on fabrics learned and never felt."""
    with progress_bar() as progress:
        progress("reading", 0, 1)
        task = Quantities(fabric_slide.load(data, seed=seed), peers, seed, run)
        parts = [{"part": cell.system} | figures for cell, figures in task.run(progress)]
    means = summary(parts)
    columns = {name: f"{{./{name}}}" for name in ("held out", "system", "from", "of")}
    columns |= {"R²": "{./r2|.3f}", "off": "{./off|.1f}", "covers, %": "{./covers|%}", "width": "{./width|.0f}"}
    show("FabricSlide: intervals that are to cover 90 %", columns, means)
    write(context, task.plan | {"means": means, "parts": parts})

"""A learner as estimators of scikit-learn: for pipelines, cross-validation and grid searches."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy.sparse import issparse
from sklearn.base import BaseEstimator, ClassifierMixin, RegressorMixin
from sklearn.exceptions import NotFittedError
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import assert_all_finite, check_array, column_or_1d, validate_data

from scroll_tactile.embeddings.protocol import Embedding
from scroll_tactile.errors import InputError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.quantities import Quantity
from scroll_tactile.results import Estimate
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import validate

__all__ = ["TactileClassifier", "TactileRegressor"]

RATE = 100.0  # Hz, where nothing is known of the sensor
MARGIN = 0.1  # of the range that was seen, beyond it at both ends

Touches = npt.NDArray[Any] | Sequence[npt.ArrayLike]
Labels = npt.NDArray[Any] | Sequence[Any]


class _TouchEstimator(BaseEstimator):  # type: ignore[misc]  # scikit-learn ships no types
    """The settings of both estimators, and the learner that they make."""

    def __init__(
        self,
        sensor: Sensor | None = None,
        embedding: Embedding | None = None,
        readout: str = "lda",
        kept_touches: int | None = None,
    ) -> None:
        self.sensor = sensor
        self.embedding = embedding
        self.readout = readout
        self.kept_touches = kept_touches

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.three_d_array = True
        tags.target_tags.required = True
        return tags

    def _read(self, X: Touches, *, fitting: bool = False) -> list[npt.NDArray[Any]]:
        """Each touch as (T, n). A table (N, T) is checked as scikit-learn does: numbers, finite, as wide as before.

        Raises InputError for an array of another shape, ValueError or TypeError for what is no table of such numbers.
        """
        if fitting:
            for name in ("n_features_in_", "feature_names_in_"):
                self.__dict__.pop(name, None)
        ndim = 2 if issparse(X) else getattr(np.asarray(X) if hasattr(X, "__array__") else X, "ndim", None)
        if ndim == 2:
            learner: TactileLearner | None = None if fitting else getattr(self, "learner_", None)
            sensor = self.sensor if learner is None else learner.sensor
            of_width = learner is None or self.n_features_in_ != learner.sensor.channels
            how: dict[str, Any] = {"ensure_min_features": 1 if of_width and learner else 2}
            how["ensure_all_finite"] = sensor is None or sensor.non_finite == "refused"
            checked = validate_data(self, X, reset=learner is None, **how) if of_width else check_array(X, **how)
            return [row[:, None] for row in checked]
        if ndim is not None and ndim != 3 and np.asarray(X).dtype != object:
            raise InputError(
                f"expected touches of shape (N, T, n), or (N, T) of one channel; came {np.asarray(X).shape}. "
                "Reshape your data: X[None] is a single touch"
            )
        touches = [np.asarray(touch) for touch in X]
        return [touch[:, None] if touch.ndim == 1 else touch for touch in touches]

    def _empty_learner(self, touches: Sequence[npt.NDArray[Any]]) -> TactileLearner:
        """A learner with these settings, for touches like these."""
        sensor = _sensor_of(touches) if self.sensor is None else self.sensor
        how: dict[str, Any] = {"embedding": self.embedding, "readout": self.readout, "kept_touches": self.kept_touches}
        return TactileLearner(sensor=sensor, exemplars=0, **how)

    def _fitted_learner(self) -> TactileLearner:
        """The learner. Raises NotFittedError where nothing was fitted."""
        learner: TactileLearner | None = getattr(self, "learner_", None)
        if learner is None:
            calls = " or ".join(name for name in ("fit", "partial_fit") if hasattr(self, name))
            raise NotFittedError(f"this {type(self).__name__} knows no touches yet: call {calls} first")
        return learner


class TactileClassifier(ClassifierMixin, _TouchEstimator):  # type: ignore[misc]  # as above
    """`TactileLearner`, in memory only, behind fit, partial_fit, predict, predict_proba and score.

    Touches X: an array (N, T, n) of N touches of T readings of n channels, (N, T) where there is one channel, or a list
    of arrays (T, n), whose lengths may differ. Labels y, (N,): of any kind that numpy can sort; each is the name of a
    material as its text. A touch that comes twice under one label counts once. For names of another axis, such as the
    direction of a slip, fit one to these: it answers as `TactileLearner.predict(of=…)` does.

    sensor: of the readings; None: 100 Hz, and the range of the first touches that are fitted, a tenth wider at both
    ends. embedding, readout, kept_touches: as of the learner.

    After fitting: classes_, the labels in ascending order; learner_, the learner; n_features_in_, the channels, or T of
    a table (N, T): later tables have to be as wide, touches of other lengths come in a list. An estimator that was
    fitted in parts, in any order, is the same as one that was fitted at once, if it was given a sensor: without one the
    range is that of the first part, and the rest is read within it.

    Raises InputError for labels that do not fit the touches, or are of another kind than those before, ValueError for
    missing or fractional labels and for tables of another width, TypeError for sparse ones, StreamError for touches
    that do not fit the sensor, NotFittedError for predictions before anything was fitted.
    """

    def fit(self, X: Touches, y: Labels) -> Self:
        """Observe these touches and nothing else."""
        for name in ("learner_", "classes_"):
            self.__dict__.pop(name, None)
        return self.partial_fit(X, y)

    def partial_fit(self, X: Touches, y: Labels, classes: Labels | None = None) -> Self:
        """Observe these touches beside all before. classes: taken as scikit-learn passes it, and not needed."""
        learner: TactileLearner | None = getattr(self, "learner_", None)
        touches, labels = self._read(X, fitting=learner is None), _labels(y)
        if labels.shape != (len(touches),) or not touches:
            raise InputError(
                f"expected touches, and one label for each; came {len(touches)} touches and labels of shape "
                f"{labels.shape}"
            )
        if learner is None:
            learner = self._empty_learner(touches)
        before = getattr(self, "classes_", labels[:0])
        classes_ = _joined(before, labels)
        streams = [validate(touch, learner.sensor) for touch in touches]  # all, before any is observed
        for label, stream in zip(labels, streams, strict=True):
            learner.observe(str(label), stream)
        self.learner_, self.classes_ = learner, classes_
        self.n_features_in_ = getattr(self, "n_features_in_", learner.sensor.channels)
        return self

    def predict(self, X: Touches) -> npt.NDArray[Any]:
        """The likeliest label of each touch, (N,)."""
        likeliest = self.predict_proba(X).argmax(axis=1)
        return np.asarray(self.classes_[likeliest])

    def predict_proba(self, X: Touches) -> npt.NDArray[np.float64]:
        """The probability of each label in the order of classes_, (N, classes), calibrated on touches left out."""
        learner = self._fitted_learner()
        names = [str(label) for label in self.classes_]
        rankings = [dict(learner.predict(touch).ranking) for touch in self._read(X)]
        return np.array([[shares[name] for name in names] for shares in rankings]).reshape(-1, len(names))


class TactileRegressor(RegressorMixin, _TouchEstimator):  # type: ignore[misc]  # as above
    """A quantity of touches, in memory only, behind fit, predict and score, with intervals by predict_interval.

    Touches X: as of `TactileClassifier`. Numbers y, (N,), finite. materials: what each touch is of, (N,), passed to
    `fit`, two or more: intervals for materials that were never felt come from those held out. A touch that comes twice
    of one material counts once, and with another number it is refused. It rests on 256 touches at most, drawn by their
    content (see `TactileLearner.estimate`). sensor, embedding, readout, kept_touches: as of `TactileClassifier`.

    After fitting: n_features_in_, as of `TactileClassifier`; learner_, the learner, whose quantity is "y", from the
    least y to the most and their difference beyond both.

    Raises InputError for numbers or materials that do not fit the touches, and where they say too little for a head.
    """

    def fit(self, X: Touches, y: npt.ArrayLike, materials: Labels | None = None) -> Self:
        """Observe these touches and nothing else."""
        self.__dict__.pop("learner_", None)
        touches, numbers, names = self._read(X, fitting=True), np.asarray(y, dtype=np.float64), np.asarray(materials)
        if not touches or numbers.shape != (len(touches),) or not np.isfinite(numbers).all():
            raise InputError(
                f"expected touches, and a finite number for each; came {len(touches)} touches and numbers of shape "
                f"{numbers.shape}"
            )
        if names.shape != numbers.shape or len(np.unique(names)) < 2:
            raise InputError("expected materials=, what each touch is of, two or more: intervals are held out by them")
        learner, low, high = self._empty_learner(touches), float(numbers.min()), float(numbers.max())
        reach = (high - low) or 1.0
        learner.declare(Quantity(name="y", unit="1", low=low - reach, high=high + reach, resolution=reach / 2**18))
        for name, number, touch in zip(names, numbers.tolist(), touches, strict=True):
            learner.observe(str(name), touch, values={"y": number})
        self.learner_, self.n_features_in_ = learner, getattr(self, "n_features_in_", learner.sensor.channels)
        return self

    def predict(self, X: Touches) -> npt.NDArray[np.float64]:
        """The number of each touch, (N,)."""
        return np.array([estimate.value for estimate in self._estimates(X, 0.1, None)], dtype=np.float64)

    def predict_interval(
        self, X: Touches, confidence: float = 0.9, *, known: bool | None = None
    ) -> npt.NDArray[np.float64]:
        """(N, 2): the interval that holds each touch's number with this confidence. known: as of `estimate`."""
        found = self._estimates(X, 1 - confidence, known)
        return np.array([estimate.interval for estimate in found], dtype=np.float64).reshape(-1, 2)

    def _estimates(self, touches: Touches, risk: float, known: bool | None) -> list[Estimate]:
        learner = self._fitted_learner()
        found = [learner.estimate(touch, risk=risk, known=known)["y"] for touch in self._read(touches)]
        if lacking := next((each.missing for each in found if each.value is None), None):
            raise InputError(f"these touches say too little: {lacking}")
        return found


def _labels(y: Labels) -> npt.NDArray[Any]:
    """Labels as (N,). Raises ValueError for none, numbers that are not whole, and what is missing."""
    if y is None:
        raise InputError("TactileClassifier requires y to be passed, but the target y is None")
    labels = np.asarray(column_or_1d(y, warn=True))
    if labels.dtype.kind == "f":
        assert_all_finite(labels, input_name="y")
    elif labels.dtype == object and any(isinstance(label, float) and isnan(label) for label in labels):
        raise InputError("expected a label for each touch; came NaN among y")
    check_classification_targets(labels)
    return labels


def _joined(before: npt.NDArray[Any], labels: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """All labels, sorted. Raises InputError where they are called otherwise together than alone, as 1 is beside 1.0."""
    together = np.unique(np.concatenate([before, labels]))
    if not {*map(str, before), *map(str, labels)} == {*map(str, together)}:
        raise InputError(
            f"expected labels of the kind that came first, {before.dtype}; came {labels.dtype}: convert them with "
            "y.astype(classifier.classes_.dtype)"
        )
    return together


def _sensor_of(touches: Sequence[npt.NDArray[Any]]) -> Sensor:
    """A sensor that some touches could be of."""
    first = touches[0]
    if any(touch.ndim != 2 or touch.shape[1:] != first.shape[1:] or not touch.size for touch in touches):
        shapes = sorted({touch.shape[1:] for touch in touches})
        raise InputError(f"expected touches of shape (T, n), all of the same n; came readings of shapes {shapes[:5]}")
    longest = max(len(touch) for touch in touches)
    if longest < first.shape[1]:
        raise InputError(
            f"expected more readings than channels; came touches of {longest} readings of {first.shape[1]} channels. "
            "Of (N, n, T), as aeon and sktime have it, take X.transpose(0, 2, 1); for a sensor of so many channels, "
            "give sensor=",
            argument="sensor",
        )
    low = min(float(np.min(touch)) for touch in touches)
    high = max(float(np.max(touch)) for touch in touches)
    if not np.isfinite([low, high]).all():
        raise InputError(
            'expected finite readings, or a sensor that says what others are: sensor=Sensor(..., non_finite="missing")'
        )
    margin = MARGIN * (high - low) or 1.0
    return Sensor(
        name="array",
        channels=first.shape[1],
        rate=RATE,
        low=low - margin,
        high=high + margin,
        unit="",
        duration=longest / RATE,
    )

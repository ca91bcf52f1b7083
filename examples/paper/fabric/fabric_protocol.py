"""How well compositions are predicted: the paper's score, and what is behind it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.pipelines.metrics import calibration_error
from scroll_tactile.results import Composition

__all__ = ["score", "score_compositions"]

BoolArray = npt.NDArray[np.bool_]


def score(
    names: Sequence[str],
    truth: npt.ArrayLike,
    presence: npt.ArrayLike,
    shares: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
) -> dict[str, Any]:
    """Figures of N compositions of K constituents.

    names: K. truth: whether each is there, shape (N, K), NaN where that is unknown, which counts for nothing. presence:
    the predicted probability, shape (N, K); predicted to be there is what has more than a half, and NaN, given for a
    constituent without a head, counts as "not there". shares: true and predicted ones, each of shape (N, K), NaN where
    there is none.

    "score": the paper's, the mean over the constituents of correct presence (of six, each false positive or negative
    costs a sixth). "exact": the share of compositions without any. "always": the score of saying of each constituent
    always what is true more often. "calibration_error": expected, of all presences predicted, 15 bins. "share_error":
    mean absolute. "constituents": of each, how often it is there, correct, precision and recall (None without any
    predicted, or any there), and how often nothing was predicted.

    Raises InputError where the shapes differ, there are none, or of a constituent or a composition nothing is known.
    """
    true, chances = np.asarray(truth, dtype=np.float64), np.asarray(presence, dtype=np.float64)
    if true.shape != chances.shape or true.ndim != 2 or true.shape[1] != len(names) or not true.size:
        raise InputError(
            f"expected truth and presence of shape (N, {len(names)}), N ≥ 1; came {true.shape} and {chances.shape}"
        )
    known = np.isfinite(true)
    if not known.any(axis=0).all() or not known.any(axis=1).all():
        raise InputError("expected something to be known of every constituent and every composition that is scored")
    there, predicted = true > 0, chances > 0.5  # False for NaN
    right, answered = predicted == there, np.isfinite(chances) & known
    often = (there & known).sum(axis=0) / known.sum(axis=0)
    figures: dict[str, Any] = {
        "tested": len(there),
        "score": float(right[known].mean()),
        "exact": float((right | ~known).all(axis=1).mean()),
        "always": float(np.average(np.maximum(often, 1 - often), weights=known.sum(axis=0))),
        "calibration_error": None,
        "share_error": None,
        "constituents": {
            name: _of_one(there[known[:, i], i], predicted[known[:, i], i])
            | {"unanswered": int((known[:, i] & ~answered[:, i]).sum())}
            for i, name in enumerate(names)
        },
    }
    if answered.any():
        sure = np.maximum(chances[answered], 1 - chances[answered])
        figures["calibration_error"] = calibration_error(sure, right[answered])
    if shares is not None:
        gaps = np.abs(np.asarray(shares[0], dtype=np.float64) - np.asarray(shares[1], dtype=np.float64))
        if np.isfinite(gaps).any():
            figures["share_error"] = float(np.nanmean(gaps))
    return figures


def _of_one(there: BoolArray, predicted: BoolArray) -> dict[str, float | None]:
    hits = int((there & predicted).sum())
    return {
        "there": float(there.mean()),
        "correct": float((there == predicted).mean()),
        "precision": hits / int(predicted.sum()) if predicted.any() else None,
        "recall": hits / int(there.sum()) if there.any() else None,
    }


def score_compositions(
    names: Sequence[str], truth: Sequence[Mapping[str, float | bool | None]], predicted: Sequence[Composition]
) -> dict[str, Any]:
    """Figures, as `score` gives them, of a learner's answers; truth: presence or share of each constituent, N times.

    A constituent that the truth does not name is not there, and one that it gives as None is unknown. Raises
    InputError where the lengths differ.
    """
    if len(truth) != len(predicted):
        raise InputError(f"expected as many truths as compositions; came {len(truth)} and {len(predicted)}")

    def answered(composition: Composition, name: str, what: str) -> float:
        value = getattr(composition[name], what)
        return float("nan") if value is None else float(value)

    presence = [[answered(item, name, "presence") for name in names] for item in predicted]
    guessed = [[answered(item, name, "share") for name in names] for item in predicted]
    masses = [any(isinstance(value, float) for value in item.values()) for item in truth]

    def known(item: Mapping[str, float | bool | None], name: str) -> float:
        value = item.get(name, 0.0)
        return float("nan") if value is None else float(value)

    there = [[known(item, name) for name in names] for item in truth]
    shares = [true if mass else [float("nan")] * len(names) for true, mass in zip(there, masses, strict=True)]
    return score(names, there, presence, (shares, guessed))

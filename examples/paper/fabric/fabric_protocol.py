"""How well compositions are predicted: the paper's score, and what is behind it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.clients.learning.metrics import calibration_error
from scroll_tactile.errors import InputError

__all__ = ["score"]

BoolArray = npt.NDArray[np.bool_]


def score(
    names: Sequence[str],
    truth: npt.ArrayLike,
    presence: npt.ArrayLike,
    shares: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
) -> dict[str, Any]:
    """Figures of N compositions of K constituents.

    names: K. truth: whether each is there, shape (N, K). presence: the predicted probability, shape (N, K); predicted
    to be there is what has more than a half, and NaN, given for a constituent without a head, counts as "not there".
    shares: true and predicted ones, each of shape (N, K), NaN where there is none.

    "score": the paper's, the mean over the constituents of correct presence (of six, each false positive or negative
    costs a sixth). "exact": the share of compositions without any. "always": the score of saying of each constituent
    always what is true more often. "calibration_error": expected, of all presences predicted, 15 bins. "share_error":
    mean absolute. "constituents": of each, how often it is there, correct, precision and recall (None without any
    predicted, or any there), and how often nothing was predicted.

    Raises InputError where the shapes differ or there are none.
    """
    there, chances = np.asarray(truth, dtype=np.float64) > 0, np.asarray(presence, dtype=np.float64)
    if there.shape != chances.shape or there.ndim != 2 or there.shape[1] != len(names) or not there.size:
        raise InputError(
            f"expected truth and presence of shape (N, {len(names)}), N ≥ 1; came {there.shape} and {chances.shape}"
        )
    predicted, answered = chances > 0.5, np.isfinite(chances)  # False for NaN
    right, often = predicted == there, there.mean(axis=0)
    figures: dict[str, Any] = {
        "tested": len(there),
        "score": float(right.mean()),
        "exact": float(right.all(axis=1).mean()),
        "always": float(np.maximum(often, 1 - often).mean()),
        "calibration_error": None,
        "share_error": None,
        "constituents": {
            name: _of_one(there[:, i], predicted[:, i]) | {"unanswered": int((~answered[:, i]).sum())}
            for i, name in enumerate(names)
        },
    }
    if answered.any():
        sure = np.maximum(chances[answered], 1 - chances[answered])
        figures["calibration_error"] = calibration_error(sure, right[answered])
    if shares is not None:
        gaps = np.abs(np.asarray(shares[0], dtype=np.float64) - np.asarray(shares[1], dtype=np.float64))
        figures["share_error"] = float(np.nanmean(gaps)) if np.isfinite(gaps).any() else None
    return figures


def _of_one(there: BoolArray, predicted: BoolArray) -> dict[str, float | None]:
    hits = int((there & predicted).sum())
    return {
        "there": float(there.mean()),
        "correct": float((there == predicted).mean()),
        "precision": hits / int(predicted.sum()) if predicted.any() else None,
        "recall": hits / int(there.sum()) if there.any() else None,
    }

"""How well compositions are told: the paper's score, and what is behind it."""

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
    the probability that was said, shape (N, K); said to be there is what has more than a half, and NaN, said of a
    constituent without a head, counts as "not there". shares: true and said ones, each of shape (N, K), NaN where there
    is none.

    "score": the paper's, the mean over the constituents of correct presence (of six, each false positive or negative
    costs a sixth). "exact": the share of compositions without any. "always": the score of saying of each constituent
    always what is true more often. "calibration_error": expected, of all presences said, 15 bins. "share_error": mean
    absolute. "constituents": of each, how often it is there, correct, precision and recall (None without any said, or
    any there), and how often nothing was said.

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
    there, said = true > 0, chances > 0.5  # False for NaN
    right, told = said == there, np.isfinite(chances) & known
    often = (there & known).sum(axis=0) / known.sum(axis=0)
    figures: dict[str, Any] = {
        "tested": len(there),
        "score": float(right[known].mean()),
        "exact": float((right | ~known).all(axis=1).mean()),
        "always": float(np.average(np.maximum(often, 1 - often), weights=known.sum(axis=0))),
        "calibration_error": None,
        "share_error": None,
        "constituents": {
            name: _of_one(there[known[:, at], at], said[known[:, at], at])
            | {"unanswered": int((known[:, at] & ~told[:, at]).sum())}
            for at, name in enumerate(names)
        },
    }
    if told.any():
        sure = np.maximum(chances[told], 1 - chances[told])
        figures["calibration_error"] = calibration_error(sure, right[told])
    if shares is not None:
        gaps = np.abs(np.asarray(shares[0], dtype=np.float64) - np.asarray(shares[1], dtype=np.float64))
        if np.isfinite(gaps).any():
            figures["share_error"] = float(np.nanmean(gaps))
    return figures


def _of_one(there: BoolArray, said: BoolArray) -> dict[str, float | None]:
    hits = int((there & said).sum())
    return {
        "there": float(there.mean()),
        "correct": float((there == said).mean()),
        "precision": hits / int(said.sum()) if said.any() else None,
        "recall": hits / int(there.sum()) if there.any() else None,
    }


def score_compositions(
    names: Sequence[str], truth: Sequence[Mapping[str, float | bool | None]], said: Sequence[Composition]
) -> dict[str, Any]:
    """Figures, as `score` gives them, of what a learner said; truth: presence or share of each constituent, N times.

    A constituent that the truth does not name is not there, and one that it gives as None is unknown. Raises
    InputError where the lengths differ.
    """
    if len(truth) != len(said):
        raise InputError(f"expected as many truths as compositions; came {len(truth)} and {len(said)}")

    def told(composition: Composition, name: str, what: str) -> float:
        value = getattr(composition[name], what)
        return float("nan") if value is None else float(value)

    presence = [[told(one, name, "presence") for name in names] for one in said]
    guessed = [[told(one, name, "share") for name in names] for one in said]
    masses = [any(isinstance(value, float) for value in one.values()) for one in truth]

    def known(one: Mapping[str, float | bool | None], name: str) -> float:
        value = one.get(name, 0.0)
        return float("nan") if value is None else float(value)

    there = [[known(one, name) for name in names] for one in truth]
    shares = [true if mass else [float("nan")] * len(names) for true, mass in zip(there, masses, strict=True)]
    return score(names, there, presence, (shares, guessed))

"""Cases that are read from files: NIST's certified regressions, and features of real touches."""

from __future__ import annotations

import json
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Literal

import numpy as np

from examples.benchmarks.numerics.memories import JUDGED, Memory
from examples.benchmarks.numerics.regressions import Case
from examples.paper.readers.biotac_slide import load
from scroll_tactile import Kernels
from scroll_tactile.errors import DatasetError
from scroll_tactile.signals.image import tactile_image

__all__ = ["NIST", "digits", "nist_cases", "real_memory"]

NIST = "nist_strd.json"


def nist_cases(path: Path) -> Iterator[Case]:
    """The linear sets of NIST's StRD in a file of decimal strings, with certified coefficients; λ = 0.

    Powers are taken of the decimals and rounded once: no double holds more of the problem.
    """
    try:
        sets = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DatasetError(f"expected NIST's regressions in {path}; it cannot be read: {error}") from error
    for name, published in sets.items():
        if not isinstance(published, dict):
            continue  # the note
        if "degree" in published:
            first = 1 if published.get("intercept") is False else 0
            rows = [
                [float(Fraction(x) ** power) for power in range(first, published["degree"] + 1)] for x in published["x"]
            ]
        else:
            rows = [[1.0, *map(float, row)] for row in published["X"]]
        targets = np.array([[float(y)] for y in published["y"]])
        yield Case(name, np.array(rows), targets, 0.0, None, np.array([float(w) for w in published["certified"]]))


def digits(weights: np.ndarray, certified: np.ndarray) -> float:
    """Correct digits of the worst coefficient, −log₁₀ of its relative error, from 0 to the 15 that are certified."""
    if not np.isfinite(weights).all():
        return 0.0
    worst = float(np.abs((weights.reshape(-1) - certified) / certified).max())
    return float(np.clip(-np.log10(max(worst, 1e-300)), 0.0, 15.0))


def real_memory(
    name: Literal["biotac", "roboskin"], data: Path, seed: int, dimension: int, most: int | None = None
) -> Memory:
    """Features of whole touches of "biotac" or "roboskin", one row a touch; some of one fold are evaluated.

    Raises DatasetError for a folder that is not laid out as published.
    """
    recordings = load(data, name, seed)
    chosen = np.random.default_rng([seed, 7]).permutation(len(recordings))[:most]
    embedding = Kernels(dimension=dimension)
    features = np.stack([embedding.embed(tactile_image(recordings.streams[i])) for i in chosen]) / embedding.bound
    train = recordings.fold[chosen] != 0
    names = sorted({recordings.materials[i] for i in chosen[train]})
    places = np.array([names.index(recordings.materials[i]) for i in chosen[train]])
    return Memory(
        f"{recordings.name}, {dimension} features", features[train][:, None], places, features[~train][:JUDGED]
    )

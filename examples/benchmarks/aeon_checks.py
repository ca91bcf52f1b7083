"""aeon's checks of a classifier, on the learner: `python -m examples.benchmarks.aeon_checks`.

aeon pins versions of NumPy that torch's builds do not go with, so it runs in an environment of its own, beside NumPy,
zarr, pydantic, threadpoolctl and filelock alone: `scroll_tactile.sklearn` needs no torch.
"""

from __future__ import annotations

import argparse
import json
import warnings
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from aeon.classification.base import BaseClassifier
from aeon.testing.estimator_checking import check_estimator

from scroll_tactile import Kernels, __version__
from scroll_tactile.sklearn import TactileClassifier

__all__ = ["ScrollClassifier"]


class ScrollClassifier(BaseClassifier):  # type: ignore[misc]  # aeon ships no types
    """The learner as aeon has classifiers: series (channels, T) of any lengths. dimension: of its kernels."""

    _tags: ClassVar = {
        "capability:multivariate": True,
        "capability:unequal_length": True,
        "X_inner_type": ["np-list", "numpy3D"],
        "algorithm_type": "convolution",
    }

    def __init__(self, dimension: int = 1008) -> None:
        self.dimension = dimension
        super().__init__()

    def _fit(self, X: Sequence[npt.ArrayLike], y: npt.NDArray[Any]) -> ScrollClassifier:
        self.classifier_ = TactileClassifier(embedding=Kernels(dimension=self.dimension)).fit(_touches(X), y)
        return self

    def _predict(self, X: Sequence[npt.ArrayLike]) -> npt.NDArray[Any]:
        return self.classifier_.predict(_touches(X))

    def _predict_proba(self, X: Sequence[npt.ArrayLike]) -> npt.NDArray[np.float64]:
        return self.classifier_.predict_proba(_touches(X))

    @classmethod
    def _get_test_params(cls, parameter_set: str = "default") -> dict[str, Any]:
        return {"dimension": 64}


def _touches(series: Sequence[npt.ArrayLike]) -> list[npt.NDArray[Any]]:
    return [np.asarray(one).T for one in series]


def _main() -> None:
    arguments = argparse.ArgumentParser(description="Run aeon's checks of a classifier on the learner.")
    arguments.add_argument("--json", type=Path, help="Write the result to this file.")
    path = arguments.parse_args().json
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        results = check_estimator(ScrollClassifier, raise_exceptions=False, verbose=False)
    failed = {name: repr(result) for name, result in results.items() if result != "PASSED"}
    packages = {name: version(name) for name in ("aeon", "numpy", "scikit-learn")}
    result = {
        "command": "python -m examples.benchmarks.aeon_checks",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "seed": 0,
        "versions": {"scroll-tactile": __version__, **packages},
        "checks": len(results),
        "failed": failed,
    }
    print(f"{len(results)} checks, {len(failed)} failed", *failed.items(), sep="\n")
    if path is not None:
        path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    _main()

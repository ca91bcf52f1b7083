"""What several tests of the studies share."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from paper_touches import PAD, PATCH, pressed, recorded, slid

from examples.paper.readers.labelled import Recordings
from examples.paper.runs.options import SETS
from examples.paper.studies import activation, fleet_study
from examples.paper.studies.metrics import ContinualMetrics
from examples.paper.studies.peers import ACIL, RanPAC
from examples.paper.studies.unlearning import Unlearning
from scroll_tactile import Kernels
from scroll_tactile.embeddings.resnet import ResNet


@pytest.fixture(scope="module", autouse=True)
def small() -> Iterator[None]:
    """Fewer features and epochs where a study takes the usual ones, and no kept touches: nine tenths of a fit.

    What kept touches do for an answer is a matter of tests/prediction and tests/matching.
    """
    fewer = {1008: 128, 2000: 200}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scroll_tactile.recipe.default_kept_touches", lambda sensor, *, views: 0)
        patch.setitem(Kernels.__init__.__kwdefaults__, "dimension", 128)
        for made in (ContinualMetrics, Unlearning, ACIL, RanPAC):
            usual = made.__init__.__defaults__
            patch.setattr(made.__init__, "__defaults__", tuple(fewer.get(value, value) for value in usual))
        patch.setattr(activation, "STEPS", 6)
        patch.setattr(fleet_study, "PLANS", {"1 round": (1, 4), "20 rounds": (2, 2)})
        yield


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A file of a ResNet's random weights."""
    path = tmp_path_factory.mktemp("weights") / "random.pth"
    torch.save(ResNet.random(3).state_dict(), path)
    return str(path)


@pytest.fixture(scope="session")
def striped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder laid out as PhysiCLeAR: three objects of stripes, three videos of four frames each, and attributes."""
    image = pytest.importorskip("PIL.Image")
    home = tmp_path_factory.mktemp("striped")
    rng = np.random.default_rng(0)
    for i, name in enumerate(("apple", "pen", "rug")):
        (home / "physiclear" / name).mkdir(parents=True)
        for video in (0, 3, 5):
            for frame in range(4):
                pixels = rng.normal(100, 2, (240, 320, 3))
                pixels[:, np.arange(320) // (4 << i) % 2 == 0] += 60
                path = home / "physiclear" / name / f"{name}_{video}_{frame}.jpg"
                image.fromarray(pixels.clip(0, 255).astype(np.uint8)).save(path)
    grades = {"apple": 2, "rug": 0, "pen": 1, "skin": 1}
    kinds = {"hardness": grades, "roughness": grades, "texture": grades | {"pen": 2}, "materials": {"apple": "food"}}
    (home / "physiclear" / "attributes.json").write_text(json.dumps(kinds))
    return home


@pytest.fixture
def gelsight(striped: Path, tmp_path: Path) -> Path:
    """A copy of `striped`, which the test may change."""
    return shutil.copytree(striped, tmp_path, dirs_exist_ok=True)


@pytest.fixture(scope="session")
def small_sets() -> dict[str, Recordings]:
    """The sets of touches, made up: five materials under two sensors, thirty touches of each in three folds."""
    sizes: dict[str, Any] = {"materials": 5, "each": 30, "folds": 3}
    biotac = recorded(PATCH, name="BioTac-20", ordered=True, **sizes)
    roboskin = recorded(PAD, name="RoboSkin-20", **sizes)
    return {
        "biotac-20": biotac,
        "biotac-20-blocked": replace(biotac, name="BioTac-20 blocked", fold=biotac.blocked()),
        "roboskin-20": roboskin,
        "roboskin-20-unmixed": replace(roboskin, name="RoboSkin-20, unmixed"),
        "letter-spike": pressed(),
    }


@pytest.fixture
def made_up(small_sets: dict[str, Recordings], monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every command read the made-up sets."""
    for name, recordings in small_sets.items():
        monkeypatch.setitem(SETS, name, lambda data, seed, recordings=recordings: recordings)
    monkeypatch.setattr("examples.paper.readers.fabric_slide.load", lambda data, seed: slid())

"""The paper's systems in the studies of robustness: what they are trained on with and without augmentation."""

import numpy as np
import pytest
from paper_touches import PATCH

from examples.paper.studies.baselines import BASELINES, COPIES, Sometimes, baseline
from examples.paper.studies.perturbations import noise
from examples.paper.systems.catalogue import Catalogue
from examples.paper.systems.descent import Course
from examples.paper.systems.svm import Svm
from examples.paper.systems.system_protocol import silent
from scroll_tactile.errors import InputError
from scroll_tactile.pipelines.metrics import accuracy
from scroll_tactile.signals.augmentation import Augmentation
from scroll_tactile.simulation.scene import Scene

SCENE = Scene(PATCH, seed=0)
NAMES = SCENE.materials[:3]
TRAIN = [(name, SCENE.touch(name, i)) for name in NAMES for i in range(12)]
TEST = [(name, SCENE.touch(name, i)) for name in NAMES for i in range(12, 18)]


def test_copies_are_learned_beside_the_touches_and_never_validated_on(monkeypatch):
    trained, held = [], []
    fit = Svm.fit

    def watched(self, streams, materials, validation, *more):
        trained.append(list(streams))
        held.append([stream for _, stream in validation])
        fit(self, streams, materials, validation, *more)

    monkeypatch.setattr(Svm, "fit", watched)
    make, settings = baseline("svm", Catalogue(), seed=1)
    for augmented in (False, True):
        make(TRAIN, augmented, silent)
    assert settings["augmentation"]["copies"] == COPIES
    keys = {stream.key for _, stream in TRAIN}
    for streams, validation in zip(trained, held, strict=True):
        assert {stream.key for stream in validation} <= keys
        assert len(validation) == 3
        assert not {stream.key for stream in validation} & {stream.key for stream in streams}
    assert {stream.key for stream in trained[0]} == keys - {stream.key for stream in held[0]}
    assert len(trained[1]) == len(trained[0]) * (1 + COPIES)
    assert len({stream.key for stream in trained[1]}) > 1.5 * len(trained[0])


def test_a_network_learns_noise_with_its_augmentation_and_the_seed_makes_it():
    catalogue = Catalogue(course=Course(epochs=15, batch=8))
    make, settings = baseline("conv-lstm", catalogue, augmentation=Augmentation(0, (1, 1), 1, noise=0.3, drift=0))
    assert settings["epochs"] == 15
    evaluated = [noise(stream, 0.4, 0) for _, stream in TEST]
    plain, tough = (make(TRAIN, augmented, silent) for augmented in (False, True))
    shares = [accuracy([name for name, _ in TEST], list(system.predict(evaluated))) for system in (plain, tough)]
    assert shares[1] > shares[0]
    clean = [stream for _, stream in TEST]
    assert list(make(TRAIN, True, silent).predict(clean)) == list(tough.predict(clean))


def test_some_touches_stay_as_they_were_recorded():
    stream = SCENE.touch("felt", 0)

    def same(item):
        return len(item) == len(stream) and np.allclose(item.readings, stream.readings, rtol=0, atol=1e-3)

    for share, (least, most) in {0.0: (1, 1), 0.3: (0.5, 0.9), 1.0: (0, 0)}.items():
        made = Sometimes(share=share).streams([stream] * 60, np.random.default_rng(0))
        assert least <= np.mean([same(item) for item in made]) <= most


def test_systems_that_are_no_baselines_are_refused():
    assert BASELINES == ("svm", "svm-spikes", "conv-lstm", "snn", "resnet", "resnet-pretrained")
    with pytest.raises(InputError, match="came 'kernels-lda'"):
        baseline("kernels-lda", Catalogue())

"""A memory as an ONNX file that says what `predict` says."""

import json
import math

import numpy as np
import pytest

from scroll_tactile import Joined, Kernels, Sensor, TactileLearner, Vision, sensors
from scroll_tactile.clients.learning.onnx_export import export_onnx
from scroll_tactile.errors import InputError
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.simulation.scene import Scene

pytest.importorskip("onnx", reason="onnx is not installed")
runtime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")

VISION = Vision(None, seed=0, stages=(1, 2))
SLOW = Sensor(name="slow", channels=8, rate=10.0, low=0.0, high=1.0, unit="N", duration=4.0)


def trained(sensor, embedding=VISION, readout="lda", seconds=None):
    scene = Scene(sensor=sensor)
    learner = TactileLearner(sensor=sensor, embedding=embedding, readout=readout)
    for at in range(3):
        for name in scene.materials[:4]:
            touch = scene.touch(name, at)
            learner.observe(name, touch if seconds is None else touch.first(seconds))
    return learner, scene


def exported(learner, path):
    export_onnx(learner, path)
    return runtime.InferenceSession(path, providers=["CPUExecutionProvider"])


@pytest.mark.parametrize(("sensor", "readout"), [(sensors.ROBOSKIN, "ridge"), (SLOW, "lda")])
def test_it_says_what_predict_says(sensor, readout, tmp_path):
    learner, scene = trained(sensor, readout=readout)
    session = exported(learner, tmp_path / "memory.onnx")
    materials = json.loads(session.get_modelmeta().custom_metadata_map["materials"])
    assert materials == list(learner.materials)
    for name in scene.materials[:2]:
        touch = scene.touch(name, 9)
        (scores,) = session.run(["scores"], {"image": tactile_image(touch)})
        assert scores.dtype == np.float32
        said = dict(learner.predict(touch).ranking)
        for material, score in zip(materials, scores.tolist(), strict=True):
            # Two float32 networks: on real touches and full memories 8e-6 was measured, 4e-4 of the scores.
            assert abs(math.exp(score) - said[material]) < 1e-5
            if said[material] > 0:
                assert score == pytest.approx(math.log(said[material]), abs=1e-3)


@pytest.mark.parametrize(
    "embedding",
    [Kernels(dimension=64), Joined(Kernels(dimension=64), VISION), Vision(None, seed=0, precision="bfloat16")],
    ids=["kernels", "joined", "bfloat16"],
)
def test_other_embeddings_are_refused(embedding, tmp_path):
    with pytest.raises(InputError, match="only memories of a Vision embedding"):
        export_onnx(TactileLearner(sensor=sensors.ROBOSKIN, embedding=embedding), tmp_path / "memory.onnx")


def test_an_empty_memory_is_refused(tmp_path):
    with pytest.raises(InputError, match="this one is empty"):
        export_onnx(TactileLearner(sensor=sensors.ROBOSKIN, embedding=VISION), tmp_path / "memory.onnx")
    assert not (tmp_path / "memory.onnx").exists()


def test_a_material_observed_only_briefly_is_named(tmp_path):
    learner, scene = trained(SLOW)
    learner.observe("brief", scene.touch(scene.materials[0], 5).first(0.5))
    with pytest.raises(InputError, match="'brief' was only observed briefly"):
        export_onnx(learner, tmp_path / "memory.onnx")


def test_it_reads_no_further_than_was_learned(tmp_path):
    learner, scene = trained(sensors.ROBOSKIN, seconds=1.2)
    session = exported(learner, tmp_path / "memory.onnx")
    touch = scene.touch(scene.materials[1], 9)
    (scores,) = session.run(None, {"image": tactile_image(touch)})
    said = dict(learner.predict(touch).ranking)
    assert np.allclose(np.exp(scores), [said[name] for name in learner.materials], atol=1e-5)

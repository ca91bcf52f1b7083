"""What runs the network: the same features in each, the same bytes from one."""

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from images import image

from scroll_tactile import Vision
from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.embeddings.runtimes import make_runtime, network_model, steady
from scroll_tactile.errors import InputError
from scroll_tactile.testing import check_embedding

STATE = ResNet.random(0).state_dict()


def vision(runtime, **settings):
    if runtime != "torch":
        pytest.importorskip(runtime, reason=f"{runtime} is not installed, and needed by few")
        pytest.importorskip("onnx", reason="onnx is not installed")
    return Vision(STATE, runtime=runtime, **settings)


def test_onnxruntime_gives_torchs_features_for_any_size():
    ours, theirs = vision("onnxruntime", stages=(0, 1, 2, 3, 4)), Vision(STATE, stages=(0, 1, 2, 3, 4))
    for channels, columns in ((19, 60), (19, 9), (1, 1)):
        assert np.abs(ours.embed(image(channels, columns)) - theirs.embed(image(channels, columns))).max() < 1e-5
    assert ours.fingerprint != theirs.fingerprint
    check_embedding(ours, channels=(9,), columns=(9, 30))
    batch = [image(19, 30), image(19, 30) / 2]
    assert np.abs(ours.embed_bulk(batch) - np.stack([ours.embed(each) for each in batch])).max() < 1e-5


def test_bfloat16_is_close_to_float32():
    short = Vision(STATE, precision="bfloat16")
    error = np.linalg.norm(short.embed(image(19, 100)) - Vision(STATE).embed(image(19, 100)))
    assert 1e-5 < error < 0.05


@pytest.mark.parametrize(("depth", "stem"), [(50, "torchvision"), (18, "universal")])
def test_the_graph_is_the_network_in_other_arrangements_too(depth, stem):
    pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    net = ResNet.random(1, depth, stem)
    planes = np.random.default_rng(0).standard_normal((2, 3, 19, 33)).astype(np.float32)
    maps, truth = make_runtime("onnxruntime", net, 4)(planes), make_runtime("torch", net, 4)(planes)
    assert [each.shape for each in maps] == [each.shape for each in truth]
    assert all(np.allclose(a, b, atol=1e-4 * np.abs(b).max()) for a, b in zip(maps, truth, strict=True))
    assert len(make_runtime("onnxruntime", net, 0)(planes)) == 1


def test_graphs_are_made_in_several_threads_at_once():
    """torch's exporter refuses a second trace beside the first."""
    pytest.importorskip("onnx", reason="onnx is not installed")
    net = ResNet.random(0)
    with ThreadPoolExecutor(3) as pool:
        made = list(pool.map(lambda _: network_model(net, 1), range(3)))
    assert made == made[:1] * 3


def test_what_no_runtime_has_is_refused():
    with pytest.raises(InputError, match="ONNX Runtime has no bfloat16"):
        Vision(STATE, runtime="onnxruntime", precision="bfloat16")
    with pytest.raises(InputError, match=r"among \['torch', 'onnxruntime'\] .*came 'openvino'"):
        Vision(STATE, runtime="openvino")


@pytest.mark.parametrize("package", ["onnxruntime", "onnx"])
def test_a_missing_package_is_named_with_its_extra(monkeypatch, package):
    if package == "onnx":
        pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf"(?s)needs {package}, which is not installed.*\[onnx\]"):
        Vision(STATE, runtime="onnxruntime")


def test_steady_gives_back_what_it_changed():
    threads, precision = torch.get_num_threads(), torch.get_float32_matmul_precision()
    try:
        torch.set_num_threads(2)
        torch.set_float32_matmul_precision("high")
        with pytest.raises(KeyError), steady():
            assert torch.get_num_threads() == 1
            assert torch.get_float32_matmul_precision() == "highest"
            raise KeyError
        assert (torch.get_num_threads(), torch.get_float32_matmul_precision()) == (2, "high")
    finally:
        torch.set_num_threads(threads)
        torch.set_float32_matmul_precision(precision)

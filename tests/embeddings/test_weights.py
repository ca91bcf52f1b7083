"""Weights from files that are whole, damaged, hostile, another architecture's, or out of reach."""

import contextlib
import hashlib
import os
import pickle

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from scroll_tactile.embeddings import weights
from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.embeddings.weights import load_network
from scroll_tactile.errors import WeightsError


@pytest.fixture(scope="module")
def net():
    return ResNet.random(0)


@pytest.fixture
def state(net):
    return dict(net.state_dict())


def same(one, other):
    mine, theirs = one.state_dict(), other.state_dict()
    return mine.keys() == theirs.keys() and all(torch.equal(mine[name], theirs[name]) for name in mine)


def refusal(source):
    with pytest.raises(WeightsError) as caught:
        load_network(source)
    return str(caught.value)


@pytest.mark.parametrize("suffix", ["safetensors", "pth"])
def test_every_value_is_read_under_its_own_name_and_in_its_own_place(net, tmp_path, suffix):
    """Each value differs from all others, so that no exchange or transposition reads the same."""
    expected = {}
    for number, (name, tensor) in enumerate(sorted(net.state_dict().items())):
        values = number + np.linspace(0.25, 0.75, tensor.numel(), dtype=np.float64).reshape(tuple(tensor.shape))
        expected[name] = values if tensor.is_floating_point() else np.full(tuple(tensor.shape), number)
    written = {name: torch.tensor(values).to(net.state_dict()[name].dtype) for name, values in expected.items()}
    path = tmp_path / f"weights.{suffix}"
    head = {"fc.weight": torch.zeros(10, 512), "fc.bias": torch.zeros(10)}
    save_file(written | head, path) if suffix == "safetensors" else torch.save(written | head, path)
    held, network = weights.read_tensors(path), load_network(str(path))
    loaded = network.state_dict()
    assert (network.stem, network.training) == ("torchvision", False)
    assert held.keys() == (expected | head).keys()
    for name, values in expected.items():
        assert held[name].numpy().tobytes() == written[name].numpy().tobytes(), name
        if not name.endswith("num_batches_tracked"):
            np.testing.assert_array_equal(loaded[name].numpy(), values.astype(np.float32), err_msg=name)


def test_a_checkpoint_of_universal_representations_is_read(tmp_path):
    net = ResNet.random(1, "universal")
    inside = {f"module.{name}": tensor for name, tensor in net.state_dict().items()}
    inside |= {"cls_fn.weight": torch.zeros(512, 64), "cls_fn.scale": torch.tensor(10.0)}
    checkpoint = {
        "epoch": 7,
        "args": {"model.name": "url", "train.optimizer": "momentum"},
        "state_dict": inside,
        "best_val_acc": np.float64(63.2),  # what its training code leaves: a NumPy scalar
        "best_val_loss": np.float32(1.5),
    }
    torch.save(checkpoint, tmp_path / "model_best.pth.tar")
    loaded = load_network(tmp_path / "model_best.pth.tar")
    assert loaded.stem == "universal" and same(loaded, net)


def test_half_precision_is_read_as_float32(net, state):
    halves = {name: t.half() if t.is_floating_point() else t for name, t in state.items()}
    loaded = load_network(halves)
    halves["conv1.weight"].zero_()  # what was given was copied
    assert loaded.conv1.weight.dtype == torch.float32
    assert torch.equal(loaded.conv1.weight, net.conv1.weight.half().float())


def test_what_is_missing_or_left_over_is_named(state):
    del state["layer3.1.bn2.running_mean"]
    assert "ResNet-18" in refusal(state)
    assert "lacks layer3.1.bn2.running_mean" in refusal(state)
    state["layer3.1.bn2.running_mean"] = torch.zeros(256)
    state["attention.weight"] = torch.zeros(3)
    assert "also has attention.weight" in refusal(state)


def test_a_tensor_of_another_shape_or_type_is_named(state):
    state["layer2.0.conv1.weight"] = torch.zeros(128, 64, 5, 5)
    message = refusal(state)
    assert "layer2.0.conv1.weight" in message
    assert "(128, 64, 5, 5)" in message
    assert "(128, 64, 3, 3)" in message
    state["layer2.0.conv1.weight"] = torch.zeros(128, 64, 3, 3, dtype=torch.int32)
    assert "torch.int32" in refusal(state)


@pytest.mark.parametrize(
    ("name", "value"), [("layer1.0.conv1.weight", np.nan), ("bn1.running_var", -1.0), ("bn1.bias", 1e300)]
)
def test_values_that_cannot_be_are_refused(state, name, value):
    state[name] = state[name].double()  # 1e300 overflows float32
    state[name].view(-1)[3] = value
    message = refusal(state)
    assert name in message
    assert "NaN, infinite or impossible" in message


@pytest.mark.parametrize(
    "tensors",
    [
        {},
        {"conv1.weight": torch.zeros(64, 3, 3, 3)},
        {"patch_embed.proj.weight": torch.zeros(768, 3, 16, 16)},
        {"conv1.weight": torch.zeros(64, 3, 7, 7), "layer3.22.conv3.weight": torch.zeros(1)},
    ],
    ids=["nothing", "a small stem", "a transformer", "a ResNet-101"],
)
def test_another_architecture_is_refused(tensors):
    assert "expected in the given state dict a ResNet-18" in refusal(tensors)
    assert "epoch are none" in refusal({"epoch": 3})


class Hostile:
    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return (os.mkdir, (str(self.mark),))


@pytest.mark.parametrize("how", ["torch", "pickle"])
def test_a_pickle_that_would_execute_is_refused_and_not_executed(tmp_path, how):
    path, mark = tmp_path / "weights.pth", tmp_path / "executed"
    held = {"conv1.weight": torch.zeros(3), "more": Hostile(mark)}
    if how == "torch":
        torch.save(held, path)
    else:
        path.write_bytes(pickle.dumps(held, protocol=2))
    message = refusal(path)
    assert "execute code" in message
    assert str(path) in message
    assert not mark.exists()


@pytest.mark.parametrize("suffix", ["safetensors", "pth"])
@pytest.mark.parametrize("keep", [0.0, 0.5, 0.999])
def test_a_file_cut_off_or_of_something_else_is_refused(state, tmp_path, suffix, keep):
    path = tmp_path / f"weights.{suffix}"
    small = {name: state[name] for name in ("conv1.weight", "bn1.weight", "layer1.0.conv1.weight")}
    save_file(small, path) if suffix == "safetensors" else torch.save(small, path)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])
    assert str(path) in refusal(path)
    path.write_text("<html>404 not found</html>" * 20)
    assert str(path) in refusal(path)
    torch.save([1, 2, 3], tmp_path / "list.pth")
    assert "holds a list" in refusal(tmp_path / "list.pth")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SCROLL_TACTILE_CACHE", str(tmp_path))
    return tmp_path / "weights"


def test_a_file_that_is_not_there_or_damaged_is_said_to_be(tmp_path, cache):
    message = refusal(tmp_path / "none.pth")
    assert f"there is none at {tmp_path / 'none.pth'}" in message and "resnet18" in message
    cache.mkdir()
    (cache / "resnet18-f37072fd.pth").write_bytes(b"half")
    message = refusal("resnet18")
    assert "is damaged" in message and "f37072fd" in message and "Delete it" in message


def test_without_a_network_it_says_where_to_put_the_file(cache, monkeypatch):
    def unreachable(url, path, expected, progress):
        assert (path, expected) == (str(cache / "resnet18-f37072fd.pth"), "f37072fd")
        raise ConnectionError("Name or service not known")

    monkeypatch.setattr(torch.hub, "download_url_to_file", unreachable)
    message = refusal("resnet18")
    assert "https://download.pytorch.org/models/resnet18-f37072fd.pth" in message
    assert f"Put that file at {cache / 'resnet18-f37072fd.pth'} by hand" in message
    assert "Name or service not known" in message


def test_published_weights_are_fetched_once(cache, state, monkeypatch, tmp_path):
    torch.save(state, tmp_path / "published.pth")
    digest = hashlib.sha256((tmp_path / "published.pth").read_bytes()).hexdigest()
    file = (tmp_path / "published.pth").rename(tmp_path / f"resnet18-{digest[:8]}.pth")
    monkeypatch.setattr(weights, "PUBLISHED", {"resnet18": file.as_uri()})
    assert load_network("resnet18").stem == "torchvision"
    file.unlink()
    assert load_network("resnet18").stem == "torchvision"


def test_a_file_with_any_byte_changed_is_refused_or_read_but_never_fails_otherwise(tmp_path):
    rng = np.random.default_rng(0)
    tensors = {"conv1.weight": torch.zeros(4, 3, 7, 7)}
    for zipped in (True, False):
        path = tmp_path / "some.pth"
        torch.save(tensors, path, _use_new_zipfile_serialization=zipped)
        whole = path.read_bytes()
        for _ in range(100):
            damaged = bytearray(whole)
            damaged[rng.integers(min(len(whole), 600))] = rng.integers(256)
            path.write_bytes(bytes(damaged))
            with contextlib.suppress(WeightsError):
                weights.read_tensors(path)


def test_a_file_that_holds_itself_is_refused(tmp_path):
    held = {}
    held["model"] = held
    torch.save(held, tmp_path / "w.pth")
    with pytest.raises(WeightsError, match="model are none"):
        load_network(tmp_path / "w.pth")


@pytest.mark.parametrize("make", [lambda tensor: tensor.to_sparse(), lambda tensor: tensor.to("meta")])
def test_tensors_without_values_in_their_places_are_refused(state, tmp_path, make):
    torch.save(state | {"conv1.weight": make(state["conv1.weight"])}, tmp_path / "w.pth")
    with pytest.raises(WeightsError, match=r"conv1\.weight"):
        load_network(tmp_path / "w.pth")

"""The networks: shapes for any image, torchvision's names, folding, and randomness that disturbs nothing."""

import numpy as np
import pytest
import torch
from torch.nn import functional

from scroll_tactile.embeddings.resnet import ResNet, folded

SIZES = [(19, 9), (3, 3), (30, 75)]


def planes(rows, columns, count=1, seed=0):
    return torch.randn(count, 3, rows, columns, generator=torch.Generator().manual_seed(seed))


def lively(net, seed=1):
    """Give batch normalisation statistics of its own, so that folding has something to fold."""
    generator = torch.Generator().manual_seed(seed)
    for name, tensor in net.state_dict().items():
        if "running_mean" in name or (("bn" in name or "downsample.1" in name) and name.endswith("bias")):
            tensor.normal_(0.0, 0.1, generator=generator)
        elif "running_var" in name or (("bn" in name or "downsample.1" in name) and name.endswith("weight")):
            tensor.uniform_(0.5, 1.5, generator=generator)
    return net


def by_hand(state, image, name, stride, padding):
    """Convolution and batch normalisation as their definitions say, in double precision."""
    conv, norm = name
    out = functional.conv2d(image, state[f"{conv}.weight"].double(), stride=stride, padding=padding)
    scale = state[f"{norm}.weight"].double() / torch.sqrt(state[f"{norm}.running_var"].double() + 1e-5)
    shift = state[f"{norm}.bias"].double() - state[f"{norm}.running_mean"].double() * scale
    return out * scale[:, None, None] + shift[:, None, None]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("stem", ["torchvision", "universal"])
def test_every_stage_halves_what_it_should_for_any_image(size, stem):
    net = ResNet.random(0, stem)
    with torch.no_grad():
        maps = net(planes(*size))
    half = [(s + 1) // 2 if stem == "torchvision" else (s - 3) // 2 + 1 for s in size]
    assert list(maps[0].shape) == [1, 64, *half]
    quarter = [(s + 1) // 2 for s in half] if stem == "torchvision" else half
    for stage in range(1, 5):
        assert list(maps[stage].shape) == [1, net.widths[stage], *quarter]
        quarter = [(s + 1) // 2 for s in quarter]


def test_the_first_stages_are_what_their_definition_says():
    net = lively(ResNet.random(3))
    state, image = net.state_dict(), planes(19, 31)
    stem = torch.relu(by_hand(state, image.double(), ("conv1", "bn1"), 2, 3))
    pooled = functional.max_pool2d(stem, 3, 2, 1)
    for block in ("layer1.0", "layer1.1"):
        inner = torch.relu(by_hand(state, pooled, (f"{block}.conv1", f"{block}.bn1"), 1, 1))
        pooled = torch.relu(by_hand(state, inner, (f"{block}.conv2", f"{block}.bn2"), 1, 1) + pooled)
    inner = torch.relu(by_hand(state, pooled, ("layer2.0.conv1", "layer2.0.bn1"), 2, 1))
    shortcut = by_hand(state, pooled, ("layer2.0.downsample.0", "layer2.0.downsample.1"), 2, 0)
    block = torch.relu(by_hand(state, inner, ("layer2.0.conv2", "layer2.0.bn2"), 1, 1) + shortcut)
    with torch.no_grad():
        maps = net(image, last=1)
        first = net.layer2[0](maps[1])
    assert len(maps) == 2
    for ours, theirs in ((maps[0], stem), (maps[1], pooled), (first, block)):
        assert torch.allclose(ours.double(), theirs, atol=1e-4)


def test_tensors_are_torchvisions():
    names = set(ResNet.random(0).state_dict())
    assert len(names) == 120  # torchvision's own number, less the two of its classifier
    assert {"conv1.weight", "bn1.running_var", "layer2.0.downsample.1.bias", "layer4.1.conv2.weight"} <= names


@pytest.mark.parametrize("stem", ["torchvision", "universal"])
def test_folding_changes_only_the_rounding(stem):
    net = lively(ResNet.random(2, stem))
    before = {name: tensor.clone() for name, tensor in net.state_dict().items()}
    quick = folded(net, 3)
    with torch.inference_mode():
        for plain, fast in zip(net(planes(21, 40), 3), quick(planes(21, 40), 3), strict=True):
            assert (plain - fast).abs().max() <= 1e-5 * plain.abs().max()
    assert not any("bn" in name or "layer4" in name for name in quick.state_dict())
    assert all(torch.equal(tensor, before[name]) for name, tensor in net.state_dict().items())


def test_a_seed_gives_one_network_and_leaves_torchs_generator_alone():
    torch.manual_seed(7)
    expected = torch.rand(3)
    torch.manual_seed(7)
    one, again, other = ResNet.random(5), ResNet.random(5), ResNet.random(6)
    assert torch.equal(torch.rand(3), expected)
    assert all(torch.equal(a, b) for a, b in zip(one.state_dict().values(), again.state_dict().values(), strict=True))
    assert not torch.equal(one.conv1.weight, other.conv1.weight)
    weights = one.layer3[1].conv2.weight
    assert np.isclose(weights.std().item(), np.sqrt(2 / (256 * 9)), rtol=0.02)

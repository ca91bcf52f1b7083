"""What a first block looks for: images that excite their unit, and figures that tell networks apart."""

import copy
import math

import numpy as np
import pytest
import torch

from examples.paper.studies.activation import cka, compare, first_block, maximise
from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.errors import InputError


@pytest.fixture(scope="module")
def net():
    return ResNet.random(0)


@pytest.fixture(scope="module")
def images(net):
    return maximise(net, seed=1, steps=8, size=24)


def excitement(net, images):
    with torch.inference_mode():
        return first_block(net, torch.from_numpy(images)).mean(dim=(2, 3)).numpy()


def test_each_image_excites_its_own_unit_more_than_noise_does(net, images):
    noise = np.random.default_rng(1).standard_normal(images.shape, dtype=np.float32)
    own = np.arange(len(images))
    found, before = excitement(net, images)[own, own], excitement(net, noise)[own, own]
    assert images.shape == (64, 3, 24, 24)
    assert np.mean(found > 2 * before) > 0.9
    # And more than the images of other units do.
    assert np.mean(found > np.median(excitement(net, images), axis=0)) > 0.95
    assert images.mean(axis=(1, 2, 3)) == pytest.approx(np.zeros(64), abs=1e-5)
    assert images.std(axis=(1, 2, 3)) == pytest.approx(np.ones(64), rel=1e-4)


def test_the_seed_decides_and_nothing_else_is_touched(net, images):
    weights = {name: tensor.clone() for name, tensor in net.state_dict().items()}
    state = torch.random.get_rng_state()
    report = []
    again = maximise(net, seed=1, steps=8, size=24, report=lambda done, of: report.append((done, of)))
    assert again.tobytes() == images.tobytes()
    assert maximise(net, seed=2, steps=1, size=24).tobytes() != maximise(net, seed=1, steps=1, size=24).tobytes()
    assert torch.equal(torch.random.get_rng_state(), state)
    assert all(torch.equal(tensor, weights[name]) for name, tensor in net.state_dict().items())
    assert report == [(step, 8) for step in range(1, 9)]


def test_alignment_does_not_see_turns_and_scales_and_sees_everything_else():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(400, 5))
    turn, _ = np.linalg.qr(rng.normal(size=(5, 5)))
    assert cka(rows, 3 * rows @ turn + 7) == pytest.approx(1)
    assert cka(rows, rng.normal(size=(400, 5))) < 0.1
    assert 0.3 < cka(rows, np.hstack([rows[:, :2], rng.normal(size=(400, 3))])) < 0.8
    assert math.isnan(cka(rows, np.ones((400, 2))))
    for other in (rows[:-1], rows[:1]):
        with pytest.raises(InputError, match="the same 2 rows or more"):
            cka(other[:1] if len(other) == 1 else rows, other)


def moved(net, way, by):
    other = copy.deepcopy(net)
    with torch.no_grad():
        other.conv1.weight += by * way
    return other


def test_filters_that_moved_the_same_way_are_distinguished_from_those_that_did_not(net):
    generator = torch.Generator().manual_seed(5)  # not 0: the network's own numbers
    ways = [torch.randn(net.conv1.weight.shape, generator=generator) * net.conv1.weight.std() for _ in range(2)]
    networks = {
        "start": net,
        "a": moved(net, ways[0], 0.1),
        "further": moved(net, ways[0], 0.2),
        "b": moved(net, ways[1], 0.1),
        "other": ResNet.random(9),
    }
    images = [np.random.default_rng(i).uniform(-1, 1, (19, 60)).astype(np.float32) for i in range(3)]
    found = {(pair.one, pair.two): pair for pair in compare(networks, images, start="start")}
    assert len(found) == 10
    assert math.isnan(found["start", "a"].moved)
    assert found["a", "further"].moved == pytest.approx(1, abs=1e-3)
    assert abs(found["a", "b"].moved) < 0.1
    assert found["start", "a"].filters > found["start", "further"].filters > 0.9
    assert abs(found["start", "other"].filters) < 0.1
    assert found["start", "a"].blocks > 0.95 > found["start", "other"].blocks
    assert all(math.isnan(pair.moved) for pair in compare(networks, images))
    # Published weights have filters of zeros: they point nowhere, and say nothing.
    with torch.no_grad():
        networks["a"].conv1.weight[3] = 0.0
    again = {(pair.one, pair.two): pair for pair in compare(networks, images, start="start")}
    assert 0.9 < again["start", "a"].filters < 1


def test_nothing_to_compare_is_refused(net):
    image = np.zeros((3, 40), np.float32)
    for networks, images, start in (({"a": net}, [image], None), ({"a": net, "b": net}, [], None)):
        with pytest.raises(InputError, match="expected two networks or more"):
            compare(networks, images, start=start)
    with pytest.raises(InputError, match="'c'"):
        compare({"a": net, "b": net}, [image], start="c")

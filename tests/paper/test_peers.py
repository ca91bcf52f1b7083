"""Peers against brute force, dense truth and scikit-learn, on features drawn at random and on simulated touches."""

from functools import partial

import numpy as np
import pytest

from examples.paper.runs.cached import Cached
from examples.paper.studies.peers import (
    ACIL,
    NearestMean,
    NearestNeighbour,
    RanPAC,
    StreamingLDA,
    touch_features,
)
from examples.paper.studies.peers_replay import GDumb, Replaying
from scroll_tactile import Kernels, sensors
from scroll_tactile.embeddings.protocol import embed_windows
from scroll_tactile.errors import InputError
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.simulation.scene import Scene

NAMES = ("felt", "oak", "silk", "wool")


def blobs(count=10, dimension=6, seed=0):
    """Touches of four materials, one material after the other."""
    random = np.random.default_rng(seed)
    means = random.normal(0, 1.5, (len(NAMES), dimension))
    mixing = random.normal(0, 0.5, (dimension, dimension))
    rows = np.concatenate([mean + random.normal(0, 1, (count, dimension)) @ mixing for mean in means])
    return rows, [name for name in NAMES for _ in range(count)]


def trained(peer, rows, names):
    for i, (row, name) in enumerate(zip(rows, names, strict=True)):
        peer.observe(row, name)
        if i + 1 == len(names) or names[i + 1] != name:
            peer.boundary()
    return peer


def share(predicted, names):
    return np.mean([true == guess for true, guess in zip(predicted, names, strict=True)])


def unit(rows):
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def lifted(rows):
    """What RanPAC and ACIL of seed 3 and 20 features see."""
    return np.maximum(rows @ np.random.default_rng([3, 1]).standard_normal((6, 20)), 0)


def test_the_nearest_mean_is_scikit_learns():
    neighbors = pytest.importorskip("sklearn.neighbors")
    (rows, names), (fresh, _) = blobs(), blobs(count=30)
    expected = neighbors.NearestCentroid().fit(unit(rows), names).predict(unit(fresh))
    assert trained(NearestMean(), rows, names).predict(fresh) == expected.tolist()


def test_the_nearest_neighbour_has_the_largest_cosine_of_all_touches():
    (rows, names), (fresh, _) = blobs(), blobs(seed=1)
    expected = [names[i] for i in (fresh @ unit(rows).T).argmax(axis=1)]
    assert trained(NearestNeighbour(), rows, names).predict(fresh) == expected


def test_streaming_lda_is_the_recursion_taken_literally():
    rows, names = blobs()
    covariance, means, counts = np.zeros((6, 6)), {}, {}
    peer = StreamingLDA()
    for k, (row, name) in enumerate(zip(rows, names, strict=True)):
        residual = (row - means.get(name, row))[:, None]
        covariance = (k * covariance + k / (k + 1) * residual @ residual.T) / (k + 1)
        counts[name] = counts.get(name, 0) + 1
        means[name] = means.get(name, row) + residual[:, 0] / counts[name]
        peer.observe(row, name)
        if k % 7 == 0:  # read in between, it sums its block: nothing may change
            np.testing.assert_allclose(peer.covariance, covariance, atol=1e-12)
    np.testing.assert_allclose(peer.covariance, covariance, rtol=1e-10)
    fresh, _ = blobs(count=20)
    precision = np.linalg.pinv((1 - 1e-4) * covariance + 1e-4 * np.eye(6))
    stacked = np.stack([means[name] for name in NAMES])
    truth = fresh @ precision @ stacked.T - 0.5 * np.diag(stacked @ precision @ stacked.T)
    np.testing.assert_allclose(peer.scores(fresh), truth, rtol=1e-8)


def penalty(peer):
    """RanPAC chooses its own; ACIL was given one."""
    return peer.penalty if isinstance(peer, RanPAC) else 0.1


@pytest.mark.parametrize("make", [RanPAC, partial(ACIL, penalty=0.1)])
def test_ridge_on_all_touches_whatever_is_asked_in_between(make):
    rows, names = blobs()
    peer, asked = trained(make(seed=3, size=20), rows, names), make(seed=3, size=20)
    features, targets = lifted(rows), np.eye(4)[[NAMES.index(name) for name in names]]
    weights = np.linalg.solve(features.T @ features + penalty(peer) * np.eye(20), features.T @ targets)
    np.testing.assert_allclose(peer.scores(rows), features @ weights, rtol=1e-6, atol=1e-8)
    for i in range(40):  # an answer within a task does not end it
        asked.observe(rows[i], names[i])
        if i % 10 == 9:
            asked.boundary()
        asked.scores(rows[:1])
    assert penalty(asked) == penalty(peer)
    np.testing.assert_allclose(asked.scores(rows), peer.scores(rows), rtol=1e-6, atol=1e-8)


def test_the_penalty_of_ranpac_is_of_the_last_task_alone():
    rows, names = blobs()
    features, targets, losses = lifted(rows[30:]), np.eye(4)[[3] * 10], []
    for penalty in 10.0 ** np.arange(-8, 9):
        system = features[:8].T @ features[:8] + penalty * np.eye(20)
        found = features[8:] @ np.linalg.solve(system, features[:8].T @ targets[:8])
        losses.append(np.square(found - targets[8:]).mean())
    assert trained(RanPAC(seed=3, size=20), rows, names).penalty == 10.0 ** (np.argmin(losses) - 8)


def test_the_buffer_of_gdumb_is_balanced_and_never_too_large():
    peer = GDumb(10)
    for row, name in zip(*blobs(), strict=True):
        peer.observe(row, name)
        assert sum(peer.held.values()) <= 10
    assert sorted(peer.held.values()) == [2, 2, 3, 3]


def test_replaying_without_a_buffer_forgets_and_with_one_less():
    rows, names = blobs(count=30, dimension=20)
    naive, replaying = (share(trained(Replaying(size), rows, names).predict(rows), names) for size in (0, 40))
    assert naive < replaying > 0.5


def test_a_seed_repeats_and_the_global_generator_is_left_alone():
    rows, names = blobs()
    before = np.random.get_state()[1].tolist()  # noqa: NPY002 (what must not be touched)
    scores = [trained(make(5, 1), rows, names).scores(rows) for make in (Replaying, Replaying, GDumb, GDumb)]
    assert np.random.get_state()[1].tolist() == before  # noqa: NPY002
    np.testing.assert_array_equal(scores[0], scores[1])
    np.testing.assert_array_equal(scores[2], scores[3])


PEERS = {
    "nearest neighbour": NearestNeighbour,
    "nearest mean": NearestMean,
    "streaming LDA": StreamingLDA,
    "RanPAC": lambda: RanPAC(size=200),
    "ACIL": lambda: ACIL(size=200),
    "GDumb": lambda: GDumb(12),
    "replay": lambda: Replaying(12),
}


@pytest.fixture(scope="module")
def touches():
    """Features of six touches to learn and three to test, of each material."""
    scene = Scene(sensors.ROBOSKIN)
    parts = ([scene.touch(name, i) for name in NAMES for i in places] for places in (range(6), range(6, 9)))
    return [touch_features(Kernels(dimension=128), part) for part in parts]


@pytest.mark.parametrize("make", PEERS.values(), ids=PEERS)
def test_peers_beat_chance_on_touches(make, touches):
    peer = trained(make(), touches[0], [name for name in NAMES for _ in range(6)])
    assert share(peer.predict(touches[1]), [name for name in NAMES for _ in range(3)]) > 0.5


@pytest.mark.parametrize("make", PEERS.values(), ids=PEERS)
def test_a_peer_that_met_nothing_says_so(make):
    with pytest.raises(InputError, match="observe first"):
        make().predict(np.zeros((1, 3)))


def test_a_touch_is_the_mean_of_its_widest_windows():
    scene, embedding = Scene(sensors.ROBOSKIN), Kernels(dimension=64)
    whole, short = scene.touch("silk", 0), scene.touch("silk", 0, seconds=0.3)
    image = tactile_image(whole)
    windows = [embedding.embed(np.ascontiguousarray(image[:, i : i + 56])) for i in (0, 9, 18)]
    ours = touch_features(embedding, [whole, short])
    np.testing.assert_allclose(ours[0], np.mean(windows, axis=0, dtype=np.float64), rtol=1e-6)
    np.testing.assert_array_equal(ours[1], embedding.embed_windows(tactile_image(short), {56: [0]})[56][0])


def test_what_is_cached_are_the_bytes_and_each_touch_is_embedded_once(monkeypatch):
    embedding, calls, plain = Kernels(dimension=64), [], Kernels.embed_windows
    cached = Cached(embedding)
    monkeypatch.setattr(Kernels, "embed_windows", lambda *words: calls.append(1) or plain(*words))
    images = [tactile_image(Scene(sensors.BIOTAC).touch("silk", i)) for i in range(2)]
    for _ in range(3):
        for image in images:
            for windows in ({30: [0, 5], 300: [0]}, {30: [0]}):
                ours, truth = embed_windows(cached, image, windows), plain(embedding, image, windows)
                assert {w: f.tobytes() for w, f in ours.items()} == {w: f.tobytes() for w, f in truth.items()}
    assert (len(calls), cached.held) == (4, 6)  # 30: [0] is not 30: [0, 5]
    with pytest.raises(ValueError, match="read-only"):
        ours[30][0] = 0

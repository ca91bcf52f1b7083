"""Peers against brute force, dense truth and scikit-learn, on features drawn at random and on simulated touches."""

import numpy as np
import pytest

from examples.paper.runs.cached import Cached
from examples.paper.studies.peers import (
    ACIL,
    ContinualPeer,
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


def blobs(count: int = 10, dimension: int = 6, seed: int = 0) -> tuple[np.ndarray, list[str]]:
    """Touches of four materials, one material after the other."""
    random = np.random.default_rng(seed)
    means = random.normal(0, 1.5, (len(NAMES), dimension))
    mixing = random.normal(0, 0.5, (dimension, dimension))
    rows = np.concatenate([mean + random.normal(0, 1, (count, dimension)) @ mixing for mean in means])
    return rows, [name for name in NAMES for _ in range(count)]


def trained(peer: ContinualPeer, rows: np.ndarray, names: list[str]) -> ContinualPeer:
    for i, (row, name) in enumerate(zip(rows, names, strict=True)):
        peer.observe(row, name)
        if i + 1 == len(names) or names[i + 1] != name:
            peer.boundary()
    return peer


def share(predicted: list[str], names: list[str]) -> float:
    return float(np.mean([true == guess for true, guess in zip(predicted, names, strict=True)]))


class TestNearestMean:
    def test_it_is_scikit_learns(self) -> None:
        neighbors = pytest.importorskip("sklearn.neighbors")
        rows, names = blobs()
        fresh, _ = blobs(seed=0, count=30)
        unit = rows / np.linalg.norm(rows, axis=1, keepdims=True)
        truth = neighbors.NearestCentroid().fit(unit, names)
        expected = truth.predict(fresh / np.linalg.norm(fresh, axis=1, keepdims=True))
        assert trained(NearestMean(), rows, names).predict(fresh) == expected.tolist()


class TestStreamingLDA:
    def test_the_recursion_taken_literally(self) -> None:
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


class TestRanPAC:
    def test_the_weights_are_ridge_on_all_tasks(self) -> None:
        rows, names = blobs()
        peer = trained(RanPAC(seed=3, size=20), rows, names)
        projection = np.random.default_rng([3, 1]).standard_normal((6, 20))
        lifted = np.maximum(rows @ projection, 0)
        targets = np.eye(4)[[NAMES.index(name) for name in names]]
        weights = np.linalg.solve(lifted.T @ lifted + peer.penalty * np.eye(20), lifted.T @ targets)
        np.testing.assert_allclose(peer.scores(rows), lifted @ weights, rtol=1e-6, atol=1e-9)

    def test_an_answer_within_a_task_does_not_end_it(self) -> None:
        rows, names = blobs()
        plain, asked = RanPAC(seed=3, size=20), RanPAC(seed=3, size=20)
        for i in range(40):
            for peer in (plain, asked):
                peer.observe(rows[i], names[i])
                if i in (19, 39):
                    peer.boundary()
            asked.scores(rows[:1])
        assert plain.penalty == asked.penalty
        np.testing.assert_array_equal(plain.scores(rows), asked.scores(rows))

    def test_the_penalty_is_of_the_last_task_alone(self) -> None:
        rows, names = blobs()
        peer = trained(RanPAC(seed=3, size=20), rows, names)
        lifted = np.maximum(rows[30:] @ np.random.default_rng([3, 1]).standard_normal((6, 20)), 0)
        targets = np.zeros((10, 4))
        targets[:, 3] = 1
        losses = []
        for penalty in 10.0 ** np.arange(-8, 9):
            system = lifted[:8].T @ lifted[:8] + penalty * np.eye(20)
            losses.append(
                np.square(lifted[8:] @ np.linalg.solve(system, lifted[:8].T @ targets[:8]) - targets[8:]).mean()
            )
        assert peer.penalty == 10.0 ** (np.argmin(losses) - 8)


class TestACIL:
    def test_the_recursion_is_ridge_on_all_touches_whatever_the_tasks(self) -> None:
        rows, names = blobs()
        peer = trained(ACIL(seed=3, size=20, penalty=0.1), rows, names)
        lifted = np.maximum(rows @ np.random.default_rng([3, 1]).standard_normal((6, 20)), 0)
        targets = np.eye(4)[[NAMES.index(name) for name in names]]
        weights = np.linalg.solve(lifted.T @ lifted + 0.1 * np.eye(20), lifted.T @ targets)
        np.testing.assert_allclose(peer.scores(rows), lifted @ weights, rtol=1e-6, atol=1e-8)
        interleaved = ACIL(seed=3, size=20, penalty=0.1)
        for i in range(0, 40, 3):  # asked in the middle of a task, and then some more
            interleaved.observe(rows[i], names[i])
            interleaved.scores(rows[:1])
        for i in set(range(40)) - set(range(0, 40, 3)):
            interleaved.observe(rows[i], names[i])
        assert interleaved.predict(rows) == peer.predict(rows)


class TestNearestNeighbour:
    def test_it_is_the_largest_cosine_of_all_touches(self) -> None:
        rows, names = blobs()
        fresh, _ = blobs(seed=1)
        peer = trained(NearestNeighbour(), rows, names)
        unit = rows / np.linalg.norm(rows, axis=1, keepdims=True)
        assert peer.predict(fresh) == [names[i] for i in (fresh @ unit.T).argmax(axis=1)]


class TestGDumb:
    def test_the_buffer_is_balanced_and_never_too_large(self) -> None:
        rows, names = blobs()
        peer = GDumb(10)
        for i in range(len(rows)):
            peer.observe(rows[i], names[i])
            assert sum(peer.held.values()) <= 10
        assert sorted(peer.held.values()) == [2, 2, 3, 3]


class TestReplaying:
    def test_without_a_buffer_it_forgets_and_with_one_less(self) -> None:
        rows, names = blobs(count=30, dimension=20)
        naive = share(trained(Replaying(0), rows, names).predict(rows), names)
        replaying = share(trained(Replaying(40), rows, names).predict(rows), names)
        assert naive < replaying
        assert replaying > 0.5

    def test_a_seed_repeats_and_the_global_generator_is_left_alone(self) -> None:
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
def touches() -> tuple[np.ndarray, np.ndarray]:
    """Features of six touches to learn and three to test, of each material."""
    scene = Scene(sensors.ROBOSKIN)
    embedding = Kernels(dimension=128)
    learned = [scene.touch(name, i) for name in NAMES for i in range(6)]
    tested = [scene.touch(name, i) for name in NAMES for i in range(6, 9)]
    return touch_features(embedding, learned), touch_features(embedding, tested)


@pytest.mark.parametrize("make", PEERS.values(), ids=PEERS)
def test_peers_beat_chance_on_touches(make, touches) -> None:
    peer = trained(make(), touches[0], [name for name in NAMES for _ in range(6)])
    assert share(peer.predict(touches[1]), [name for name in NAMES for _ in range(3)]) > 0.5


@pytest.mark.parametrize("make", PEERS.values(), ids=PEERS)
def test_a_peer_that_met_nothing_says_so(make) -> None:
    with pytest.raises(InputError, match="observe first"):
        make().predict(np.zeros((1, 3)))


def test_a_touch_is_the_mean_of_its_widest_windows() -> None:
    scene, embedding = Scene(sensors.ROBOSKIN), Kernels(dimension=64)
    whole, short = scene.touch("silk", 0), scene.touch("silk", 0, seconds=0.3)
    image = tactile_image(whole)
    windows = [embedding.embed(np.ascontiguousarray(image[:, i : i + 56])) for i in (0, 9, 18)]
    ours = touch_features(embedding, [whole, short])
    np.testing.assert_allclose(ours[0], np.mean(windows, axis=0, dtype=np.float64), rtol=1e-6)
    np.testing.assert_array_equal(ours[1], embedding.embed_windows(tactile_image(short), {56: [0]})[56][0])


class TestCached:
    def test_the_bytes_are_the_wrapped_ones_and_each_touch_is_embedded_once(self, monkeypatch) -> None:
        embedding = Kernels(dimension=64)
        cached = Cached(embedding)
        calls = []
        plain = Kernels.embed_windows
        monkeypatch.setattr(Kernels, "embed_windows", lambda *words: calls.append(1) or plain(*words))
        images = [tactile_image(Scene(sensors.BIOTAC).touch("silk", i)) for i in range(2)]
        for _ in range(3):
            for image in images:
                for windows in ({30: [0, 5], 300: [0]}, {30: [0]}):
                    ours = embed_windows(cached, image, windows)
                    truth = plain(embedding, image, windows)
                    assert {w: f.tobytes() for w, f in ours.items()} == {w: f.tobytes() for w, f in truth.items()}
        assert (len(calls), cached.held) == (4, 6)  # 30: [0] is not 30: [0, 5]
        with pytest.raises(ValueError, match="read-only"):
            ours[30][0] = 0

"""f*: from exemplars alone, the same bytes whatever the schedule, durable, and never in f's way."""

import copy
import dataclasses
from functools import cache

import numpy as np
import pytest
import torch
from scroll_tactile_store import StoreError
from touches import Windowed

from scroll_tactile import Joined, Kernels, TactileLearner, Vision, errors
from scroll_tactile.embeddings.protocol import TOGETHER, window_plan
from scroll_tactile.finetune import fine_tune as finetune
from scroll_tactile.finetune.network import TouchFeatures, TrainingSample, TunedReader, adapted
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.windows import Scale
from scroll_tactile.simulation.scene import Scene

PAD = Sensor(name="pad", channels=6, rate=100.0, duration=1.0, low=0.0, high=1.0, unit="V")
SCENE = Scene(sensor=PAD)
NAMES = SCENE.materials[:4]

EMBEDDINGS = {
    "kernels": cache(lambda: Kernels(dimension=64)),
    "vision": cache(lambda: Vision(None, seed=0, stages=(1, 2))),
    "kernels+vision": cache(lambda: Joined(Kernels(dimension=64), Vision(None, seed=0, stages=(1,)))),
}
kinds = pytest.mark.parametrize("kind", EMBEDDINGS)
touches = [(name, SCENE.touch(name, i)) for i in range(6) for name in NAMES]


def learned(kind, order=None, path=None, **settings):
    # Kept touches, which f alone compares with, are nine tenths of its fit.
    settings = {"sensor": PAD, "embedding": EMBEDDINGS[kind](), "exemplars": 12, "kept_touches": 0} | settings
    learner = TactileLearner.open(path, **settings) if path else TactileLearner(**settings)
    for i in range(len(touches)) if order is None else order:
        learner.observe(*touches[i])
    return learner


@kinds
def test_any_schedule_gives_the_same_buffer_and_with_the_same_seed_the_same_f_star_byte_for_byte(kind):
    orders = [np.random.default_rng(seed).permutation(len(touches)) for seed in range(2)]
    first, second = (learned(kind, order) for order in orders)
    assert first.exemplars == second.exemplars
    reports = [learner.fine_tune(epochs=2, seed=5) for learner in (first, second)]
    assert reports[0].digest == reports[1].digest == first.tuned_digest() == second.tuned_digest()
    assert reports[0].held_out == reports[1].held_out
    assert first.digest() == second.digest()
    assert first.fine_tune(epochs=2, seed=6).digest != reports[0].digest


@kinds
def test_f_stays_as_it_was_and_f_star_answers_only_where_it_did_better(kind):
    learner = learned(kind)
    probe = SCENE.touch(NAMES[1], 50)
    before, digest = learner.predict(probe), learner.digest()
    report = learner.fine_tune(epochs=2)
    assert (learner.predict(probe), learner.digest()) == (before, digest)
    assert learner.predict(probe, tuned=True).tuned is report.kept
    assert report.mode == ("head" if kind == "kernels" else "adapters")
    assert report.kept == (
        report.held_out["f*"]["loss"] + report.held_out["f*"]["margin"] < report.held_out["f"]["loss"]
        and report.held_out["f*"]["wrong"] <= report.held_out["f"]["wrong"]
    )
    assert ("f* is better" in report.reason) is report.kept


def kept(learner):
    """Make the learner answer with its f*, whatever came of it."""
    learner.memory.tuned = dataclasses.replace(learner.memory.tuned, kept=True)
    return learner


@kinds
def test_an_f_star_that_is_kept_gives_the_probabilities(kind):
    learner = learned(kind, kept_touches=None)
    learner.fine_tune(epochs=1)
    kept(learner)
    probe = SCENE.touch(NAMES[2], 60)
    answer = learner.predict(probe, tuned=True)
    reader = TunedReader(learner.embedding, learner.plan, learner.memory.tuned)
    logits = reader.logits(tactile_image(probe))
    values = np.array([logits[name] for name in sorted(NAMES)])
    chances = np.exp(values - values.max())
    expected = dict(zip(sorted(NAMES), chances / chances.sum(), strict=True))
    assert answer.tuned
    assert dict(answer.ranking) == pytest.approx(expected)
    assert answer.novelty == learner.predict(probe).novelty  # of f, always
    two = learner.predict(probe, tuned=True, scene=NAMES[:2])
    assert two.tuned
    assert sum(chance for _, chance in two.ranking) == pytest.approx(1)


def test_what_f_star_does_not_know_or_is_too_short_for_is_answered_by_f():
    learner = learned("kernels")
    learner.fine_tune(epochs=1)
    kept(learner)
    probe = SCENE.touch(NAMES[0], 50)
    short = probe.first(0.35)
    assert not learner.predict(short, tuned=True).tuned
    assert learner.predict(short, tuned=True) == learner.predict(short)
    for i in range(6):
        learner.observe(SCENE.materials[7], SCENE.touch(SCENE.materials[7], i))
    assert not learner.predict(probe, tuned=True).tuned
    assert learner.predict(probe, tuned=True, scene=NAMES).tuned


@pytest.mark.parametrize("kind", ["kernels", "kernels+vision"])
def test_exemplars_and_f_star_are_there_again_after_opening(tmp_path, kind):
    learner = learned(kind, path=tmp_path / "m")
    digest = learner.fine_tune(epochs=1).digest
    for i in range(6, 8):  # after the checkpoint: in the journal alone
        learner.observe(NAMES[0], SCENE.touch(NAMES[0], i))
    expected = (learner.exemplars, learner.digest(), digest)
    answer = kept(learner).predict(SCENE.touch(NAMES[1], 70), tuned=True)
    learner._ledger.store.close()  # as if the power failed: no checkpoint is written
    for _ in range(2):
        with TactileLearner.open(tmp_path / "m", embedding=EMBEDDINGS[kind]()) as again:
            assert (again.exemplars, again.digest(), again.tuned_digest()) == expected
            kept(again)
            assert again.predict(SCENE.touch(NAMES[1], 70), tuned=True) == answer


def test_interrupted_or_refused_the_f_star_before_stays(tmp_path, monkeypatch):
    with learned("kernels", path=tmp_path / "m") as learner:
        before = learner.fine_tune(epochs=1, seed=1).digest

        def interrupt(what, done, of):
            if what.startswith("held out 2"):
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            learner.fine_tune(epochs=1, seed=2, progress=interrupt)
        assert learner.tuned_digest() == before

        def full(*args, **kwargs):
            raise StoreError("no space left")

        with monkeypatch.context() as patched:
            patched.setattr(learner._ledger.store, "commit", full)
            with pytest.raises(StoreError, match="space"):
                learner.fine_tune(epochs=1, seed=2)
        assert learner.tuned_digest() == before
    with TactileLearner.open(tmp_path / "m", embedding=EMBEDDINGS["kernels"]()) as again:
        assert again.tuned_digest() == before


def test_a_loss_that_is_not_finite_stops_and_says_where(monkeypatch):
    learner = learned("kernels")
    before = learner.fine_tune(epochs=1).digest
    monkeypatch.setattr(finetune, "HEAD_RATE", float("inf"))
    for epochs, where in (
        (8, r"loss became nan in held out 1/3, epoch 2"),
        (1, "weights .* not finite after held out 1/3"),
    ):
        with pytest.raises(errors.FineTuneError, match=where):
            learner.fine_tune(epochs=epochs)
    assert learner.tuned_digest() == before


def test_a_device_without_memory_left_is_named_as_such(monkeypatch):
    learner = learned("kernels")

    def full(*args, **kwargs):
        raise torch.OutOfMemoryError("tried to allocate 2 GiB")

    monkeypatch.setattr(finetune.functional, "cross_entropy", full)
    with pytest.raises(errors.FineTuneError, match=r"cpu is out of memory.*device='cpu'"):
        learner.fine_tune(epochs=1)
    assert learner.tuned_digest() is None


def test_what_cannot_be_fine_tuned_says_why(tmp_path):
    learner = TactileLearner(sensor=PAD, embedding=EMBEDDINGS["kernels"]())
    with pytest.raises(errors.InputError, match="buffer is empty"):
        learner.fine_tune()
    learner.observe(*touches[0])
    with pytest.raises(errors.InputError, match="at least two materials"):
        learner.fine_tune()
    learner.observe(NAMES[1], SCENE.touch(NAMES[1], 3).first(0.4))
    with pytest.raises(errors.InputError, match="Observe longer touches"):
        learner.fine_tune()
    with pytest.raises(errors.InputError, match=r"buffer has none of .*exemplars=4 or more"):
        learned("kernels", exemplars=3).fine_tune()
    with pytest.raises(errors.InputError, match="with exemplars > 0"):
        learned("kernels", exemplars=0).fine_tune()
    full = learned("kernels")
    for settings in (
        {"epochs": 0},
        {"epochs": 1.5},
        {"epochs": True},
        {"seed": -1},
        {"seed": None},
        {"device": "warp"},
        {"device": "meta"},
        {"device": None},
    ):
        with pytest.raises(errors.InputError, match="expected"):
            full.fine_tune(**settings)
    for settings in ({"exemplars": -1}, {"exemplars": 2.5}):
        with pytest.raises(errors.InputError, match="expected exemplars"):
            TactileLearner(sensor=PAD, **settings)
    closed = learned("kernels", path=tmp_path / "m")
    closed.close()
    with pytest.raises(StoreError, match="closed"):
        closed.fine_tune()


@pytest.mark.parametrize("kind", ["vision", "kernels+vision"])
def test_the_network_to_be_tuned_reads_as_the_embedding_does(kind):
    embedding = EMBEDDINGS[kind]()
    reading = window_plan(PAD, embedding)
    features = TouchFeatures(embedding, reading)
    image = tactile_image(touches[0][1])
    means = features.means(None, [TrainingSample("", b"", image, features.frozen(image))])
    codes = embedding.embed_windows(image, reading.extent(image.shape[1]))
    for width, mean in means.items():
        expected = codes[width][reading.places(image.shape[1])[Scale("window", width)]].mean(axis=0)
        assert np.abs(mean[0].numpy() - expected).max() < 1e-5
    net = adapted(features.network())
    assert all("alpha" in name for name, p in net.named_parameters() if p.requires_grad)
    near = features.means(net, [TrainingSample("", b"", image, features.frozen(image))])
    for width, mean in means.items():  # narrow windows stay as the embedding reads them
        change = float((near[width] - mean).abs().max().detach())
        assert 0 < change < 1e-2 if width >= TOGETHER else change == 0


def test_ridge_can_be_fine_tuned_too_and_the_whole_network(monkeypatch):
    learner = learned("kernels", readout="ridge")
    assert learner.fine_tune(epochs=1).mode == "head"
    monkeypatch.setattr(finetune, "WHOLE_NETWORK_FROM", 1)
    whole = learned("kernels+vision")
    report = whole.fine_tune(epochs=1)
    assert report.mode == "network"
    probe = SCENE.touch(NAMES[1], 70)
    assert kept(whole).predict(probe, tuned=True).tuned
    assert whole.embedding.fingerprint == EMBEDDINGS["kernels+vision"]().fingerprint  # a copy was trained


def test_the_start_is_f_itself_as_its_windows_judge():
    for readout in ("lda", "ridge"):
        learner = learned("kernels", readout=readout, embedding=Windowed(dimension=64))
        model = learner.model()
        start = finetune.start_of(model, model.names)
        features = TouchFeatures(learner.embedding, learner.plan)
        image = tactile_image(SCENE.touch(NAMES[3], 40))
        frozen = features.frozen(image)
        logits = start.bias + sum(frozen[width] @ start.heads[width] for width in start.heads)
        chances = np.exp(logits - logits.max())
        said = dict(learner.predict(SCENE.touch(NAMES[3], 40)).ranking)
        odd = model.fitted.complete.readout_outliers  # f's answers leave a share for outliers
        chances = (1 - odd) * chances / chances.sum() + odd / len(chances)
        assert said == pytest.approx(dict(zip(model.names, chances, strict=True)), abs=1e-4)


@pytest.mark.parametrize("readout", ["lda", "ridge"])
def test_a_fold_held_out_starts_as_a_memory_that_never_observed_it(readout):
    learner = learned("kernels", readout=readout)
    model, statistics = learner.model(), copy.deepcopy(learner.memory.statistics)
    extractor = learner._predictor.extractor
    held = [(name, extractor.stream(stream)) for name, stream in touches[4:14]]
    samples = []
    for name, stream in held:
        image = extractor.image(stream)
        samples.append(TrainingSample(name, stream.key, image, {}, extractor.codes(image)))
    start = finetune.start_without(model, statistics, samples, model.names)
    assert statistics == learner.memory.statistics
    others = learned("kernels", [*range(4), *range(14, len(touches))], readout=readout).model()
    expected = finetune.start_of(model, others.names, others.readouts)
    assert start.names == expected.names
    assert start.bias == pytest.approx(expected.bias)
    for width, head in expected.heads.items():
        assert np.allclose(start.heads[width], head, rtol=1e-9, atol=1e-12 * np.abs(head).max())


def test_a_material_of_which_all_is_held_out_is_not_compared():
    learner = learned("kernels")
    model, extractor = learner.model(), learner._predictor.extractor
    learner.observe("once", SCENE.touch(SCENE.materials[6], 0))
    stream = extractor.stream(SCENE.touch(SCENE.materials[6], 0))
    image = extractor.image(stream)
    sample = TrainingSample("once", stream.key, image, {}, extractor.codes(image))
    start = finetune.start_without(learner.model(), learner.memory.statistics, [sample], [*model.names, "once"])
    assert start.names == model.names


@pytest.mark.parametrize("stop", [KeyboardInterrupt, StoreError("no space left")])
def test_what_comes_after_the_commit_leaves_disk_and_memory_agreed(tmp_path, monkeypatch, stop):
    learner = learned("kernels", path=tmp_path / "m")
    before = learner.fine_tune(epochs=1, seed=1).digest
    commit = learner._ledger.store.commit

    def late(*args, **kwargs):
        commit(*args, **kwargs)
        raise stop

    with monkeypatch.context() as patched:
        patched.setattr(learner._ledger.store, "commit", late)
        with pytest.raises(KeyboardInterrupt if stop is KeyboardInterrupt else StoreError):
            learner.fine_tune(epochs=1, seed=2)
    assert learner.tuned_digest() == before
    learner.close()
    with TactileLearner.open(tmp_path / "m", embedding=EMBEDDINGS["kernels"]()) as again:
        assert again.tuned_digest() == before


def test_a_memory_open_for_reading_is_not_trained_on(tmp_path):
    learned("kernels", path=tmp_path / "m").close()
    with (
        TactileLearner.open(tmp_path / "m", embedding=EMBEDDINGS["kernels"](), mode="read") as reader,
        pytest.raises(StoreError, match="open it to write"),
    ):
        reader.fine_tune(progress=lambda *reported: pytest.fail("it trained"))

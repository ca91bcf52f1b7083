"""The learner from outside: what is observed, what is answered, and what survives."""

import dataclasses
import math
import random
import subprocess
import sys
import threading

import numpy as np
import pytest
import torch
from scroll_tactile_store import NotAStoreError, Store, StoreError

import scroll_tactile
from scroll_tactile import Joined, Kernels, Prediction, Sensor, TactileLearner, sensors
from scroll_tactile.errors import (
    CapacityError,
    ChannelCountError,
    EmbeddingError,
    EmbeddingMismatchError,
    EmptyStreamError,
    InputError,
    MaterialError,
    MismatchError,
    NotFiniteError,
    SensorMismatchError,
    StreamError,
    StreamTooShortError,
    UnknownMaterialError,
)
from scroll_tactile.signals.stream import validate
from scroll_tactile.simulation.scene import Scene
from scroll_tactile.statistics.moments import MOST_ROWS, SecondMoment

SMALL = Kernels(seed=0, dimension=64)
PAD = Sensor(name="pad", channels=3, rate=100.0, low=-1.0, high=1.0, unit="N", duration=1.0)
ONE = Sensor(name="one", channels=1, rate=50.0, low=0.0, high=4095.0, unit="counts", duration=2.0)
SLOW = Sensor(name="slow", channels=4, rate=10.0, low=0.0, high=1.0, unit="N", duration=3.0)
BYTES = {"low": 0.0, "high": 255.0, "unit": "counts", "duration": 0.2}
CAMERA = Sensor(name="eye", channels=24 * 32 * 3, rate=25.0, layout=(24, 32, 3), camera=True, **BYTES)
NAMES = ["cork", "felt", "silk", "wool"]
KEPT = 8  # touches: so many are held out of a fit, which takes as much less time


def touch(material, repetition, sensor=PAD, readings=None):
    """A stream whose level, pace and roughness are the material's: nothing like a sensor, but easy to tell apart."""
    place = NAMES.index(material)
    rng = np.random.default_rng([place, repetition])
    count = sensor.readings if readings is None else readings
    i = np.arange(count)[:, None]
    phase = rng.uniform(0, 6, size=sensor.channels)
    wave = np.sin(i * (0.3 + 0.4 * place) + phase) * (0.2 + 0.1 * place)
    shares = 0.5 + 0.1 * place - 0.15 + 0.3 * wave + rng.normal(size=(count, sensor.channels)) * 0.02
    values = sensor.low + np.clip(shares, 0, 1) * (sensor.high - sensor.low)
    return values.astype(np.float32).reshape(count, *sensor.shape)


def learner_of(sensor=PAD, repetitions=5, names=NAMES, **settings):
    learner = TactileLearner(**{"sensor": sensor, "embedding": SMALL, "kept_touches": KEPT} | settings)
    feel(learner, repetitions, names)
    return learner


def feel(learner, repetitions=5, names=NAMES):
    for repetition in range(repetitions):
        for name in names:
            learner.observe(name, touch(name, repetition, learner.sensor))


def opened(path, **settings):
    return TactileLearner.open(path, **{"sensor": PAD, "embedding": SMALL, "kept_touches": KEPT} | settings)


def bits(prediction):
    """A prediction such that equal means equal to the bit."""
    shares = [(name, share.hex()) for name, share in prediction.ranking]
    return prediction.material, shares, prediction.novelty.hex(), prediction.known, prediction.seconds


def answers(learner):
    streams = [touch(name, 50, learner.sensor) for name in NAMES] + [touch("wool", 51, learner.sensor, readings=40)]
    return [bits(learner.predict(one)) for one in streams]


def check(prediction, materials):
    """What holds for every prediction of a memory that has observed something."""
    assert isinstance(prediction, Prediction)
    names, shares = zip(*prediction.ranking, strict=True)
    assert sorted(names) == sorted(materials)
    assert (prediction.material, prediction.probability) == prediction.ranking[0]
    assert all(math.isfinite(share) and 0 <= share <= 1 for share in shares)
    assert sum(shares) == pytest.approx(1)
    assert list(prediction.ranking) == sorted(prediction.ranking, key=lambda entry: (-entry[1], entry[0]))
    assert math.isfinite(prediction.novelty)
    assert prediction.known in (True, False, None)


@pytest.fixture(scope="module")
def felt():
    """A memory of all materials that is only asked."""
    return learner_of()


# What it answers


@pytest.mark.parametrize(
    ("sensor", "readout"),
    [*((sensor, "lda") for sensor in (PAD, ONE, SLOW, CAMERA, sensors.ROBOSKIN)), (PAD, "ridge"), (CAMERA, "ridge")],
    ids=lambda one: getattr(one, "name", one),
)
def test_it_knows_again_what_it_felt(sensor, readout):
    learner = learner_of(sensor, 3, readout=readout)
    for name in NAMES:
        for repetition in (20, 21):
            prediction = learner.predict(touch(name, repetition, sensor))
            check(prediction, NAMES)
            assert prediction.material == name
            assert prediction.probability > 0.4  # four materials, three touches of each
            assert prediction.seconds == sensor.readings / sensor.rate


@pytest.mark.parametrize("readout", ["lda", "ridge"])
def test_something_never_felt_is_more_novel(readout):
    learner = learner_of(repetitions=12, names=NAMES[:3], readout=readout)
    noise = np.random.default_rng(0).uniform(-1, 1, size=(100, 3))
    known = [learner.predict(touch(name, 30 + i)) for i in range(8) for name in NAMES[:3]]
    assert sum(one.known is not False for one in known) >= 20
    strange = learner.predict(noise)
    assert strange.known is False
    assert strange.novelty > max(one.novelty for one in known)


def test_before_anything_was_felt_the_answer_is_unknown():
    learner = TactileLearner(sensor=PAD, embedding=SMALL)
    assert learner.predict(touch("wool", 0)) == Prediction(None, 0.0, (), math.inf, False, 1.0)
    assert learner.materials == {}
    with pytest.raises(UnknownMaterialError, match="never observed"):
        learner.predict(touch("wool", 0), scene=["wool"])
    with pytest.raises(StreamError):
        learner.predict(np.zeros((1, 3)))


@pytest.mark.parametrize("readout", ["lda", "ridge"])
@pytest.mark.parametrize("touches", [1, 2, 9])
def test_after_one_material_only(touches, readout):
    learner = learner_of(repetitions=touches, names=["felt"], readout=readout)
    for stream in (touch("felt", 0), touch("wool", 3), np.ones((100, 3)), touch("felt", 7, readings=12)):
        prediction = learner.predict(stream)
        check(prediction, ["felt"])
        assert prediction.ranking == (("felt", 1.0),)
    assert learner.materials == {"felt": touches}


@pytest.mark.parametrize("readout", ["lda", "ridge"])
@pytest.mark.parametrize("touches", [1, 6])
def test_two_identical_materials_under_two_names_are_equally_likely(touches, readout):
    learner = TactileLearner(sensor=PAD, embedding=SMALL, readout=readout)
    for repetition in range(touches):
        for name, feel in (("wool", "wool"), ("alpaca", "wool"), ("silk", "silk")):
            learner.observe(name, touch(feel, repetition))
    for repetition in (0, 30):
        prediction = learner.predict(touch("wool", repetition))
        check(prediction, ["alpaca", "silk", "wool"])
        shares = dict(prediction.ranking)
        assert shares["wool"] == pytest.approx(shares["alpaca"], rel=1e-6)
        assert prediction.material in {"wool", "alpaca"}


@pytest.mark.parametrize("readout", ["lda", "ridge"])
def test_one_touch_of_each_is_enough_to_answer(readout):
    learner = learner_of(repetitions=1, readout=readout)
    for name in NAMES:
        prediction = learner.predict(touch(name, 0))
        check(prediction, NAMES)
        assert prediction.material == name


def test_a_scene_restricts_the_answer(felt):
    learner = felt
    stream = touch("wool", 9)
    everything = learner.predict(stream)
    assert everything.material == "wool"
    fewer = learner.predict(stream, scene=["felt", "cork"])
    check(fewer, ["felt", "cork"])
    assert fewer == learner.predict(stream, scene=("cork", "felt", "cork"))
    assert fewer == learner.predict(stream, scene={"cork": 1, "felt": 2})
    assert bits(learner.predict(stream, scene=NAMES)) == bits(everything)
    assert learner.predict(stream, scene=["silk"]).ranking == (("silk", 1.0),)
    # Not in this scene, so nothing in it feels like that.
    assert fewer.novelty > everything.novelty


@pytest.mark.parametrize(
    ("scene", "error", "said"),
    [
        (["wool", "tile"], UnknownMaterialError, r"\['tile'\].*never observed"),
        ([], InputError, "at least one"),
        ("wool", InputError, r"\['wool'\]"),
    ],
)
def test_a_scene_that_cannot_be_is_refused(felt, scene, error, said):
    with pytest.raises(error, match=said):
        felt.predict(touch("wool", 9), scene=scene)


def test_false_alarms_decide_what_is_known_and_nothing_else():
    streams = [touch(name, 30 + i) for i in range(10) for name in NAMES]
    learners = [learner_of(repetitions=6, kept_touches=0, false_alarms=share) for share in (0.01, 0.05, 0.5)]
    assert len({learner.digest() for learner in learners}) == 1
    few, usual, many = ([learner.predict(one) for one in streams] for learner in learners)
    for said in (few, many):
        assert [(one.ranking, one.novelty) for one in said] == [(one.ranking, one.novelty) for one in usual]
    alarms = [sum(one.known is False for one in said) for said in (few, usual, many)]
    assert alarms[0] <= alarms[1] < alarms[2]


# Streams of every kind


def test_every_form_of_the_same_readings_is_the_same_observation():
    plain = touch("wool", 1)
    fixed = plain.copy()
    fixed.setflags(write=False)
    forms = [
        plain,
        fixed,
        plain.astype(np.float64),
        np.asfortranarray(plain),
        plain.tolist(),
        torch.from_numpy(plain.copy()),
        validate(plain, PAD),
        (row for row in plain),
        iter([row.tolist() for row in plain]),
    ]
    digests, keys = set(), set()
    for form in forms:
        learner = TactileLearner(sensor=PAD, embedding=SMALL)
        keys.add(learner.observe("wool", form).key)
        digests.add(learner.digest())
    assert len(digests) == len(keys) == 1


@pytest.mark.parametrize("lengths", [[10, 29, 31, 50, 101, 400], [20] * 3], ids=["any", "brief"])
@pytest.mark.parametrize("readout", ["lda", "ridge"])
def test_unequal_lengths_in_one_memory(lengths, readout):
    learner = TactileLearner(sensor=PAD, embedding=SMALL, readout=readout)
    for repetition, readings in enumerate(lengths):
        for name in NAMES:
            learner.observe(name, touch(name, repetition, readings=readings))
    for readings in (10, 30, 45, 100, 300):
        check(learner.predict(touch("felt", 40, readings=readings)), NAMES)
    if max(lengths) > 20:
        assert learner.predict(touch("felt", 40)).material == "felt"


@pytest.mark.parametrize("readout", ["lda", "ridge"])
def test_a_material_felt_only_for_a_moment_beside_others_felt_for_long(readout):
    learner = learner_of(sensors.ROBOSKIN, repetitions=3, names=NAMES[:3], readout=readout)
    for repetition in range(3):
        learner.observe("wool", touch("wool", repetition, sensors.ROBOSKIN, readings=10))
    for name in NAMES:
        for readings in (10, 15, 75, 150):
            prediction = learner.predict(touch(name, 40, sensors.ROBOSKIN, readings=readings))
            check(prediction, NAMES)
            if 15 <= readings <= 75:  # a longer one may be a whole one at another pace
                assert prediction.material == name
    check(learner.predict(touch("wool", 40, sensors.ROBOSKIN), scene=["wool"]), ["wool"])


@pytest.mark.parametrize("duration", [0.5, 0.6, 0.61, 0.72])
def test_a_sensor_whose_touches_are_hardly_long_enough_for_two_scales(duration):
    learner = TactileLearner(sensor=PAD.model_copy(update={"name": "brief", "duration": duration}), embedding=SMALL)
    for repetition in range(4):
        for name in NAMES:
            learner.observe(name, touch(name, repetition, readings=20 if repetition % 2 else 75))
    for readings in (10, 29, 30, 75):
        check(learner.predict(touch("felt", 40, readings=readings)), NAMES)


def test_a_stream_of_a_million_readings():
    learner = learner_of(repetitions=2)
    long = np.tile(touch("wool", 0), (10_000, 1))
    receipt = learner.observe("wool", long)
    prediction = learner.predict(long)
    assert receipt.seconds == prediction.seconds == 10_000
    assert prediction.material == "wool"


BAD = {
    "nothing": ([], EmptyStreamError),
    "no readings": (np.zeros((0, 3)), EmptyStreamError),
    "too short": (np.zeros((1, 3)), StreamTooShortError),
    "channels": (np.zeros((100, 4)), ChannelCountError),
    "not a number": (np.full((100, 3), np.nan), NotFiniteError),
    "words": ("felt", StreamError),
    "another sensor's": (validate(touch("wool", 1, SLOW), SLOW), SensorMismatchError),
}


@pytest.mark.parametrize(("stream", "error"), BAD.values(), ids=BAD)
def test_a_bad_stream_is_refused_and_nothing_is_kept(tmp_path, stream, error):
    with opened(tmp_path / "m") as learner:
        feel(learner, 1)
        digest, felt = learner.digest(), learner.materials
        for call in (lambda: learner.observe("wool", stream), lambda: learner.predict(stream)):
            with pytest.raises(error):
                call()
        assert (learner.digest(), learner.materials) == (digest, felt)
        assert learner.observe("wool", touch("wool", 1)).sequence == 5


def test_an_iterable_that_fails_midway_keeps_nothing():
    def broken():
        yield [0.0, 0.0, 0.0]
        raise OSError("the cable came out")

    learner = learner_of(repetitions=1)
    digest = learner.digest()
    with pytest.raises(OSError, match="cable"):
        learner.observe("wool", broken())
    assert learner.digest() == digest


@pytest.mark.parametrize("name", ["", " ", "x" * 201, "a\nb", "a\0b", 5, None, b"felt", ["felt"]])
def test_a_name_that_is_none_is_refused(felt, name):
    digest = felt.digest()
    with pytest.raises(MaterialError, match="expected"):
        felt.observe(name, touch("wool", 99))
    assert felt.digest() == digest


@pytest.mark.parametrize("name", ["x" * 200, "Filz, grau", "フェルト", "a'b\"c", "../felt", "\U0001f9f6"])
def test_any_printable_name_survives(tmp_path, name):
    with opened(tmp_path / "m") as learner:
        learner.observe(name, touch("wool", 1))
    for _ in range(2):
        with opened(tmp_path / "m") as learner:
            assert learner.materials == {name: 1}
            assert learner.predict(touch("wool", 1)).material == name


def test_names_that_print_alike_are_one_material():
    learner = TactileLearner(sensor=PAD, embedding=SMALL)
    for seed, name in enumerate(["caf\u00e9", "cafe\u0301", " caf\u00e9\t"]):
        learner.observe(name, touch("wool", seed))
    learner.observe("felt", touch("felt", 0))
    assert learner.materials == {"caf\u00e9": 3, "felt": 1}
    assert learner.predict(touch("wool", 3), scene=["cafe\u0301", "felt "]).material == "caf\u00e9"
    assert learner.forget("cafe\u0301") == 3


class Broken:
    """An embedding that breaks its promise."""

    name, dimension, bound, fingerprint = "broken", 4, 1.0, "bb"

    def __init__(self, features):
        self.features = features

    def embed(self, image):
        return self.features


WRONG = {
    "NaN": (np.array([0.5, np.nan, 0.5, 0.5]), r"'broken' .* not finite: 1 of 4 features, \[1\], the first nan"),
    "inf": (np.array([np.inf, 0.5, 0.5, -np.inf]), r"'broken' .* not finite: 2 of 4 features, \[0, 3\], the first inf"),
    "bound": (np.full(4, 1.5), r"'broken' .* beyond its bound 1.0: 4 of 4 features, \[0, 1, 2, 3\], the first 1.5"),
    "5": (np.zeros(5), "'broken' .* expected features of shape"),
    "2-D": (np.zeros((1, 4)), "'broken' .* expected features of shape"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_features_that_are_none_are_refused_by_name_and_the_memory_keeps_working(tmp_path, kind):
    features, said = WRONG[kind]
    embedding = Broken(np.full(4, 0.25))
    with TactileLearner.open(tmp_path / "m", sensor=PAD, embedding=embedding) as learner:
        learner.observe("wool", touch("wool", 1))
        before = learner.digest()
        embedding.features = features
        with pytest.raises(EmbeddingError, match=said):
            learner.observe("silk", touch("silk", 1))
        with pytest.raises(EmbeddingError, match=said):
            learner.predict(touch("wool", 2))
        assert learner.digest() == before
        embedding.features = np.full(4, 0.5)
        learner.observe("silk", touch("silk", 1))
        assert learner.predict(touch("silk", 2)).material in ("wool", "silk")
        whole = learner.digest()
    with TactileLearner.open(tmp_path / "m", embedding=embedding) as learner:
        assert learner.digest() == whole and learner.materials == {"wool": 1, "silk": 1}


def test_of_joined_embeddings_the_part_whose_features_are_none_is_named():
    learner = TactileLearner(sensor=PAD, embedding=Joined(Kernels(dimension=64), Broken(np.full(4, np.nan))))
    with pytest.raises(EmbeddingError, match=r"4 of 68 features, \[64, 65, 66, 67\], .*They are those of its 'broken'"):
        learner.observe("wool", touch("wool", 1))
    assert learner.materials == {}


# Exactness


def test_global_random_generators_are_left_alone():
    def states():
        name, keys, *rest = np.random.get_state()  # noqa: NPY002  # the global generator is what is meant
        return [random.getstate(), name, keys.tobytes(), rest, torch.random.get_rng_state().numpy().tobytes()]

    before = states()
    answers(learner_of(SLOW))
    assert states() == before


def test_threads_that_observe_and_predict_together():
    learner = TactileLearner(sensor=PAD, embedding=SMALL, kept_touches=0)  # tests/faults/threads.py keeps them
    failures = []

    def work(name):
        try:
            for repetition in range(4):
                learner.observe(name, touch(name, repetition))
                learner.predict(touch(name, repetition))
        except Exception as error:
            failures.append(error)

    threads = [threading.Thread(target=work, args=(name,)) for name in NAMES]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert not failures
    assert learner.digest() == learner_of(repetitions=4).digest()


# Receipts


def test_a_receipt_says_what_was_kept(tmp_path):
    stream = touch("wool", 1)
    stream[3, 1], stream[4, 2] = 7.0, -3.0
    with opened(tmp_path / "m") as learner:
        learner.observe("silk", touch("silk", 1))
        receipt = learner.observe("wool", stream)
        again = learner.observe("wool", stream)
    assert again == receipt and again.repeated
    assert dataclasses.asdict(receipt) == {
        "sequence": 2,
        "material": "wool",
        "key": validate(stream, PAD).key,
        "seconds": 1.0,
        "clipped": 2,
        "durable": True,
        "repeated": False,
    }
    assert len(receipt.key) == 32
    alone = TactileLearner(sensor=PAD, embedding=SMALL)
    assert [alone.observe("wool", stream).sequence for _ in range(3)] == [1, 1, 1]
    assert not alone.observe("wool", stream).durable
    assert alone.observe("wool", stream).key == receipt.key


# Persistence


def test_a_memory_can_be_opened_without_naming_its_sensor_and_with_either_readout(tmp_path, felt):
    with opened(tmp_path / "m") as learner:
        feel(learner)
    with TactileLearner.open(tmp_path / "m", embedding=SMALL, readout="ridge") as learner:
        assert learner.sensor == PAD
        assert answers(learner) == answers(learner_of(readout="ridge"))
    with TactileLearner.open(str(tmp_path / "m"), embedding=SMALL) as learner:
        assert answers(learner) == answers(felt)


def test_a_checkpoint_is_written_while_observing(tmp_path, monkeypatch, felt):
    monkeypatch.setattr("scroll_tactile.persistence.ledger.CHECKPOINT_EVERY", 3)
    learner = opened(tmp_path / "m")
    feel(learner)
    learner._ledger.store.flush()
    with Store.open(tmp_path / "m", mode="read") as reader:
        assert reader.latest().last_sequence in range(3, 21)
    with opened(tmp_path / "m", mode="read") as reader:
        assert reader.digest() == learner.digest()
    learner.close()
    with opened(tmp_path / "m") as again:
        assert again.digest() == felt.digest()


def test_closing_twice_and_an_untouched_memory(tmp_path):
    learner = opened(tmp_path / "m")
    learner.close()
    learner.close()
    with opened(tmp_path / "m") as again:
        assert again.materials == {}
        assert again.predict(touch("wool", 1)).material is None
    with Store.open(tmp_path / "m", mode="read") as store:
        assert store.latest() is None


def test_a_memory_of_another_sensor_or_embedding_is_refused_and_named(tmp_path):
    with opened(tmp_path / "m") as learner:
        feel(learner, 1)
        digest = learner.digest()
    wider = PAD.model_copy(update={"high": 2.0})
    with pytest.raises(SensorMismatchError, match=r"high 1\.0 there, 2\.0 here"):
        opened(tmp_path / "m", sensor=wider)
    with pytest.raises(SensorMismatchError, match=r"'pad'.*'slow'"):
        opened(tmp_path / "m", sensor=SLOW)
    for other in (Kernels(seed=1, dimension=64), Kernels(dimension=65)):
        with pytest.raises(EmbeddingMismatchError, match=f"{SMALL.fingerprint[:12]}.*{other.fingerprint[:12]}"):
            opened(tmp_path / "m", embedding=other)
    with opened(tmp_path / "m") as learner:  # and the lock was let go
        assert learner.digest() == digest


def test_a_memory_of_another_grid_is_refused(tmp_path, monkeypatch):
    with opened(tmp_path / "m") as learner:
        feel(learner, 1)
    monkeypatch.setattr("scroll_tactile.memory.identity.BITS", 19)
    with pytest.raises(MismatchError, match="bits"):
        opened(tmp_path / "m")


def test_paths_that_hold_no_memory(tmp_path):
    (tmp_path / "file").write_text("hello")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    for path in ("file", "other"):
        with pytest.raises(NotAStoreError):
            opened(tmp_path / path)
    for mode in ("read", "write"):
        with pytest.raises((NotAStoreError, InputError), match="sensor" if mode == "write" else "new"):
            TactileLearner.open(tmp_path / "new", embedding=SMALL, mode=mode)
    with pytest.raises(NotAStoreError):
        opened(tmp_path / "new", mode="read")
    assert not (tmp_path / "new").exists()
    assert (tmp_path / "file").read_text() == "hello"


def test_a_failing_snapshot_loses_nothing(tmp_path, monkeypatch):
    learner = opened(tmp_path / "m")
    feel(learner, 2)
    digest = learner.digest()

    def full(*args, **kwargs):
        raise StoreError("no space left")

    monkeypatch.setattr(learner._ledger.store, "commit", full)
    with pytest.raises(StoreError, match="space"):
        learner.close()
    learner.close()
    with opened(tmp_path / "m") as again:  # the lock was let go
        assert again.digest() == digest


def fill(learner):
    """Make a memory that seems to hold as many rows as exact sums can."""
    scale = learner.plan.windows[-1]
    seconds = learner.memory.statistics._seconds
    seconds[scale] = SecondMoment.of(seconds[scale].packed(), MOST_ROWS, SMALL.dimension)


def test_what_a_full_memory_refuses_is_not_in_the_journal_either(tmp_path):
    with opened(tmp_path / "m") as learner:
        feel(learner, 2)
        digest = learner.digest()
        fill(learner)
        for name in ("wool", "tile"):
            with pytest.raises(CapacityError, match="exact"):
                learner.observe(name, touch("wool", 9))
        assert learner.materials == dict.fromkeys(NAMES, 2)
        last = learner._ledger.store.last
        sequence = learner.memory.sequence
        learner.memory.saved = sequence  # what was faked must not be written
    assert last == sequence == 8
    with opened(tmp_path / "m") as learner:
        assert learner.digest() == digest


def test_it_says_what_it_is(tmp_path):
    learner = learner_of(repetitions=1)
    assert repr(learner) == "<TactileLearner in memory, pad, 4 materials>"
    with opened(tmp_path / "m") as kept:
        assert "pad" in repr(kept)
        assert "m" in repr(kept)
    assert scroll_tactile.TactileLearner is TactileLearner


def test_a_name_of_numpys_is_the_name():
    touch = Scene(sensor=sensors.BIOTAC).touch("felt", 0)
    digests = []
    for name in ("felt", np.str_("felt")):
        learner = TactileLearner(sensor=sensors.BIOTAC)
        learner.observe(name, touch)
        digests.append(learner.digest())
    assert digests[0] == digests[1]


FORGETFUL = """
import sys, numpy
from scroll_tactile import Kernels, Sensor, TactileLearner
pad = Sensor(name="pad", channels=2, rate=50.0, low=0.0, high=1.0, unit="N", duration=1.0)
learner = TactileLearner.open(sys.argv[1], sensor=pad, embedding=Kernels(dimension=64))
draw = numpy.random.default_rng(0)
for i in range(128):  # now a checkpoint is due
    learner.observe("ab"[i % 2], draw.random((30, 2)))
"""


def test_a_script_that_ends_without_close_says_nothing_and_loses_nothing(tmp_path):
    for again in range(3):  # whether the checkpoint is written in time is a race
        ended = subprocess.run(
            [sys.executable, "-c", FORGETFUL, tmp_path / str(again)], capture_output=True, check=True
        )
        assert (ended.stdout, ended.stderr) == (b"", b"")
        with TactileLearner.open(tmp_path / str(again)) as learner:
            assert learner.materials == {"a": 64, "b": 64}

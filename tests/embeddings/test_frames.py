"""The embedding for cameras, and memories of what it sees."""

import itertools

import numpy as np
import pytest
from commands import refused, run

from scroll_tactile import Frames, Joined, Kernels, Sensor, TactileLearner, sensors
from scroll_tactile.embeddings.frames import LIGHT, STRENGTHS, SURFACE, light, surface
from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.errors import (
    ChannelCountError,
    EmbeddingMismatchError,
    EmptyStreamError,
    InputError,
    NoContactError,
    NotFiniteError,
    ReadingsTypeError,
)
from scroll_tactile.signals.contact import image_of
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.signals.stream import validate
from scroll_tactile.simulation.gel import MATERIALS, SMALL, Gel
from scroll_tactile.statistics.grid import mean_code
from scroll_tactile.statistics.moments import SecondMoment

GEL = Gel()
NETWORK = ResNet.random(0).state_dict()
SEEING = Frames(NETWORK)


def learned(repetitions=4, names=GEL.materials, **settings):
    learner = TactileLearner(sensor=SMALL, **settings)
    for i in range(repetitions):
        for name in names:
            learner.observe(name, GEL.touch(name, i))
    return learner


def test_light_is_the_mean_colour_of_cells():
    frame = np.random.default_rng(0).integers(-2048, 2049, (3, 12, 24))
    expected = frame.reshape(3, 6, 2, 8, 3).mean(axis=(2, 4)).ravel() / 2048
    assert light(frame) == pytest.approx(expected, abs=1e-6)
    assert light(np.full((3, 1, 1), -2048)).tolist() == [-1] * LIGHT


def test_slopes_are_counted_by_direction_and_strength():
    """A ramp to the right, of 10/255 of the range in two pixels: one octant, the strength from 8 to 16."""
    ramp = np.broadcast_to(np.arange(16) * 5 * 4096 / 255, (3, 12, 16)).round().astype(np.int64)
    counts = surface(ramp)[: 3 * 48].reshape(3, 8, len(STRENGTHS) + 1)
    inside = 2 / np.pi * np.arcsin(np.sqrt(14 / 16))
    assert counts[:, 0, 3] == pytest.approx(inside, abs=1e-5)
    assert counts[:, 1:].max() == 0
    turned = surface(ramp[:, :, ::-1].copy())[: 3 * 48].reshape(3, 8, -1)
    assert turned[:, 4, 3] == pytest.approx(inside, abs=1e-5)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 3), (33, 40)])
def test_frames_of_any_size_are_read(shape):
    frame = np.random.default_rng(1).integers(-2048, 2049, (3, *shape))
    assert surface(frame).shape == (SURFACE,)
    flat = surface(np.full((3, *shape), 77))
    assert sorted(set(flat.tolist())) == [0.0, 1.0]
    assert flat.sum() == 15  # of each colour at each scale: all in the first octant, none with any strength


def test_a_constant_offset_changes_the_light_alone():
    frame = np.random.default_rng(2).integers(-1000, 1000, (3, 30, 40))
    assert np.array_equal(surface(frame), surface(frame + 500))
    assert light(frame + 512) == pytest.approx(light(frame) + 0.25, abs=1e-6)


def test_the_network_sees_relief_and_no_level():
    image = np.random.default_rng(3).uniform(-0.2, 0.2, (90, 40)).astype(np.float32)
    dark, light_ = SEEING.embed(image), SEEING.embed(image + np.float32(0.25))
    assert dark.shape == (LIGHT + 2 * (64 + 128 + 256),)
    assert dark[LIGHT:] == pytest.approx(light_[LIGHT:], abs=1e-4)
    assert np.linalg.norm(dark[LIGHT : LIGHT + 64]) == pytest.approx(1, abs=1e-5)


def test_cosines_approximate_a_kernel_of_the_surface_alone():
    """The mean product of two frames' cosines is half of exp(−‖s − s'‖² / (2 · 1.2²)), of their counts s and s'."""
    embedding = Frames(cosines=2000)
    frames = [GEL.touch(name, 0).readings[-1] for name in MATERIALS[:3]]
    images = [tactile_image(validate(frame[None], SMALL)) for frame in frames]
    waves = [embedding.embed(image).astype(np.float64) for image in images]
    counts = [Frames().embed(image)[LIGHT:].astype(np.float64) for image in images]
    for i in range(3):
        for j in range(3):
            near = np.exp(-np.square(counts[i] - counts[j]).sum() / (2 * 1.2**2))
            assert 2 * np.mean(waves[i] * waves[j]) == pytest.approx(near, abs=0.1)
    assert np.array_equal(embedding.embed(images[0] + np.float32(0.25)), embedding.embed(images[0]))


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        ({"cosines": -1}, "cosines and a seed as whole numbers"),
        ({"cosines": 1.5}, "came 1.5 and 1"),
        ({"cosines": "a"}, "came 'a'"),
        ({"seed": -1}, "came 0 and -1"),
        ({"seed": np.nan}, "came 0 and nan"),
        ({"cosines": 9, "weights": NETWORK}, "with weights"),
    ],
)
def test_settings_that_cannot_be_are_refused(bad, said):
    with pytest.raises(InputError, match=said):
        Frames(**bad)


def test_the_fingerprint_tells_rests_and_networks_apart():
    rest = np.zeros(SMALL.shape)
    kinds = [Frames(), Frames(rest=None), Frames(rest=rest), Frames(rest=rest + 1), SEEING, Frames(NETWORK, rest=None)]
    kinds += [Frames(cosines=64), Frames(cosines=64, seed=2)]
    assert len({kind.fingerprint for kind in kinds}) == len(kinds)
    assert Frames(rest=rest).fingerprint == Frames(rest=rest.astype(int).tolist()).fingerprint


@pytest.mark.parametrize("rest", ["last", np.zeros((4, 5)), np.full((2, 2, 3), np.nan), [], "", 3, np.zeros((0, 2, 3))])
def test_a_resting_image_that_is_none_is_refused(rest):
    with pytest.raises(InputError, match="expected the gel at rest as 'first', None, or one picture"):
        Frames(rest=rest)


def test_images_of_channels_are_refused():
    with pytest.raises(InputError, match=r"expected the tactile image of a camera's frame.*came \(19, 400\)"):
        Frames().embed(np.zeros((19, 400), np.float32))
    with pytest.raises(InputError, match="one resting image"):
        Joined(Frames(), Frames(rest=None))


# Memories


@pytest.fixture(scope="module")
def memory():
    return learned()


def test_a_memory_of_a_camera_knows_what_was_pressed_into_it(memory):
    assert isinstance(memory.embedding, Frames)
    right = [memory.predict(GEL.touch(name, i)).material == name for i in range(10, 13) for name in MATERIALS]
    assert np.mean(right) >= 0.9


def test_frames_without_contact_change_nothing(memory):
    touch = GEL.touch("cord", 20).readings
    padded = np.concatenate([touch[:1], touch[:1], touch[:1], touch[1:3], touch[:1], touch[3:]])
    answer = memory.predict(touch)
    assert answer == memory.predict(padded)
    assert answer.seconds <= len(touch) / SMALL.rate


def test_no_frames_are_kept_unless_asked_for_and_another_resting_image_is_another_memory(tmp_path):
    with TactileLearner.open(tmp_path / "eye", sensor=SMALL) as learner:
        learner.observe("cord", GEL.touch("cord", 0))
        assert learner.exemplars == {}  # a camera's frames are large
    with pytest.raises(EmbeddingMismatchError):
        TactileLearner.open(tmp_path / "eye", embedding=Frames(rest=None))


def test_a_memory_of_single_frames_takes_no_resting_image():
    learner = TactileLearner(sensor=SMALL, embedding=Frames(rest=None))
    for i in range(3):
        for name in MATERIALS[:3]:
            learner.observe(name, GEL.touch(name, i).readings[-1:])
    assert learner.predict(GEL.touch("cord", 9).readings[-1:]).material == "cord"
    assert learner.predict(np.full((1, *SMALL.shape), 9, np.uint8)).material in MATERIALS  # constant: no error


def test_a_cameras_frames_are_learned_one_by_one_and_judged_together():
    learner = TactileLearner(sensor=SMALL, embedding=Frames(rest=None))
    frames = GEL.touch("cord", 0).readings[2:5]
    learner.observe("cord", frames)
    (scale,) = learner.memory.statistics.scales
    rows = np.concatenate([learner._predictor.extractor.codes(frame_image(frame))[scale] for frame in frames])
    second = SecondMoment(rows.shape[1])
    second.add(rows)
    assert learner.memory.statistics.counts(scale, ["cord"]).tolist() == [3]
    assert np.array_equal(learner.memory.statistics.second(scale).packed(), second.packed())
    ((_, _, touch),) = learner.memory.sample
    assert touch.pairs.tolist() == [[0, 0, 3]]
    assert np.array_equal(touch.rows[0], mean_code(rows.sum(axis=0, dtype=np.int64), 3))


def frame_image(frame):
    return image_of(validate(frame[None], SMALL), None)


def test_bad_streams_of_frames_are_refused_and_nothing_is_kept(memory):
    good = GEL.touch("cord", 0).readings
    before = memory.digest()
    broken = good.copy()
    broken[1, 2, 3, 1] = np.nan
    bad = [
        (NoContactError, "none differs", good[:1]),
        (NoContactError, "none differs", np.full_like(good, 7)),
        (NotFiniteError, r"reading 1, channel 2, 3, 1 is nan", broken),
        (ReadingsTypeError, "real numbers", good.astype(complex)),
        (ReadingsTypeError, "numbers", good.astype(str)),
        (ChannelCountError, r"\(T, 60, 80, 3\); came \(60, 80, 3\): one frame", good[0]),
        (ChannelCountError, r"came \(5, 80, 60, 3\)", good.swapaxes(1, 2)),
        (ChannelCountError, r"came \(5, 60, 80\)", good[..., 0]),
        (EmptyStreamError, "came none", good[:0]),
    ]
    for error, words, readings in bad:
        with pytest.raises(error, match=words):
            memory.observe("cord", readings)
        with pytest.raises(error, match=words):
            memory.predict(readings)
    assert memory.digest() == before


def test_a_resting_image_given_once_serves_every_stream():
    rest = GEL.touch("cord", 0, force=0).readings[0]
    given = TactileLearner(sensor=SMALL, embedding=Frames(rest=rest))
    for i, name in itertools.product(range(4), MATERIALS[:3]):
        given.observe(name, GEL.touch(name, i).readings[1:])
    assert given.predict(GEL.touch("gravel", 9).readings[3:]).material == "gravel"
    with pytest.raises(NoContactError, match="the one given"):
        given.predict(rest[None])


def test_commands_and_fine_tuning_read_frames(tmp_path):
    learner = learned(2, MATERIALS[:2], exemplars=4)
    assert learner.fine_tune(epochs=1).exemplars == 4
    assert learner.tuned_digest() is not None
    (tmp_path / "eye.json").write_text(SMALL.model_dump_json())
    np.save(tmp_path / "cord.npy", GEL.touch("cord", 0).readings.astype(np.uint8))
    words = ("observe", tmp_path / "memory", "cord", tmp_path / "cord.npy")
    assert run(*words, "--sensor", tmp_path / "eye.json").exit_code == 0
    assert "cord" in run("predict", tmp_path / "memory", tmp_path / "cord.npy").output
    np.save(tmp_path / "rest.npy", np.full((3, *SMALL.shape), 90, np.uint8))
    assert "none differs from the resting image" in refused("predict", tmp_path / "memory", tmp_path / "rest.npy")


def test_a_sensor_of_channels_takes_no_frames():
    with pytest.raises(InputError, match="take Kernels"):
        TactileLearner(sensor=sensors.BIOTAC, embedding=Frames())
    assert isinstance(TactileLearner(sensor=sensors.BIOTAC).embedding, Kernels)
    assert Sensor.model_validate(SMALL.model_dump()) == SMALL

"""The systems of the comparison: encoding, what each learns, and the training that the networks share."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from examples.paper.readers.physiclear import HALF_SIZE
from examples.paper.systems.catalogue import SYSTEMS, Catalogue
from examples.paper.systems.descent import Batches, Course, Precision, TrainingError, descend, logits_of, seeded
from examples.paper.systems.inputs import average_columns, one_width, picture
from examples.paper.systems.least_squares import PENALTIES, LeastSquares
from examples.paper.systems.networks import ConvLSTM, SpikingNet
from examples.paper.systems.one_pass import OnePass
from examples.paper.systems.own import is_own, require_own
from examples.paper.systems.spikes import REST, encode
from examples.paper.systems.svm import Svm
from examples.paper.systems.system_protocol import System, silent, unwatched
from examples.paper.systems.trained import TrainedNetwork
from scroll_tactile import Vision
from scroll_tactile.clients.learning.metrics import Labelled
from scroll_tactile.errors import InputError
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.augmentation import Augmentation
from scroll_tactile.signals.stream import Stream, validate

PATCH = Sensor(name="patch", channels=6, rate=50.0, low=0.0, high=255.0, unit="counts", duration=1.2)
NAMES = ("slow", "middle", "fast")


def touched(material: str, repetition: int, readings: int = 60) -> Stream:
    """A wave of the material's own frequency under six channels, from nearly the same phase, with noise."""
    random = np.random.default_rng([NAMES.index(material), repetition])
    cycles = (1.0, 3.0, 7.0)[NAMES.index(material)]
    phase = random.uniform(0, 1.0) + 0.3 * np.arange(6)
    wave = np.sin(2 * np.pi * cycles * np.arange(readings)[:, None] / 60 + phase)
    return validate(128 + 60 * wave + random.normal(0, 4, wave.shape), PATCH)


def touches(first: int, after: int, **kind: Any) -> list[Labelled]:
    return [(name, touched(name, i, **kind)) for name in NAMES for i in range(first, after)]


TRAIN, HELD, TEST = touches(0, 8), touches(8, 9), touches(10, 13)


def fit(system: System, seed: int = 0, **more: Any) -> System:
    system.fit([stream for _, stream in TRAIN], [name for name, _ in TRAIN], HELD, seed, **more)
    return system


def share(system: System, test: list[Labelled] = TEST) -> float:
    predicted = system.predict([stream for _, stream in test])
    return float(np.mean([name == answer for (name, _), answer in zip(test, predicted, strict=True)]))


class TestSpikes:
    @given(st.integers(0, 2**32), st.floats(0.003, 0.7), st.sampled_from([0.01, 0.3]))
    def test_what_is_decoded_is_nowhere_off_by_more_than_the_threshold(self, seed, threshold, step):
        random = np.random.default_rng(seed)
        walk = np.clip(np.cumsum(random.normal(0, step, (3, 40)), axis=1), -1, 1).astype(np.float32)
        spikes = encode(walk, threshold)
        assert spikes.shape == (6, 40)
        assert (spikes >= 0).all() and (spikes == np.round(spikes)).all()
        on, off = np.split(spikes.astype(np.float64), 2)
        decoded = REST + threshold * np.cumsum(on - off, axis=1)
        assert np.abs(decoded - walk).max() <= threshold * (1 + 1e-6)

    def test_a_rise_is_on_and_a_fall_is_off(self):
        image = np.array([[0.0, 0.35, 0.35, 0.0], [0.0, 0.0, 0.0, 0.0]], dtype=np.float32)
        on_off = encode(image, 0.1, rest=0.0)
        assert on_off.tolist() == [[0, 3, 0, 0], [0] * 4, [0, 0, 0, 3], [0] * 4]

    def test_the_first_spikes_show_the_level(self):
        assert encode(np.full((1, 5), 0.01, np.float32), 0.1)[0].tolist() == [10, 0, 0, 0, 0]

    @pytest.mark.parametrize("threshold", [0.0, -1.0, np.nan, np.inf])
    def test_thresholds_that_cannot_be_are_refused(self, threshold):
        with pytest.raises(InputError, match="threshold above 0"):
            encode(np.zeros((2, 5), np.float32), threshold)


class TestInputs:
    def test_a_frame_keeps_its_colours(self):
        frames = np.zeros((2, 120, 160, 3))
        frames[0, :, :, 0] = 255
        image = picture(validate(frames, HALF_SIZE))
        assert image.shape == (3, 120, 160)
        assert np.allclose(image[0], 0) and np.allclose(image[1:], -1)

    def test_columns_are_averaged(self):
        image = np.arange(14, dtype=np.float32).reshape(2, 7)
        assert average_columns(image, 3).tolist() == [[1, 4], [8, 11]]
        assert average_columns(image, 9).shape == (2, 1)
        assert average_columns(image, 1) is image
        with pytest.raises(InputError, match="1 or more"):
            average_columns(image, 0)

    def test_one_width_cuts_or_goes_on(self):
        frame = np.arange(12, dtype=np.float32).reshape(3, 2, 2)
        assert one_width(frame, 1).tolist() == frame[..., :1].tolist()
        assert one_width(frame, 3)[0, 0].tolist() == [0, 1, 1]


QUICK = Course(epochs=12, batch=8)


@pytest.fixture(scope="module")
def catalogue(weights: str) -> Catalogue:
    """One for all tests: what was embedded is remembered."""
    return Catalogue(weights, QUICK, every=4, channels=PATCH.channels)


@pytest.fixture(scope="module")
def new(weights: str) -> Catalogue:
    """Of which nothing was fitted."""
    return Catalogue(weights, QUICK, channels=PATCH.channels)


@pytest.mark.parametrize("key", SYSTEMS)
def test_each_system_learns_what_can_be_classified(key: str, catalogue: Catalogue):
    system = catalogue.make(key)
    assert isinstance(system, System)
    assert system.name == SYSTEMS[key]
    assert share(fit(system)) >= 0.8
    # Touches of other lengths are answered, rightly or not.
    assert set(system.predict([touched("slow", 50, readings=30), touched("fast", 51, readings=90)])) <= set(NAMES)
    assert system.predict([]) == []


@pytest.mark.parametrize("key", SYSTEMS)
def test_nothing_is_answered_before_a_fit(key: str, new: Catalogue):
    with pytest.raises(InputError, match="fit first"):
        new.make(key).predict([TEST[0][1]])


@pytest.mark.parametrize("key", ["svm", "conv-lstm", "least-squares-random", "kernels-lda"])
def test_touches_that_cannot_be_learned_are_refused(key: str):
    system = Catalogue(course=QUICK).make(key)
    streams = [stream for _, stream in TRAIN]
    with pytest.raises(InputError, match="as many streams"):
        system.fit(streams, ["a"], [], 0)
    with pytest.raises(InputError, match="two materials"):
        system.fit(streams, ["a"] * len(streams), [], 0)
    with pytest.raises(InputError, match="'stone'"):
        system.fit(streams, [name for name, _ in TRAIN], [("stone", streams[0])], 0)


class TestCatalogue:
    def test_names_that_are_not_there_and_weights_that_are_missing(self):
        with pytest.raises(InputError, match=r"conv-lstm.*came 'cnn'"):
            Catalogue().make("cnn")
        for key in ("resnet-pretrained", "least-squares", "kernels+vision-lda"):
            with pytest.raises(InputError, match="needs weights"):
                Catalogue().make(key)
        with pytest.raises(InputError, match="came 'tpu'"):
            Catalogue(device="tpu").make("conv-lstm")


def test_the_validation_chooses_and_is_learned_then():
    # No hyperplane parts the middle from what lies on both sides of it.
    levels = [("outer", 60), ("inner", 128), ("outer", 190)] * 4
    held = [(name, validate(np.full((60, 6), level), PATCH)) for name, level in levels[:3]]
    system = Svm("svm", choices=(("linear", 10.0), ("rbf", 10.0)))
    system.fit([validate(np.full((60, 6), i), PATCH) for _, i in levels], [name for name, _ in levels], held, 0)
    assert system.chosen == ("rbf", 10.0)
    assert system.predict([stream for _, stream in held]) == ["outer", "inner", "outer"]
    squares = LeastSquares("squares", Vision(None, seed=0, stages=(1, 2)))
    fit(squares)
    received: list[int] = []
    fit(squares, progress=lambda what, done, of: received.append(done))
    assert not received  # features of the touches met before are kept
    assert squares.penalty in PENALTIES


def trained(seed: int = 0, **more: Any) -> TrainedNetwork:
    course = more.pop("course", Course(epochs=3, batch=8))
    system = TrainedNetwork("net", lambda shape, count, _: ConvLSTM(shape[0], count), course=course, **more)
    fit(system, seed)
    return system


def state(system: TrainedNetwork) -> list[bytes]:
    assert system._net is not None
    return [tensor.numpy().tobytes() for tensor in system._net.state_dict().values()]


class TestTraining:
    def test_the_seed_makes_the_weights_and_global_generators_are_left_alone(self):
        torch.manual_seed(5)
        before, numpys = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002 (it is looked at only)
        trained(augmentation=Augmentation())
        assert torch.equal(before, torch.get_rng_state())
        assert np.array_equal(numpys, np.random.get_state()[1])  # noqa: NPY002
        first = state(trained())
        torch.manual_seed(6)
        assert state(trained()) == first != state(trained(seed=1))

        def interrupt() -> None:
            raise KeyboardInterrupt

        before = torch.get_rng_state()
        with pytest.raises(KeyboardInterrupt):
            fit(TrainedNetwork("net", lambda shape, count, _: ConvLSTM(shape[0], count)), watch=interrupt)
        assert torch.equal(before, torch.get_rng_state())

    def test_every_epoch_is_watched_and_noted(self):
        system = TrainedNetwork(
            "net", lambda shape, count, _: ConvLSTM(shape[0], count), course=Course(epochs=4, batch=8)
        )
        shares: list[float] = []
        received: list[tuple[int, int]] = []
        fit(
            system,
            watch=lambda: shares.append(share(system)),
            progress=lambda what, done, of: received.append((done, of)),
        )
        assert len(shares) == len(system.epochs) == 4
        assert received == [(1, 4), (2, 4), (3, 4), (4, 4)]
        assert system.epochs[-1].loss < system.epochs[0].loss
        assert system.epochs[0].validation_loss is not None

    def test_the_rate_falls_on_a_plateau_and_the_best_epoch_stays(self):
        images = torch.randn(12, 2, generator=torch.Generator().manual_seed(0))
        batches = Batches(lambda places: images[torch.from_numpy(places)], (images[:, 0] > 0).long())
        # The validation says the opposite: each epoch is worse than the one before.
        held = Batches(lambda places: images[torch.from_numpy(places)], (images[:, 0] <= 0).long())
        kept: list[torch.Tensor] = []
        with seeded(0, "cpu"):
            net = nn.Linear(2, 2)
            epochs = descend(
                net,
                batches,
                held,
                Course(epochs=4, patience=0),
                np.random.default_rng(0),
                silent,
                lambda: kept.append(net.weight.detach().clone()),
            )
        assert [epoch.rate for epoch in epochs] == pytest.approx([1e-2, 1e-2, 1e-3, 1e-4])
        assert torch.equal(net.weight, kept[0])
        assert not torch.equal(kept[0], kept[-1])

    def test_a_loss_that_is_not_finite_stops_it(self):
        images = torch.full((4, 2), torch.nan)
        batches = Batches(lambda places: images[torch.from_numpy(places)], torch.zeros(4, dtype=torch.long))
        with pytest.raises(TrainingError, match="nan in epoch 1"):
            descend(nn.Linear(2, 2), batches, None, Course(epochs=2), np.random.default_rng(0), silent, unwatched)

    def test_bfloat16_rounds_products_and_keeps_weights_and_answers_float32(self):
        images = torch.randn(16, 3, generator=torch.Generator().manual_seed(0))
        batches = Batches(lambda places: images[torch.from_numpy(places)], (images[:, 0] > 0).long())
        seen: set[torch.dtype] = set()

        def train(precision: Precision) -> tuple[float, nn.Module]:
            with seeded(0, "cpu"):
                net = nn.Linear(3, 2)
                net.register_forward_hook(lambda module, inputs, output: seen.add(output.dtype))
                course = Course(epochs=40, rate=0.1, precision=precision)
                epochs = descend(net, batches, None, course, np.random.default_rng(0), silent, unwatched)
            return epochs[-1].loss, net

        full, half = train("float32"), train("bfloat16")
        assert seen == {torch.float32, torch.bfloat16}
        assert full[0] != half[0]
        # Autocast that remembered its rounded weights from step to step would go on with those of the first.
        assert 0.001 < half[0] < 0.2
        assert full[0] == pytest.approx(half[0], rel=0.02)
        assert {one.dtype for one in half[1].parameters()} == {torch.float32}
        assert logits_of(half[1], images).dtype == torch.float32

    @pytest.mark.parametrize(
        "wrong", [{"epochs": 0}, {"batch": 1}, {"rate": 0.0}, {"factor": 1.0}, {"momentum": 1.0}, {"precision": "half"}]
    )
    def test_settings_that_cannot_be_are_refused(self, wrong: dict[str, Any]):
        with pytest.raises(InputError, match="came"):
            Course(**wrong)


class TestNetworks:
    def test_spikes_are_all_or_none_and_carry_a_gradient(self):
        with seeded(0, "cpu"):
            net = SpikingNet((6, 60), 4)
        fired: list[torch.Tensor] = []
        for neuron in net.neurons:
            neuron.register_forward_hook(lambda _, __, out: fired.append(out[0].detach()))
        net(torch.rand(3, 6, 60)).sum().backward()
        spikes = torch.stack(fired[:-1])
        assert set(spikes.unique().tolist()) == {0.0, 1.0}
        gradient = next(net.parameters()).grad
        assert gradient is not None and gradient.abs().sum() > 0


class Wrong:
    """What a factory of one's own may make by mistake."""

    def __init__(self, needed: int = 0) -> None:
        self.needed = needed


def needs(argument: int) -> Wrong:
    return Wrong(argument)


class TestOnesOwn:
    def test_a_system_and_an_embedding_are_made_by_name(self):
        catalogue = Catalogue()
        system = catalogue.make("examples.own_system:NearestMean")
        assert (system.name, isinstance(system, System)) == ("nearest mean", True)
        assert catalogue.make("examples.own_system:NearestMean") is not system  # each fold has a new one
        for readout in ("lda", "ridge"):
            assert isinstance(catalogue.make(f"examples.own_system:Strengths-{readout}"), OnePass)

    @pytest.mark.parametrize(
        ("key", "message"),
        [
            ("nowhere.at_all:make", "module nowhere.at_all cannot be imported from here: No module named 'nowhere'"),
            ("examples.own_system:__doc__", "a class or a function to call; it is of type str"),
            (f"{__name__}:needs", "called without arguments"),
            (f"{__name__}:Wrong", "to make a system.*it makes of type Wrong"),
            ("examples.own_system:Strengths", "to make a system.*it makes of type Strengths"),
            ("examples.own_system:NearestMean-lda", "to make an embedding.*it makes of type NearestMean"),
        ],
    )
    def test_what_is_none_is_named(self, key: str, message: str):
        assert is_own(key)
        with pytest.raises(InputError, match=message):
            require_own(key)

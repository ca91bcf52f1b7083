"""A user's own module as an embedding, and the check that certifies it."""

import re

import numpy as np
import pytest
import torch
from torch import nn

from scroll_tactile import Capabilities, Embedding, ModuleEmbedding
from scroll_tactile.errors import EmbeddingError, InputError
from scroll_tactile.testing import check_embedding

POOL = nn.Sequential(nn.AdaptiveAvgPool2d((4, 8)), nn.Flatten())


class Returning(nn.Module):
    """Whatever a function of the images gives."""

    def __init__(self, give):
        super().__init__()
        self.give = give

    def forward(self, images):
        return self.give(images)


def fixed_channels(channels=19, dimension=16):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        convolution = nn.Conv1d(channels, dimension, 5)
    return nn.Sequential(
        convolution, nn.BatchNorm1d(dimension), nn.Dropout(), nn.AdaptiveMaxPool1d(1), nn.Flatten(), nn.Tanh()
    )


def test_a_module_becomes_an_embedding_in_one_line():
    embedding = ModuleEmbedding(POOL, name="pool", dimension=32)
    assert isinstance(embedding, Embedding)
    assert (embedding.capabilities, embedding.bound) == (Capabilities(partial_windows=False), 1.0)
    assert len(check_embedding(embedding, columns=(9, 60))) == 9
    image = np.linspace(-1, 1, 19 * 40, dtype=np.float32).reshape(19, 40)
    assert np.array_equal(embedding.embed(image), POOL(torch.from_numpy(image)[None])[0].numpy())


def test_dropout_and_batch_statistics_are_off_and_the_original_is_left_alone():
    module = fixed_channels()
    embedding = ModuleEmbedding(module, name="mine", dimension=16)
    check_embedding(embedding, columns=(9, 60))
    assert module.training
    assert module[0].weight.requires_grad
    before, digits = embedding.embed(np.ones((19, 30), np.float32)).tobytes(), embedding.fingerprint
    with torch.no_grad():
        module[0].weight.zero_()
    assert embedding.embed(np.ones((19, 30), np.float32)).tobytes() == before
    assert embedding.fingerprint == digits
    assert ModuleEmbedding(module, name="mine", dimension=16).fingerprint != digits


def test_a_touch_of_two_readings_is_continued_by_its_mirror_image():
    embedding = ModuleEmbedding(fixed_channels(), name="mine", dimension=16)
    a, b = np.random.default_rng(0).uniform(-1, 1, (2, 19)).astype(np.float32)
    whole = np.stack([a, b, b, a, a, b, b, a, a], axis=1)
    assert embedding.embed(np.stack([a, b], axis=1)).tobytes() == embedding.embed(whole).tobytes()


def test_the_fingerprint_is_of_images_of_channels_that_the_module_takes():
    assert ModuleEmbedding(fixed_channels(), name="mine", dimension=16).fingerprint  # 19 of (1, 3, 19)
    seven = fixed_channels(7)
    with pytest.raises(EmbeddingError, match="say in `channels` how many it takes"):
        _ = ModuleEmbedding(seven, name="mine", dimension=16).fingerprint
    assert ModuleEmbedding(seven, name="mine", dimension=16, channels=(7,)).fingerprint
    # Without any weights, what it computes tells modules apart.
    doubled = nn.Sequential(POOL, nn.Hardtanh(-0.5, 0.5))
    fingerprints = {ModuleEmbedding(one, name="pool", dimension=32).fingerprint for one in (POOL, doubled)}
    assert len(fingerprints) == 2


@pytest.mark.parametrize(
    ("give", "said"),
    [
        (lambda x: x.mean(2), "shape (1, 4)"),
        (lambda x: x.mean((1, 2)).repeat(4), "came (4,)"),
        (lambda x: (x, x), "came tuple"),
    ],
    ids=["dimension", "no batch", "a tuple"],
)
def test_an_output_that_breaks_a_promise_is_named(give, said):
    embedding = ModuleEmbedding(Returning(give), name="mine", dimension=4)
    with pytest.raises(EmbeddingError, match=re.escape(said)):
        embedding.embed(np.zeros((19, 30), np.float32))


@pytest.mark.parametrize("wrong", [{"dimension": 0}, {"bound": 0.0}, {"bound": float("nan")}, {"judged_scales": "one"}])
def test_settings_that_cannot_be_are_refused(wrong):
    with pytest.raises(InputError, match=r"expected|must be"):
        ModuleEmbedding(POOL, **({"name": "pool", "dimension": 32} | wrong))
    with pytest.raises(InputError, match="expected a torch module"):
        ModuleEmbedding(np.tanh, name="tanh", dimension=1)


class Broken:
    """Mean and spread of an image, and one way of breaking a promise."""

    name, dimension, bound, fingerprint = "broken", 2, 1.0, "ab" * 16

    def __init__(self):
        self.calls = 0

    def embed(self, image):
        self.calls += 1
        return np.array([image.mean(), image.std()])


def broken(**replaced):
    return type("Mine", (Broken,), replaced)()


def counts(self, image):
    self.calls += 1
    return np.array([0.5, 1e-9 * self.calls])


def remembers(self, image):
    last, self.last = getattr(self, "last", image.shape), image.shape
    return np.array([0.0 if last == image.shape else 0.5, 0.5])


def writes(self, image):
    features = Broken.embed(self, image)
    if image.flags.writeable:
        image[0, 0] = 0.123
    return features


def only_writable(self, image):
    image[0, 0] = image[0, 0]
    return Broken.embed(self, image)


def lies(self, image, windows):
    return {w: np.stack([self.embed(image[:, s : s + w]) for s in starts]) * 0.5 for w, starts in windows.items()}


def forgets_rows(self, image, windows):
    return {w: np.zeros((1, 2)) for w in windows}


def by_company(self, image, windows):
    return {w: np.full((len(starts), 2), len(windows) / 10) for w, starts in windows.items()}


OWN = Capabilities(embeds_windows=True)

CASES = {
    "a promise missing": (Broken().embed, "lacks some"),
    "dimension": (broken(dimension=3), "expected features of shape (3,)"),
    "bound": (broken(bound=0.5), "beyond its bound 0.5"),
    "bound is none": (broken(bound=float("inf")), "bound must be positive and finite"),
    "not finite": (broken(embed=lambda self, image: np.array([image.mean() / image.std(), 0.0])), "are not finite"),
    "integers": (broken(embed=lambda self, image: np.array([0, 1])), "floating-point"),
    "tensors": (broken(embed=lambda self, image: torch.zeros(2)), "floating-point NumPy"),
    "fingerprint": (broken(fingerprint="mine, version 1"), "lower-case hex"),
    "fingerprint moves": (broken(fingerprint=property(lambda self: f"{self.calls:032x}")), "fingerprint was"),
    "does not repeat": (broken(embed=counts), "gave other bytes"),
    "depends on the past": (broken(embed=remembers), "other"),
    "writes into its input": (broken(embed=writes), "wrote into the image"),
    "refuses read-only": (broken(embed=only_writable), "read-only"),
    "windows undeclared": (broken(embed_windows=lies), "declare Capabilities(embeds_windows=True)"),
    "parts undone": (broken(capabilities=Capabilities(composite=True)), "it has no parts"),
    "capabilities of another type": (broken(capabilities={}), "expected the capabilities of Mine"),
    "windows differ from cuts": (broken(embed_windows=lies, capabilities=OWN), "cut out"),
    "windows missing": (broken(embed_windows=forgets_rows, capabilities=OWN), "expected features of shape (3, 2)"),
    "windows by company": (broken(embed_windows=by_company, capabilities=OWN), "with other windows and alone"),
}


@pytest.mark.filterwarnings("ignore:divide by zero", "ignore:invalid value")
@pytest.mark.parametrize("case", CASES)
def test_a_broken_promise_is_named(case):
    embedding, said = CASES[case]
    with pytest.raises(EmbeddingError, match=re.escape(said)):
        check_embedding(embedding)

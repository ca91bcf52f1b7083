"""What an embedding was made with, as JSON, and the same embedding made of it again."""

import hashlib
import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scroll_tactile import Frames, Joined, Kernels, ModuleEmbedding, Vision
from scroll_tactile.embeddings.registry import MOST_COSINES, configuration_of, from_configuration
from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.embeddings.weights import PUBLISHED
from scroll_tactile.errors import EmbeddingError

PICTURE = np.random.default_rng(0).uniform(0, 255, (24, 32, 3)).astype(np.float32)
KERNELS = {"kind": "kernels", "dimension": 64, "seed": 0}
FRAMES = Frames().configuration()
VISION = {
    "kind": "vision",
    "weights": None,
    "seed": 0,
    "depth": 18,
    "stem": "torchvision",
    "stages": [1],
}

SHIPPED = {
    "kernels": lambda: Kernels(dimension=64, seed=3),
    "frames": lambda: Frames(rest=None),
    "frames with a picture": lambda: Frames(rest=PICTURE),
    "frames by cosines": lambda: Frames(cosines=64, seed=2),
    "random vision": lambda: Vision(None, seed=1, stages=(0, 2)),
    "joined": lambda: Joined(Kernels(dimension=64), Joined(Kernels(dimension=64, seed=2), Frames(rest=None))),
}


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache of weights."""
    monkeypatch.setenv("SCROLL_TACTILE_CACHE", str(tmp_path))
    (tmp_path / "weights").mkdir()
    return tmp_path / "weights"


@pytest.mark.parametrize("kind", SHIPPED)
def test_what_ships_is_made_again_from_json(kind):
    embedding = SHIPPED[kind]()
    configuration = json.loads(json.dumps(configuration_of(embedding)))
    again = from_configuration(configuration)
    assert type(again) is type(embedding)
    assert repr(again) == repr(embedding)
    assert again.fingerprint == embedding.fingerprint
    assert configuration_of(again) == configuration


def mine():
    return ModuleEmbedding(torch.nn.Flatten(), name="mine", dimension=171)


@pytest.mark.parametrize(
    "embedding",
    [
        mine(),
        Joined(Kernels(dimension=64), mine()),
        type("Mine", (Kernels,), {})(dimension=64),
        Kernels(dimension=64, seed=2**70),
    ],
    ids=repr,
)
def test_what_could_not_be_made_again_has_no_configuration(embedding):
    assert configuration_of(embedding) is None


@pytest.mark.parametrize(
    ("configuration", "said"),
    [
        (KERNELS | {"dimension": 0}, "kernels.dimension: Input should be greater than or equal to 64, came 0"),
        (KERNELS | {"dimension": -5}, "greater than or equal to 64"),
        (KERNELS | {"dimension": 10**9}, "less than or equal to 8192, came 1000000000"),
        (KERNELS | {"dimension": True}, "valid integer, came True"),
        (KERNELS | {"dimension": "64"}, "valid integer, came '64'"),
        (KERNELS | {"seed": 2**80}, "kernels.seed"),
        (KERNELS | {"width": 3}, "kernels.width: Extra inputs are not permitted"),
        ({"kind": "kernels"}, "Field required"),
        ({}, "Unable to extract tag"),
        ([], "came \\[\\]"),
        (None, "came None"),
        ({"kind": "thermal"}, "of kind frames, joined, kernels, vision; it: .*'thermal'"),
        ({"kind": "joined", "parts": [KERNELS] * 9}, "at most 8 items"),
        ({"kind": "joined", "parts": [KERNELS]}, "at least 2 items"),
        ({"kind": "joined", "parts": [KERNELS, KERNELS | {"seed": -1}]}, "joined.parts.1.kernels.seed"),
        (FRAMES | {"cosines": MOST_COSINES + 1}, "frames.cosines"),
        (FRAMES | {"rest": {"shape": [2**14, 2**14, 3], "float32": ""}}, "of at most 16777216 values"),
        (FRAMES | {"rest": {"shape": [1, 1, 3], "float32": "%%"}}, "picture in a Frames' configuration is damaged"),
        (FRAMES | {"rest": Frames(rest=PICTURE).configuration()["rest"] | {"shape": [1, 1, 3]}}, "12 bytes; came more"),
        (VISION | {"runtime": "torch"}, "vision.runtime: Extra inputs are not permitted"),
        (VISION | {"depth": 10**6}, "vision.depth"),
        (VISION | {"weights": {"name": "../../etc/passwd", "sha256": "0" * 64}}, "vision.weights.name"),
        (VISION | {"weights": {"name": "a", "sha256": "0"}}, "vision.weights.sha256"),
    ],
)
def test_a_hostile_configuration_is_refused_before_anything_is_made(configuration, said):
    with pytest.raises(EmbeddingError, match=said):
        from_configuration(configuration)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=4),
)


@settings(max_examples=25, deadline=None)
@given(st.sampled_from([KERNELS, FRAMES, VISION | {"weights": {"name": None, "sha256": "0" * 64}}]), st.data())
def test_any_one_field_of_any_value_gives_an_embedding_or_a_typed_error(configuration, data):
    changed = configuration | {data.draw(st.sampled_from(sorted(configuration))): data.draw(JSON)}
    try:
        embedding = from_configuration(changed)
    except (EmbeddingError, ValueError):  # InputError is a ValueError
        return
    assert configuration_of(embedding) is not None


class TestWeights:
    @pytest.fixture
    def file(self, tmp_path):
        path = tmp_path / "mine.pth"
        torch.save(ResNet.random(3).state_dict(), path)
        return path

    @pytest.mark.parametrize("make", [lambda file: Vision(file, stages=(1, 2)), Frames], ids=["vision", "frames"])
    def test_a_file_in_the_cache_is_found_by_its_name_without_a_folder(self, file, cache, make):
        embedding = make(file)
        assert configuration_of(embedding)["weights"]["name"] == "mine.pth"
        assert str(file.parent) not in json.dumps(configuration_of(embedding)) + repr(embedding)
        file.rename(cache / file.name)
        again = from_configuration(configuration_of(embedding))
        assert again.fingerprint == embedding.fingerprint

    def test_weights_that_are_not_at_hand_are_named_with_what_to_pass(self, file, cache):
        named = configuration_of(Vision(file))
        digits = named["weights"]["sha256"][:12]
        with pytest.raises(EmbeddingError, match=rf"from 'mine.pth' .* {digits}.*Pass embedding=Vision\(weights=…\)"):
            from_configuration(named)
        with pytest.raises(EmbeddingError, match="came from a state dict"):
            from_configuration(configuration_of(Vision(ResNet.random(3).state_dict())))

    def test_other_weights_of_the_same_name_are_refused(self, file, cache):
        named = configuration_of(Vision(file))
        torch.save(ResNet.random(4).state_dict(), cache / file.name)
        with pytest.raises(EmbeddingError, match="expected weights whose tensors have the SHA-256"):
            from_configuration(named)

    def test_published_weights_are_named(self, file, cache, monkeypatch):
        name = f"resnet18-{hashlib.sha256(file.read_bytes()).hexdigest()[:8]}.pth"
        file.rename(cache / name)
        monkeypatch.setitem(PUBLISHED, "resnet18", f"https://nowhere.invalid/{name}")
        for embedding in (Joined(Kernels(dimension=64), Vision()),):
            assert repr(from_configuration(configuration_of(embedding))) == repr(embedding)
        assert configuration_of(Vision())["weights"]["name"] == "resnet18"

"""What a memory says of its making: it opens from its path alone, with nothing embedded before the first touch."""

import json
import pickle
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from commands import refused, run
from live_touches import Means
from scroll_tactile_store import Store
from touches import PAD, Windowed

from examples.paper.transfer.maps import Maps
from scroll_tactile import Joined, Kernels, TactileLearner, Vision
from scroll_tactile.embeddings.protocol import capabilities_of, window_plan
from scroll_tactile.errors import EmbeddingMismatchError, MismatchError
from scroll_tactile.memory.identity import AbsentEmbedding, Identity
from scroll_tactile.recipe import Recipe

EMBEDDINGS = [Kernels(dimension=64, seed=3), Joined(Kernels(dimension=64), Kernels(dimension=128, seed=1))]


def touch(seed, readings=60):
    return np.random.default_rng(seed).random((readings, 2))


def filled(path, **settings):
    learner = TactileLearner.open(path, sensor=PAD, **settings)
    for seed in range(6):
        learner.observe("ab"[seed % 2], touch(seed))
    return learner


@pytest.mark.parametrize("embedding", EMBEDDINGS, ids=repr)
def test_a_memory_opens_from_its_path_alone_on_the_command_line_too(embedding, tmp_path):
    path = tmp_path / "m"
    with filled(path, embedding=embedding) as learner:
        digest, answer = learner.digest(), learner.predict(touch(9))
    with TactileLearner.open(path) as learner:
        assert (learner.digest(), learner.predict(touch(9))) == (digest, answer)
    np.save(tmp_path / "t.npy", touch(9))
    assert json.loads(run("inspect", path, "--json").stdout)["digest"] == digest
    assert json.loads(run("predict", path, tmp_path / "t.npy", "--json").stdout)["material"] == answer.material
    assert run("observe", path, "new", tmp_path / "t.npy").exit_code == 0
    assert json.loads(run("inspect", path, "--json").stdout)["materials"] == {"a": 3, "b": 3, "new": 1}


def test_an_embedding_of_ones_own_is_named_with_what_to_pass_and_not_needed_for_all(tmp_path):
    filled(tmp_path / "m", embedding=Means()).close()
    with pytest.raises(EmbeddingMismatchError, match=r"'means' .*pass the one that made it.*embedding="):
        TactileLearner.open(tmp_path / "m")
    with TactileLearner.open(tmp_path / "m", embedding=Means()) as learner:
        assert learner.predict(touch(0)).material == "a"
    assert run("inspect", tmp_path / "m").exit_code == 0
    assert run("memory", "retract", tmp_path / "m", 1).exit_code == 0
    np.save(tmp_path / "t.npy", touch(9))
    assert "pass the one that made it" in refused("predict", tmp_path / "m", tmp_path / "t.npy")


def test_another_embedding_under_the_same_configuration_is_found_out_at_the_first_touch(tmp_path):
    # As if a later version embedded otherwise.
    prepare(tmp_path / "m", Kernels(), lambda identity: identity["embedding"].update(fingerprint="ab" * 32))
    with TactileLearner.open(tmp_path / "m") as learner:
        assert learner.materials == {}
        for use in (learner.predict, lambda stream: learner.observe("a", stream)):
            with pytest.raises(EmbeddingMismatchError, match="Features of one mean nothing to the other"):
                use(touch(0))
        assert learner.materials == {}


MADE = [
    *EMBEDDINGS,
    Joined(Kernels(dimension=64), Maps(layout=(3,))),
    Vision(weights=None, seed=0),
    Windowed(dimension=64),
]


@pytest.mark.parametrize("embedding", MADE, ids=repr)
def test_how_touches_are_read_is_known_without_making_the_embedding(tmp_path, embedding):
    identity, plan = Identity.of(Recipe.of(PAD, embedding)), window_plan(PAD, embedding)
    assert Identity.read(SimpleNamespace(path=tmp_path, identity=identity.to_json())) == identity
    absent = AbsentEmbedding(identity, tmp_path)
    own = isinstance(embedding, Windowed)  # which is an embedding of a user's, and not made again
    assert identity.embedding.bare == absent.capabilities.exact == (capabilities_of(embedding).exact and not own)
    assert replace(window_plan(PAD, absent), shrinkage=plan.shrinkage) == plan


def test_a_learner_pickles_into_another_process_and_inspecting_imports_no_torch(tmp_path):
    with filled(tmp_path / "m", embedding=Kernels(dimension=64)) as learner:
        (tmp_path / "learner").write_bytes(pickle.dumps(learner))
        answer = repr(learner.predict(touch(9)))
        digest = learner.digest()
    code = (
        "import pickle, sys, numpy as np; from scroll_tactile.clients.cli import application\n"
        "try: application()(['inspect', sys.argv[1], '--json'])\n"
        "except SystemExit: pass\n"
        "print('torch' in sys.modules)\n"
        "learner = pickle.loads(open(sys.argv[2], 'rb').read())\n"
        "print(learner.digest()); print(learner.predict(np.random.default_rng(9).random((60, 2)))); print(learner)"
    )
    words = [sys.executable, "-c", code, str(tmp_path / "m"), str(tmp_path / "learner")]
    output = subprocess.run(words, capture_output=True, text=True, check=True, timeout=120).stdout.splitlines()
    assert json.loads(output[0])["materials"] == {"a": 3, "b": 3}
    assert output[1:4] == ["False", digest, answer]
    assert output[4] == f"<TactileLearner in memory, a snapshot of {tmp_path / 'm'}, pad, 2 materials>"


def test_merging_looks_at_the_making_and_not_at_its_configuration(tmp_path):
    filled(tmp_path / "new", embedding=Kernels(dimension=64)).close()
    prepare(tmp_path / "old", Kernels(dimension=64), lambda identity: identity["embedding"].update(configuration=None))
    filled(tmp_path / "old", embedding=Kernels(dimension=64)).close()
    with TactileLearner.open(tmp_path / "new") as learner:
        assert learner.merge(tmp_path / "old").shared == 6
    filled(tmp_path / "other", embedding=Kernels(dimension=128)).close()
    with TactileLearner.open(tmp_path / "new") as learner, pytest.raises(MismatchError, match="embeddings differ"):
        learner.merge(tmp_path / "other")


def prepare(path, embedding, change):
    """An empty memory whose identity is changed before anything is observed."""
    identity = Identity.of(Recipe.of(PAD, embedding)).to_json()
    change(identity)
    Store.open(path, identity=identity).close()


def test_an_embedding_that_reads_other_parts_of_a_touch_is_refused(tmp_path):
    filled(tmp_path / "m", embedding=Windowed(dimension=64)).close()

    class Wholly(Windowed):
        capabilities = Kernels.capabilities

    with pytest.raises(EmbeddingMismatchError, match=r"views \(\) there, .*'competing'"):
        TactileLearner.open(tmp_path / "m", embedding=Wholly(dimension=64))

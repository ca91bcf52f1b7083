"""Arguments of a wrong type: each is an InputError that says what was expected and what came, and changes nothing."""

import copy
import pickle

import pytest
from touches import PAD, SETTINGS, SMALL, stream

from scroll_tactile import Kernels, Sensor, TactileLearner
from scroll_tactile.errors import DescriptionError, InputError, MaterialError, ReadingsTypeError, StreamError
from scroll_tactile.signals.stream import validate

PATHS = ["x\0y", "x\ud800y", "", None, 5, b"x", ["x"]]


def made(**settings):
    return TactileLearner(**{"sensor": PAD, "embedding": SMALL} | settings)


@pytest.fixture(scope="module")
def learner(tmp_path_factory):
    """A memory that no test changes."""
    with TactileLearner.open(tmp_path_factory.mktemp("arguments") / "m", **SETTINGS) as opened:
        for i, name in enumerate("ab"):
            opened.observe(name, stream((i, 60)))
            opened.describe(name, {name * 2: 1.0})
        yield opened


@pytest.mark.parametrize("path", PATHS, ids=ascii)
def test_paths(tmp_path, monkeypatch, learner, path):
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    calls = [
        lambda: TactileLearner.open(path, **SETTINGS),
        lambda: learner.merge(path),
        lambda: learner.backup(path),
    ]
    for call in calls:
        with pytest.raises(InputError, match=r"expected (path|destination|other) as a.* path.*; came "):
            call()
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"sensor": "biotac"}, r"Use sensors\.BIOTAC$"),
        ({"sensor": "biotac-all"}, r"Use sensors\.BIOTAC_ALL$"),
        ({"sensor": "nose"}, "expected sensor as a Sensor; came str 'nose'$"),
        ({"sensor": Sensor}, r"Call it: Sensor\(\.\.\.\)$"),
        ({"sensor": {"name": "pad"}}, "came dict"),
        ({"embedding": "kernels"}, r"Use Kernels\(\.\.\.\)$"),
        ({"embedding": Kernels}, r"Call it: Kernels\(\.\.\.\)$"),
        ({"embedding": 5}, "expected embedding as an embedding"),
        ({"augmentation": 4}, "'augmentation' is gone. A touch is learned as it was felt"),
        ({"false_alarms": "x"}, "expected false_alarms .*came 'x'"),
        ({"false_alarms": None}, "expected false_alarms"),
        ({"kept_touches": "x"}, "expected kept_touches"),
        ({"kept_touches": 1.5}, "expected kept_touches"),
        ({"exemplars": -1}, "expected exemplars"),
        ({"exemplars": [4]}, "expected exemplars"),
        *(({"false_alarms": share}, "^expected false_alarms to be") for share in (0, 1.0)),
        *(({"readout": readout}, "^expected readout to be") for readout in ("svm", None)),
        ({"colour": "red"}, "no setting"),
    ],
)
def test_what_a_learner_is_made_with(tmp_path, settings, said):
    with pytest.raises(InputError, match=said):
        made(**settings)
    with pytest.raises(InputError, match=said):
        TactileLearner.open(tmp_path / "m", **SETTINGS | settings)
    assert not (tmp_path / "m").exists()


def test_a_learner_without_a_sensor():
    with pytest.raises(InputError, match="expected sensor as a Sensor; came NoneType"):
        TactileLearner(sensor=None)


@pytest.mark.parametrize("mode", ["append", None, 5, ["read"]])
def test_modes(tmp_path, mode):
    with pytest.raises(InputError, match="expected mode as 'write' or 'read'; came"):
        TactileLearner.open(tmp_path / "m", **SETTINGS, mode=mode)
    assert not (tmp_path / "m").exists()


@pytest.mark.parametrize("names", [5, [["a"]], [5], [None], b"a", object()])
def test_scenes_and_constituents(learner, names):
    with pytest.raises(InputError, match="expected scene as a sequence of names; came"):
        learner.predict(stream((2, 60)), scene=names)
    with pytest.raises(DescriptionError, match="expected constituents as a sequence of names; came"):
        learner.compose(stream((2, 60)), constituents=names)


def test_a_scene_may_come_from_an_iterator(learner):
    touch = stream((2, 60))
    assert learner.predict(touch, scene=iter("ab")) == learner.predict(touch, scene=["a", "b"])
    assert learner.compose(touch, constituents=iter(["aa"])) == learner.compose(touch, constituents=["aa"])


@pytest.mark.parametrize("unfamiliar", ["x", None, [0.5], float("nan"), 1j, 1.5, -1])
def test_probabilities(learner, unfamiliar):
    with pytest.raises(InputError, match="expected unfamiliar as a probability from 0 to 1; came"):
        learner.compose(stream((2, 60)), unfamiliar=unfamiliar)


@pytest.mark.parametrize("name", [5, None, ["a"], {}])
def test_names(learner, name):
    calls = [lambda name: learner.describe(name, None), lambda name: learner.observe(name, stream((2, 60)))]
    for call in calls if name is None else [*calls, learner.forget]:
        with pytest.raises(MaterialError, match="expected a material's name as a string; came"):
            call(name)
    with pytest.raises(InputError, match="a material, or a source"):
        learner.forget()
    assert learner.materials == {"a": 1, "b": 1}


def test_what_a_learner_is_changed_with(learner, tmp_path):
    calls = {
        "descriptions": lambda: learner.merge(tmp_path / "o", descriptions=None),
        "embedding": lambda: learner.reembed("kernels"),
        "progress": lambda: learner.backup(tmp_path / "b", progress=5),
        "keep": lambda: learner.compact(keep="all"),
    }
    for name, call in calls.items():
        with pytest.raises(InputError, match=f"expected {name} as"):
            call()
    with pytest.raises(InputError, match="expected progress as a function"):
        learner.fine_tune(progress=5)
    for receipt in ("x", None, 1.5, [1]):
        with pytest.raises(InputError, match="there is no observation"):
            learner.retract(receipt)
    assert learner.materials == {"a": 1, "b": 1}


class NoArray:
    def __array__(self, dtype=None, copy=None):
        return 5


class Failing:
    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("the device is gone")


@pytest.mark.parametrize("readings", [NoArray(), Failing(), [NoArray()]], ids=["none", "failing", "inside"])
def test_objects_that_are_no_arrays(learner, readings):
    for call in (learner.predict, lambda readings: learner.observe("a", readings)):
        with pytest.raises(ReadingsTypeError, match=r"(NoArray|Failing).*cannot be made into an array"):
            call(readings)


@pytest.mark.parametrize("seconds", ["x", None, float("nan"), 1j])
def test_seconds(seconds):
    with pytest.raises((InputError, StreamError), match="a number of seconds; came"):
        validate(stream((0, 60)), PAD).first(seconds)


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda learner: pickle.loads(pickle.dumps(learner))])
def test_a_copy_shares_nothing(learner, copied):
    other, digest = copied(learner), learner.digest()
    other.observe("c", stream((3, 60)))
    other.describe("a", None)
    assert (learner.digest(), learner.materials) == (digest, {"a": 1, "b": 1})
    assert learner.descriptions["a"] == {"aa": 1.0}
    assert "a snapshot of" in repr(other)

"""The learner as an estimator of scikit-learn."""

import pickle
import warnings

import numpy as np
import pytest
import scipy.sparse
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.model_selection import GridSearchCV, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer
from sklearn.utils.estimator_checks import check_estimator

from scroll_tactile import Kernels, Sensor, TactileLearner
from scroll_tactile.errors import InputError, MaterialError, StreamError
from scroll_tactile.sklearn import TactileClassifier, TactileRegressor

PAD = Sensor(name="pad", channels=2, rate=50.0, low=0.0, high=1.0, unit="N", duration=1.0)
SMALL = Kernels(seed=0, dimension=64)


def touches(count=8, readings=50):
    """Touches (N, T, 2) of three materials, and their labels."""
    labels = np.repeat(["cork", "felt", "silk"], count)
    rng = np.random.default_rng(0)
    steps = {"cork": 0.1, "felt": 0.4, "silk": 0.9}
    walks = [np.cumsum(rng.normal(0, steps[label], (readings, 2)), axis=0) for label in labels]
    return 0.5 + 0.4 * np.sin(np.array(walks)), labels


def make(**changes):
    return TactileClassifier(**{"sensor": PAD, "embedding": SMALL, "kept_touches": 0, **changes})


def test_it_answers_as_its_learner_does():
    X, y = touches()
    fitted = make().fit(X, y)
    learner = TactileLearner(sensor=PAD, embedding=SMALL, kept_touches=0, exemplars=0)
    for touch, label in zip(X, y, strict=True):
        learner.observe(label, touch)
    assert fitted.learner_.digest() == learner.digest()
    shares = fitted.predict_proba(X[:3])
    assert [dict(learner.predict(touch).ranking) for touch in X[:3]] == [
        dict(zip(fitted.classes_, row, strict=True)) for row in shares
    ]
    assert fitted.score(X, y) > 0.9
    assert fitted.n_features_in_ == 2


def test_parts_in_any_order_are_the_whole():
    X, y = touches()
    whole, order = make().fit(X, y), np.random.default_rng(1).permutation(len(y))
    parts = make()
    for some in np.array_split(order, 5):
        parts.partial_fit(X[some], y[some], classes=["cork", "felt", "silk"])
    assert parts.learner_.digest() == whole.learner_.digest()
    assert parts.classes_.tolist() == whole.classes_.tolist()
    assert parts.fit(X[:8], y[:8]).classes_.tolist() == ["cork"]


def test_lists_of_touches_of_any_length_and_labels_that_are_numbers():
    X, y = touches()
    ragged = [touch[: 30 + i % 20] for i, touch in enumerate(X)]
    numbers = np.unique(y, return_inverse=True)[1] * 10
    predicted = make().fit(ragged, numbers).predict(ragged)
    assert predicted.dtype == numbers.dtype
    assert np.mean(predicted == numbers) > 0.8


def test_it_clones_and_pickles():
    X, y = touches()
    fitted = make(readout="ridge").fit(X, y)
    copy = clone(fitted)
    assert str(copy.get_params()) == str(fitted.get_params())
    assert not hasattr(copy, "learner_")
    again = pickle.loads(pickle.dumps(fitted))
    assert np.array_equal(again.predict_proba(X), fitted.predict_proba(X))


def test_it_works_in_pipelines_and_searches():
    X, y = touches()
    piped = make_pipeline(FunctionTransformer(lambda touches: touches * 0.5), make())
    assert cross_val_score(piped, X, y, cv=2).mean() > 0.6
    found = GridSearchCV(make(), {"readout": ["lda", "ridge"]}, cv=2).fit(X, y)
    assert found.best_params_["readout"] in ("lda", "ridge")


def test_a_sensor_that_is_not_given_is_as_wide_as_the_touches():
    X, y = touches()
    one_channel = TactileClassifier(embedding=SMALL, kept_touches=0).fit(X[:, :, 0], y)
    sensor = one_channel.learner_.sensor
    assert (sensor.channels, sensor.readings) == (1, 50)
    assert sensor.low < X[:, :, 0].min() < X[:, :, 0].max() < sensor.high


def test_what_does_not_fit_is_said():
    X, y = touches(2)
    with pytest.raises(NotFittedError, match="call fit"):
        make().predict(X)
    with pytest.raises(InputError, match="6 touches and labels of shape \\(5,\\)"):
        make().fit(X, y[:5])
    with pytest.raises(InputError, match=r"shape \(N, T, n\)"):
        make().fit(X[0, 0], y)
    with pytest.raises(InputError, match="all of the same n"):
        TactileClassifier().fit([X[0], X[1][:, :1]], y[:2])
    with pytest.raises(InputError, match="finite readings"):
        TactileClassifier().fit(np.full((2, 5, 1), np.nan), ["a", "b"])
    with pytest.raises(MaterialError):
        make().fit(X, ["", *y[1:]])
    fitted = make().fit(X, y)
    with pytest.raises(StreamError):
        fitted.partial_fit([*X, X[0][:, :1]], [*y, "felt"])
    assert fitted.learner_.digest() == make().fit(X, y).learner_.digest()


CANNOT = {
    "check_classifiers_train": "it fits lists of touches, whose lengths may differ, and then tables of any width",
}
"""Why checks of scikit-learn's fail: what they ask for is not what touches are."""


def test_it_passes_all_checks_of_scikit_learn_but_some():
    made = TactileClassifier(embedding=Kernels(dimension=64), kept_touches=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = check_estimator(made, expected_failed_checks=CANNOT, on_fail=None, on_skip=None)
    failed = [each["check_name"] for each in found if each["status"] == "failed"]
    assert failed == []
    assert sum(each["status"] == "passed" for each in found) >= 50
    assert {each["check_name"] for each in found if each["status"] == "xfail"} == {*CANNOT}


@pytest.mark.parametrize(
    ("X", "y", "error", "message"),
    [
        (np.ones((4, 9)), [1.0, np.nan, 0.0, 1.0], ValueError, "NaN"),
        (np.ones((4, 9)), np.array(["a", np.nan, "b", "a"], dtype=object), InputError, "NaN among y"),
        (np.ones((4, 9)), [0.1, 0.2, 0.3, 0.4], ValueError, "continuous"),
        (scipy.sparse.csr_array(np.ones((4, 9))), [0, 1, 0, 1], TypeError, "[Ss]parse"),
        (np.full((4, 9), np.nan), [0, 1, 0, 1], ValueError, "NaN"),
        (np.ones((4, 1)), [0, 1, 0, 1], ValueError, "minimum of 2"),
        (np.ones(4), [0, 1, 0, 1], InputError, "Reshape your data"),
    ],
)
def test_what_is_no_table_or_no_label_is_refused(X, y, error, message):
    with pytest.raises(error, match=message):
        TactileClassifier(embedding=SMALL).fit(X, y)


def test_a_table_of_another_width_is_refused_and_a_list_is_not():
    X, y = touches()
    fitted = TactileClassifier(embedding=SMALL, kept_touches=0).fit(X[:, :, 0], y)
    assert fitted.n_features_in_ == 50
    for read in (fitted.predict, lambda some: fitted.partial_fit(some, y)):
        with pytest.raises(ValueError, match="X has 30 features, but TactileClassifier is expecting 50"):
            read(X[:, :30, 0])
    assert len(fitted.predict([touch[:30] for touch in X[:, :, 0]])) == len(X)
    assert make().fit(X, y).n_features_in_ == 2


def numbers(X):
    """How far the readings of each touch swing."""
    return X.std(axis=(1, 2)) * 10


class TestRegressor:
    def test_it_answers_as_its_learner_does_and_intervals_hold(self):
        X, materials = touches(count=30)
        y, part = numbers(X), np.random.default_rng(1).permutation(len(X)) % 2 == 0
        fitted = TactileRegressor(sensor=PAD, embedding=SMALL, kept_touches=0).fit(X[part], y[part], materials[part])
        said, ends = fitted.predict(X[~part]), fitted.predict_interval(X[~part], 0.8, known=True)
        assert said[3] == fitted.learner_.estimate(X[~part][3])["y"].value
        assert ((ends[:, 0] <= said) & (said <= ends[:, 1])).all()
        assert ((ends[:, 0] <= y[~part]) & (y[~part] <= ends[:, 1])).mean() > 0.6
        assert fitted.score(X[part], y[part]) > 0.5 and clone(fitted).get_params().keys() == fitted.get_params().keys()

    @pytest.mark.parametrize(
        ("wrong", "message"),
        [
            ({"materials": None}, "materials="),
            ({"materials": np.repeat("felt", 24)}, "materials="),
            ({"y": np.full(24, np.nan)}, "finite number"),
            ({"y": np.zeros(3)}, "finite number"),
        ],
    )
    def test_what_it_cannot_be_fitted_to_is_refused(self, wrong, message):
        X, materials = touches()
        with pytest.raises(InputError, match=message):
            TactileRegressor(sensor=PAD, embedding=SMALL).fit(X, **{"y": numbers(X), "materials": materials, **wrong})

    def test_numbers_that_are_all_the_same_say_too_little(self):
        X, materials = touches()
        fitted = TactileRegressor(sensor=PAD, embedding=SMALL, kept_touches=0).fit(X, np.ones(len(X)), materials)
        with pytest.raises(InputError, match="the same value"):
            fitted.predict(X[:1])
        with pytest.raises(NotFittedError):
            TactileRegressor().predict(X)


def test_a_part_with_labels_of_another_kind_is_refused_before_it_is_observed():
    X, classifier = touches(2)[0], make()
    classifier.partial_fit(X[:4], [0, 0, 1, 1])
    with pytest.raises(InputError, match="came first, int64; came float64"):
        classifier.partial_fit(X[4:], [1.0, 1.0])
    assert classifier.learner_.materials == {"0": 2, "1": 2}
    assert classifier.predict_proba(X[:1]).shape == (1, 2)
    assert classifier.partial_fit(X[4:5], [7]).classes_.tolist() == [0, 1, 7]

"""What a touch is made of: by what it feels like, and by heads for materials that were never observed."""

import copy
import itertools
from dataclasses import replace

import numpy as np
import pytest

from scroll_tactile import Kernels, Sensor, TactileLearner
from scroll_tactile.errors import DescriptionError, MaterialError
from scroll_tactile.memory.descriptions import checked, targets_of
from scroll_tactile.prediction.composition import constituents

SKIN = Sensor(name="skin", channels=4, rate=50.0, low=-2.0, high=2.0, unit="N", duration=1.0)
PARTS = ("cotton", "linen", "silk", "wool")
RHYTHMS = (3.0, 5.0, 8.0, 13.0)  # Hz: a constituent shakes one channel in its rhythm, as strongly as its share


def touch(shares, seed):
    """A simulated touch: each constituent is observed in a channel of its own, with noise on all."""
    rng = np.random.default_rng([seed, *(round(1000 * share) for share in shares)])
    time = np.arange(50) / 50
    waves = [
        share * np.sin(2 * np.pi * (hertz * time + rng.uniform())) for share, hertz in zip(shares, RHYTHMS, strict=True)
    ]
    return 1.5 * np.stack(waves, axis=1) + rng.normal(0, 0.05, (50, 4))


def mixtures(parts=4):
    """Name → shares, of the even mixtures of some of the constituents."""
    chosen = [one for count in range(1, parts + 1) for one in itertools.combinations(range(4), count)]
    return {"".join(PARTS[at][0] for at in one): [(at in one) / len(one) for at in range(4)] for one in chosen}


def described(shares):
    return {name: share for name, share in zip(PARTS, shares, strict=True) if share}


def observed(names, touches=8, **settings):
    made = {"sensor": SKIN, "embedding": Kernels(seed=0, dimension=128), "kept_touches": 12}
    learner = TactileLearner(**made | settings)
    for at in range(touches):
        for name in names:
            learner.observe(name, touch(mixtures()[name], at))
    return learner


@pytest.fixture(scope="module")
def learner():
    """All mixtures but two were observed, and described afterwards."""
    learner = observed([name for name in mixtures() if name not in ("cl", "lsw")])
    for name, shares in mixtures().items():
        learner.describe(name, described(shares))
    return learner


@pytest.fixture(scope="module")
def three():
    return observed(["c", "l", "s"], 4)


def right(composition, shares):
    return [(one.presence > 0.5) == (share > 0) for one, share in zip(composition.constituents, shares, strict=True)]


class TestCompose:
    @pytest.mark.parametrize("name", ["c", "csw"])
    def test_a_material_that_was_observed_is_known_by_what_it_is_made_of(self, learner, name):
        for seed in range(20, 23):
            said = learner.compose(touch(mixtures()[name], seed))
            assert all(right(said, mixtures()[name]))
            shares = [one.share for one in said.constituents]
            assert np.abs(np.subtract(shares, mixtures()[name])).max() < 0.2
            assert said.prediction.material == name
            assert said["cotton"].evidence[0][0] == name or "c" not in name

    @pytest.mark.parametrize("name", ["cl", "lsw"])
    def test_one_never_observed_is_composed_of_those_that_were(self, learner, name):
        answers = [learner.compose(touch(mixtures()[name], seed)) for seed in range(20, 28)]
        assert np.mean([right(one, mixtures()[name]) for one in answers]) > 0.9
        missed = [[one.share for one in said.constituents] for said in answers] - np.array(mixtures()[name])
        assert np.abs(missed).mean() < 0.12
        known = [learner.compose(touch(mixtures()["c"], seed)).unfamiliar for seed in range(20, 28)]
        assert np.mean([one.unfamiliar for one in answers]) > np.mean(known) + 0.2

    def test_what_is_asked_for_is_answered(self, learner):
        stream = touch(mixtures()["lw"], 30)
        whole, part = learner.compose(stream), learner.compose(stream, constituents=["wool", "linen"])
        assert part.constituents == (whole["linen"], whole["wool"])
        with pytest.raises(KeyError):
            part["silk"]
        for wrong, said in ((["jute"], "'jute'"), ([], "none"), ("wool", "came str")):
            with pytest.raises(DescriptionError, match=said):
                learner.compose(stream, constituents=wrong)


@pytest.mark.parametrize(("unknown", "shares"), [((), [0.25, 0.75]), (("silk",), [None, 0.75])])
def test_shares_sum_to_one_or_to_no_more_where_some_are_unknown(unknown, shares):
    """Of a touch of materials that were observed, which its probabilities alone compose."""
    descriptions = {"a": {"wool": 1.0}, "b": {"wool": 0.5, "silk": 0.5}}
    targets = targets_of({name: checked(name, description) for name, description in descriptions.items()})
    heads = {name: ("too few",) * 2 if name in unknown else ((np.zeros(3), None),) * 2 for name in targets}
    found = constituents(targets, heads, {"a": 0.5, "b": 0.5}, np.zeros(2), 0.0)
    assert [found[name].share for name in ("silk", "wool")] == shares


class TestDescribing:
    def test_a_later_description_changes_the_answer_without_a_touch(self, three):
        trained = copy.deepcopy(three)
        for name in "cls":
            trained.describe(name, described(mixtures()[name]))
        stream = touch(mixtures()["s"], 60)
        assert trained.compose(stream)["silk"].presence > 0.5
        trained.describe("s", {"wool": 1.0})
        said = trained.compose(stream)
        assert said["wool"].presence > 0.5
        assert "silk" not in [one.name for one in said.constituents]

    def test_what_all_or_none_have_is_named_and_not_guessed(self, three):
        trained = copy.deepcopy(three)
        for name in "cls":
            values = {"dyed": True, "woven": False, "soft": name == "s"}
            trained.describe(name, values | ({"rare": True} if name == "c" else {}))
        said = trained.compose(touch(mixtures()["s"], 80))
        assert (said["dyed"].presence, said["woven"].presence, said["rare"].presence) == (None, None, None)
        assert "every material" in said["dyed"].unlearned
        assert "no material" in said["woven"].unlearned
        assert said["rare"].unlearned.startswith("it is known of 1 of the materials observed")
        assert said["soft"].presence > 0.5
        assert said["soft"].unlearned == ""
        assert [one.share for one in said.constituents] == [None] * 4

    def test_nothing_described_and_nothing_observed(self):
        trained = TactileLearner(sensor=SKIN, embedding=Kernels(seed=0, dimension=64))
        with pytest.raises(DescriptionError, match="nothing was described yet"):
            trained.compose(touch(mixtures()["s"], 0))
        trained.describe("s", {"silk": 1.0})
        said = trained.compose(touch(mixtures()["s"], 0))
        assert (said["silk"].presence, said["silk"].unlearned) == (None, "nothing was observed yet")
        assert said.prediction.material is None
        trained.observe("s", touch(mixtures()["s"], 0))
        assert trained.compose(touch(mixtures()["s"], 1))["silk"].presence is None
        trained.observe("w", touch(mixtures()["w"], 0))  # observed, and nothing is known of it
        assert trained.compose(touch(mixtures()["s"], 1))["silk"].presence is None

    @pytest.mark.parametrize(
        ("wrong", "said"),
        [
            ({"wool": 0.5}, "sum to one; they sum to 0.5"),
            ({"wool": 0.6, "silk": 0.6}, "sum to one; they sum to 1.2"),
            ({"wool": 1.2, "silk": -0.2}, "came -0.2"),
            ({"wool": 65, "silk": 35}, "came 35. Shares are parts of one, not percent"),
            ({"wool": float("nan")}, "came nan"),
            ({"wool": float("inf"), "silk": 1.0}, "came inf"),
            ({"wool": "much"}, "came 'much'"),
            ({"wool": 0.8, "silk": 0.4, "jute": None}, "at most one"),
            ({}, "at least one constituent"),
            ({"": 1.0}, "came ''"),
            ({3: 1.0}, "came 3"),
            ([("wool", 1.0)], "came list"),
        ],
    )
    def test_what_cannot_be_is_refused(self, wrong, said):
        trained = TactileLearner(sensor=SKIN)
        trained.describe("felt", {"wool": 1.0})
        with pytest.raises(DescriptionError, match=said):
            trained.describe("felt", wrong)
        with pytest.raises(MaterialError):
            trained.describe("", {"wool": 1.0})
        assert trained.descriptions == {"felt": {"wool": 1.0}}

    def test_it_is_kept_plain_and_nobody_elses(self):
        trained = TactileLearner(sensor=SKIN)
        mine = {"wool": np.float32(0.25), "silk": np.float64(0.75), "soft": np.True_}
        trained.describe("felt", mine)
        mine["wool"] = 9
        trained.descriptions["felt"]["wool"] = 9
        assert trained.descriptions == {"felt": {"silk": 0.75, "soft": True, "wool": 0.25}}
        assert [type(value) for value in trained.descriptions["felt"].values()] == [float, bool, float]
        trained.describe("felt", None)
        assert trained.descriptions == {}

    def test_rounded_shares_pass_and_equal_descriptions_are_kept_equal(self):
        assert checked("felt", {"wool": 1.0000005}) == {"wool": 1.0000005}
        assert checked("felt", dict.fromkeys("abc", 0.333333)) == dict.fromkeys("abc", 0.333333)
        # Minus zero would be another text on the disk.
        assert repr(checked("felt", {"silk": -0.0, "wool": 1})) == repr(checked("felt", {"wool": 1.0, "silk": 0.0}))

    def test_targets_are_zero_where_shares_are_whole_and_missing_where_not(self):
        targets = targets_of(
            {
                "felt": checked("felt", {"viscose": 0.65, "wool": 0.35, "soft": True}),
                "tweed": checked("tweed", {"wool": 1}),
                "rag": checked("rag", {"wool": 0.5, "silk": None, "viscose": None}),
                "stone": checked("stone", {"soft": False}),
            }
        )
        assert targets["wool"].share == {"felt": 0.35, "tweed": 1.0, "rag": 0.5}
        assert targets["viscose"].presence == {"felt": True, "tweed": False}
        assert targets["soft"].presence == {"felt": True, "stone": False}
        assert targets["silk"] == replace(targets["silk"], presence={}, share={})

    @pytest.mark.parametrize("readout", ["lda", "ridge"])
    def test_a_material_observed_since_the_heads_could_be_measured_is_weighed_too(self, readout):
        trained = observed(["c", "l", "s"], 6, readout=readout)
        for name in ("c", "l", "s", "w"):
            trained.describe(name, described(mixtures()[name]))
        assert trained.compose(touch(mixtures()["w"], 60))["wool"].unlearned.startswith("no material")
        trained.observe("w", touch(mixtures()["w"], 0))
        said = trained.compose(touch(mixtures()["w"], 61), unfamiliar=0.0)
        assert said.prediction.material == "w"
        assert said["cotton"].presence < 0.5
        trained.settle()
        assert trained.compose(touch(mixtures()["w"], 61))["wool"].presence > 0.5

    def test_what_is_unknown_of_a_material_takes_no_part(self):
        names = ["c", "l", "s", "w", "cl"]
        whole = observed(names, 4)
        part = copy.deepcopy(whole)
        for name in names:
            values = {part: share > 0 for part, share in zip(PARTS, mixtures()[name], strict=True)}
            whole.describe(name, values)
            part.describe(name, {one: value for one, value in values.items() if (name, one) != ("w", "silk")})
        stream = touch(mixtures()["lsw"], 70)
        ours, theirs = whole.compose(stream), part.compose(stream)
        assert all(ours[name] == theirs[name] for name in ("cotton", "linen", "wool"))
        assert ours["silk"].presence != theirs["silk"].presence
        part.describe("w", {"silk": None, "wool": True, "cotton": False, "linen": False})
        assert part.compose(stream) == theirs

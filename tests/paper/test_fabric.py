"""Compositions are scored as the paper does; simulated fabrics are what they are made of; heads for the unseen."""

import numpy as np
import pytest
from paper_touches import slid

from examples.paper.fabric.contactile import Contactile
from examples.paper.fabric.fabric_protocol import score
from examples.paper.fabric.objects import most_often, object_groups
from examples.paper.fabric.ratios import CONTACTILE_RATIOS, ratios
from examples.paper.fabric.simulated import CONSTITUENTS, HAND, ROBOT, FabricScene
from examples.paper.fabric.slides import directions
from examples.paper.fabric.unseen import fit_heads
from examples.paper.systems.constituents import Heads, Shares
from scroll_tactile.errors import InputError, UnknownMaterialError
from scroll_tactile.readouts.attributes import solve
from scroll_tactile.readouts.task import Task
from scroll_tactile.sensors import BIOTAC, CONTACTILE
from scroll_tactile.signals.stream import validate
from scroll_tactile.statistics.grid import in_units, to_codes
from scroll_tactile.statistics.statistics import Statistics

SIX = [f"part{number}" for number in range(6)]
SCENE = FabricScene(seed=0)


class TestScore:
    def test_each_false_positive_or_negative_costs_a_sixth(self):
        truth = [[1, 0, 0, 1, 0, 0]] * 2
        predicted = [[0.9, 0.2, 0.1, 0.8, 0.4, 0.0], [0.9, 0.7, 0.1, 0.3, 0.4, 0.0]]
        figures = score(SIX, truth, predicted)
        assert figures["score"] == pytest.approx((1 + 4 / 6) / 2)
        assert (figures["exact"], figures["always"], figures["share_error"]) == (0.5, 1.0, None)
        wanted = {"there": 0.0, "correct": 0.5, "precision": 0.0, "recall": None, "unanswered": 0}
        assert figures["constituents"]["part1"] == wanted

    def test_what_was_not_predicted_counts_as_absent_and_is_counted(self):
        figures = score(["a", "b"], [[1, 0]] * 4, [[np.nan, 0.1]] * 4)
        assert (figures["score"], figures["constituents"]["a"]["unanswered"]) == (0.5, 4)
        assert figures["calibration_error"] == pytest.approx(0.1)
        assert score(["a"], [[1]], [[np.nan]])["calibration_error"] is None
        for truth, presence in (([[1, 0]], [[0.5]]), ([], []), ([1, 0], [0.5, 0.5])):
            with pytest.raises(InputError):
                score(["a", "b"], truth, presence)


class TestSimulated:
    def test_shares_are_parts_of_one_and_every_constituent_is_in_some(self):
        made_of = SCENE.compositions
        assert list(made_of) == list(SCENE.fabrics) and len(made_of) == 32
        assert all(sum(shares.values()) == pytest.approx(1) and len(shares) <= 3 for shares in made_of.values())
        assert all(0 < share <= 1 for shares in made_of.values() for share in shares.values())
        often = [sum(name in shares for shares in made_of.values()) for name in CONSTITUENTS]
        assert min(often) > 2 and max(often) < 30
        assert max(shares.get("elastane", 0) for shares in made_of.values()) <= 0.1
        assert FabricScene(seed=1).compositions != made_of
        few = FabricScene(seed=0, count=5).compositions
        assert few == {name: made_of[name] for name in few}

    @pytest.mark.parametrize("protocol", [ROBOT, HAND])
    def test_a_touch_is_a_sound_stream_and_depends_on_its_arguments_alone(self, protocol):
        state = np.random.get_state()[1].tolist()  # noqa: NPY002 the global generator must stay
        first = SCENE.touch("fabric07", protocol, 3)
        assert FabricScene(seed=0).touch("fabric07", protocol, 3) == first
        assert np.random.get_state()[1].tolist() == state  # noqa: NPY002 see above
        assert (first.readings.shape, first.clipped, first.sensor) == ((599, 27), 0, SCENE.sensor)
        others = [SCENE.touch("fabric08", protocol, 3), SCENE.touch("fabric07", protocol, 4)]
        others.append(FabricScene(seed=1).touch("fabric07", protocol, 3))
        others.append(SCENE.touch("fabric07", 3 - protocol, 3))
        assert len({stream.key for stream in [first, *others]}) == 5

    def test_a_set_is_dealt_into_seeded_folds_of_each_fabric_and_protocol(self):
        scene = FabricScene(seed=2, count=3)
        fabrics = scene.touched(robot=5, hand=2)
        assert fabrics.protocol.tolist() == ([ROBOT] * 5 + [HAND] * 2) * 3
        assert fabrics.recordings.materials[::7] == list(scene.fabrics)
        assert fabrics.recordings.streams[12] == scene.touch("fabric02", HAND, 0)
        assert sorted(fabrics.recordings.fold[:5].tolist()) == [0, 1, 2, 3, 4]
        assert fabrics.recordings.fold.tolist() == scene.touched(robot=5, hand=2).recordings.fold.tolist()

    @pytest.mark.parametrize(
        ("call", "error"),
        [
            (lambda: SCENE.touch("silk", 1, 0), UnknownMaterialError),
            (lambda: SCENE.touch("fabric01", 3, 0), InputError),
            (lambda: SCENE.touch("fabric01", 1, -1), InputError),
            (lambda: FabricScene(seed=-1), InputError),
            (lambda: FabricScene(count=0), InputError),
            (lambda: Contactile(FabricScene(count=1).touched(5, 1), ("kernels",)), InputError),
        ],
    )
    def test_what_is_not_there_is_refused(self, call, error):
        with pytest.raises(error):
            call()

    def test_what_a_robot_touched_is_known_when_it_is_touched_again(self):
        study = Contactile(FabricScene(count=5).touched(robot=5, hand=1), ("kernels",))
        ((_, figures),) = study.run(["held-out"])
        assert figures["tested"] == 5 and figures["score"] == figures["fabric"] == 1
        assert figures["share_error"] < 0.02


def test_heads_are_ridge_regressions_whose_shares_sum_to_one():
    features = np.random.default_rng(0).standard_normal((60, 5))
    there = features[:, 0] > 0
    names = ["yes" if fraction else "no" for fraction in there]
    shares = Shares(("a", "b"), {"yes": {"a": 1.0}, "no": {"b": 1.0}})
    reported = Heads(features[:50], features[50:], shares, names[:50], names[50:])(features)
    assert ((reported.presence[:, 0] > 0.5) == there).mean() > 0.9
    assert np.allclose(reported.share.sum(axis=1), 1)


class TestRatios:
    def touch(self, force=1.0, angle=0.0):
        """A drag of friction 0.4 over a relief, each pillar a little later."""
        time, pillar = np.arange(300)[:, None] / 100, np.arange(9)
        load = force * (1 + 0.3 * np.sin(2 * np.pi * (6 * time - 0.1 * pillar)))
        found = np.stack([-0.4 * load * np.cos(angle), -0.4 * load * np.sin(angle), load], axis=2)
        return validate(found.reshape(300, 27), CONTACTILE)

    def test_force_and_way_leave_no_trace_and_friction_does(self):
        usual = ratios(self.touch())
        assert (usual.sensor, usual.readings.shape) == (CONTACTILE_RATIOS, (300, 27))
        for other in (self.touch(force=3.0), self.touch(angle=2.0), self.touch(force=0.5, angle=-1.0)):
            assert np.allclose(ratios(other).readings, usual.readings, atol=1e-4)
        pillars = usual.readings.reshape(300, 9, 3)
        assert np.allclose(pillars[..., 0], 0.4, atol=1e-4)
        assert np.allclose(pillars[..., 1], 0, atol=1e-4)
        assert pillars[100:200, :, 2].std() == pytest.approx(0.3 / np.sqrt(2), rel=0.1)
        assert np.isfinite(ratios(validate(np.zeros((50, 27)), CONTACTILE)).readings).all()
        with pytest.raises(InputError, match="27 channels"):
            ratios(validate(np.zeros((50, 19)), BIOTAC))


def test_directions_are_of_slides_at_other_speeds_and_forces():
    assert [(int(a.sum()), int(b.sum())) for a, b in directions(slid()).values()] == [(24, 24)] * 4


def test_groups_share_the_names_out():
    groups = object_groups([str(i) for i in range(23)], 4, 1)
    assert sorted(map(len, groups)) == [5, 6, 6, 6]
    assert groups == object_groups([str(i) for i in range(23)], 4, 1)
    assert groups != object_groups([str(i) for i in range(23)], 4, 2)
    assert most_often(["b", "a", "b", "a", "c"]) == "a"


def test_heads_for_the_unseen_are_chosen_by_leaving_objects_out():
    """An attribute that the first feature shows is graded of new objects; an object left out was never there."""
    rng = np.random.default_rng(0)
    statistics, shown = Statistics(6, (1,)), {}
    centres = rng.uniform(-0.5, 0.5, (30, 6))
    for i, centre in enumerate(centres):
        rows = centre + 0.05 * rng.standard_normal((5, 6))
        statistics.add(f"m{i:02}", {1: to_codes(rows, 1.0)})
        shown[f"m{i:02}"] = {"bright": int(centre[0] > 0)}
    known = {name: value for name, value in shown.items() if name < "m20"}
    head = fit_heads(statistics, 1, known, ["bright"])["bright"]
    reported = [head(in_units(centre, 1.0)) for centre in centres[20:]]
    assert np.mean([item == shown[f"m{i + 20}"]["bright"] for i, item in enumerate(reported)]) >= 0.8
    # Leaving one out by the formula is leaving it out of the system.
    counts, sums = statistics.totals(1, statistics.names(1))
    means = sums[:20] / counts[:20, None] - head.origin
    lower = Task.of(statistics, 1, statistics.names(1)).scatter
    scatter = np.tril(lower) + np.tril(lower, -1).T
    gram = means @ np.linalg.solve(scatter + head.penalty * np.trace(scatter) / 6 * np.eye(6), means.T)
    system = np.linalg.inv(solve(gram, head.gamma))
    targets = np.array([[known[f"m{i:02}"]["bright"] == value for value in head.values] for i in range(20)], float)
    error = 0.0
    for i in range(20):
        others = np.delete(np.arange(21), i)
        known_others = np.append(np.delete(targets, i, axis=0), [[0, 0]], axis=0)
        left = np.linalg.solve(system[np.ix_(others, others)], known_others)
        error += np.square(targets[i] - system[i, others] @ left).sum()
    assert error == pytest.approx(head.error)
    with pytest.raises(InputError, match="observed was 1"):
        fit_heads(statistics, 1, {"m00": known["m00"]}, ["bright"])

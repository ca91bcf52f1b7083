"""Simulated fabrics: what they are made of is what is observed, a robot touches evenly, a hand does not."""

import numpy as np
import pytest

from examples.paper.fabric import fabrics_set as contactile
from examples.paper.fabric.simulated import CONSTITUENTS, HAND, LIMITS, ROBOT, FabricScene
from scroll_tactile.errors import InputError, UnknownMaterialError

SCENE = FabricScene(seed=0)


def forces(fabric, protocol, repetition=0, scene=SCENE):
    """(T, 9, 3) N, once the touch has settled."""
    return scene.touch(fabric, protocol, repetition).readings.astype(np.float64).reshape(-1, 9, 3)[100:]


class TestCompositions:
    def test_shares_are_parts_of_one_and_every_constituent_is_in_some(self):
        made_of = SCENE.compositions
        assert list(made_of) == list(SCENE.fabrics) and len(made_of) == 32
        assert all(sum(shares.values()) == pytest.approx(1) and len(shares) <= 3 for shares in made_of.values())
        assert all(0 < share <= 1 for shares in made_of.values() for share in shares.values())
        often = [sum(name in shares for shares in made_of.values()) for name in CONSTITUENTS]
        assert min(often) > 2 and max(often) < 30
        assert max(shares.get("elastane", 0) for shares in made_of.values()) <= 0.1

    def test_a_seed_makes_other_fabrics_and_a_number_more_of_them(self):
        assert FabricScene(seed=1).compositions != SCENE.compositions
        few = FabricScene(seed=0, count=5).compositions
        assert few == {name: SCENE.compositions[name] for name in few}
        for wrong in ({"seed": -1}, {"count": 0}):
            with pytest.raises(InputError):
                FabricScene(**wrong)


class TestTouches:
    @pytest.mark.parametrize("protocol", [ROBOT, HAND])
    def test_a_touch_is_a_sound_stream_and_depends_on_its_arguments_alone(self, protocol):
        state = np.random.get_state()[1].tolist()  # noqa: NPY002 the global generator must stay
        first = SCENE.touch("fabric07", protocol, 3)
        SCENE.touch("fabric08", protocol, 0)
        assert FabricScene(seed=0).touch("fabric07", protocol, 3) == first
        assert np.random.get_state()[1].tolist() == state  # noqa: NPY002 see above
        assert (first.readings.shape, first.clipped, first.sensor) == ((599, 27), 0, SCENE.sensor)
        others = [SCENE.touch("fabric08", protocol, 3), SCENE.touch("fabric07", protocol, 4)]
        others.append(FabricScene(seed=1).touch("fabric07", protocol, 3))
        others.append(SCENE.touch("fabric07", 3 - protocol, 3))
        assert len({stream.key for stream in [first, *others]}) == 5

    def test_a_robot_presses_and_moves_alike_and_a_hand_does_not(self):
        load, way = {}, {}
        for protocol in (ROBOT, HAND):
            touches = [forces("fabric02", protocol, repetition) for repetition in range(8)]
            load[protocol] = np.array([touch[..., 2].sum(axis=1).mean() for touch in touches])
            along = [np.sign(touch[:, :, 0].sum(axis=1)) for touch in touches]
            way[protocol] = [int(np.flatnonzero(np.diff(one))[0]) for one in along if np.ptp(one)]
        assert load[ROBOT].mean() == pytest.approx(5, rel=0.1)
        assert load[HAND].std() > 4 * load[ROBOT].std()
        assert np.ptp(way[ROBOT]) < 5 < np.ptp(way[HAND])

    def test_yarn_is_observed(self):
        """Elastane drags most of all and polyester least; linen is rougher than polyester in the same kind of weave."""
        made_of = SCENE.compositions

        def friction(name):
            settled = forces(name, ROBOT)[150:200]
            return float((np.linalg.norm(settled[..., :2].sum(axis=1), axis=1) / settled[..., 2].sum(axis=1)).mean())

        pure = {next(iter(shares)): name for name, shares in made_of.items() if len(shares) == 1}
        assert friction(pure["polyester"]) < friction(pure["linen"]) < friction(pure["cotton"])
        wool = [friction(name) for name, shares in made_of.items() if shares.get("wool", 0) > 0.6]
        assert min(wool) > friction(pure["cotton"])

    @pytest.mark.parametrize(
        ("arguments", "error"),
        [(("silk", 1, 0), UnknownMaterialError), (("fabric01", 3, 0), InputError), (("fabric01", 1, -1), InputError)],
    )
    def test_what_is_not_there_is_refused(self, arguments, error):
        with pytest.raises(error):
            SCENE.touch(*arguments)


class TestFiles:
    def test_what_is_written_is_what_is_read(self, tmp_path):
        scene = FabricScene(seed=2, count=3)
        scene.write(tmp_path / "set", robot=4, hand=2)
        read = contactile.load(tmp_path / "set", limits=LIMITS)
        assert read.protocol.tolist() == [ROBOT] * 4 + [HAND] * 2 + ([ROBOT] * 4 + [HAND] * 2) * 2
        assert read.recordings.materials[::6] == list(scene.fabrics)
        assert read.recordings.streams[10] == scene.touch("fabric02", HAND, 0)
        for name, shares in scene.compositions.items():
            assert read.compositions[name] == pytest.approx({one: shares.get(one, 0.0) for one in CONSTITUENTS})

    def test_a_folder_that_holds_something_is_left_alone(self, tmp_path):
        (tmp_path / "mine.txt").write_text("")
        with pytest.raises(InputError, match="empty folder"):
            FabricScene(count=1).write(tmp_path)
        with pytest.raises(InputError, match="cannot be written"):
            FabricScene(count=1).write(tmp_path / "mine.txt" / "below")

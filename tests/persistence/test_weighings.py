"""Each checkpoint that a writer leaves at the end has a weighing, and whoever opens the memory answers by it."""

from touches import filled

from scroll_tactile import TactileLearner


def test_a_checkpoint_that_takes_the_place_of_one_has_its_weighing(tmp_path):
    learner, _ = filled(tmp_path / "m")
    with learner:
        learner.settle()
    for compacting in (False, True, False):
        with TactileLearner.open(tmp_path / "m") as learner:
            weighings = dict(learner.memory.weighings)
            assert weighings
            if compacting:
                learner.compact()
    with TactileLearner.open(tmp_path / "m", mode="read") as learner:
        assert learner.memory.weighings == weighings

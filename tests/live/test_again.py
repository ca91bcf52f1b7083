"""Several touches of one thing in a live session: what adds up, and what does not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from live_touches import EMBEDDINGS, GEL, frames, gel_learner, learner, predictions, rest, shift, slide
from touches import PAD

from scroll_tactile import TactileLearner
from scroll_tactile.errors import InputError
from scroll_tactile.live.session import MOST_EARLIER

RANDOM = np.random.default_rng(14)


def touched(live, touch, again=False):
    """A touch from begin to end of a manual session; what is to be said before it, and the touch as it ended."""
    if again:
        live.again()
    live.begin()
    live.push(touch)
    return live.end().touches[0]


@settings(max_examples=2, deadline=None)
@given(seed=st.integers(0, 50), length=st.integers(2, 70), sizes=st.lists(st.integers(0, 20), max_size=8))
@pytest.mark.parametrize("embedding", EMBEDDINGS)
def test_predictions_weigh_the_touches_of_one_thing(embedding, seed, length, sizes):
    made, random = learner(embedding), np.random.default_rng(seed)
    first, second = slide("b", 30, random), slide("b", length, random)
    with made.live(contact="manual", risk=1e-12) as live:
        earlier = touched(live, first).stream
        live.again()
        live.begin()
        shown, _ = predictions(live, second, sizes)
        ended = live.end().touches[0]
    assert ended.earlier == (earlier,)
    assert ended.prediction == made.predict(first, second)
    for prediction in shown:
        count = round((prediction.seconds - earlier.seconds) * PAD.rate)
        assert prediction == made.predict(first, second[:count])


def test_three_touches_add_up_and_one_without_again_counts_by_itself():
    made, touches = learner(), [slide("c", 20, RANDOM) for _ in range(4)]
    with made.live(contact="manual") as live:
        found = [touched(live, touch, again) for touch, again in zip(touches, (False, True, True, False), strict=True)]
    assert [len(touch.earlier) for touch in found] == [0, 1, 2, 0]
    assert found[2].prediction == made.predict(*touches[:3])
    assert found[3].prediction == made.predict(touches[3])
    assert found[3].decided == touched(made.live(contact="manual"), touches[3]).decided


def test_touches_that_are_found_add_up_too():
    made, (rows, places) = learner(), shift("aabb", 8)
    found = []
    with made.live() as live:
        for row in rows:
            now = live.push(row)
            found += now.touches
            if now.ended and len(found) in (1, 3):
                live.again()
    assert [len(touch.earlier) for touch in found] == [0, 1, 0, 1] and len(places) == 4
    for one, two in (found[:2], found[2:]):
        assert one.prediction == made.predict(one.stream)
        assert two.prediction == made.predict(one.stream, two.stream)


def test_said_while_a_touch_is_under_way_it_is_of_the_next():
    made, touches = learner(), [slide("a", 30, RANDOM) for _ in range(2)]
    with made.live(contact="manual") as live:
        live.begin()
        live.again()
        live.push(touches[0])
        assert live.end().prediction == made.predict(touches[0])
        assert touched(live, touches[1]).prediction == made.predict(*touches)


def test_frames_of_one_thing_add_up():
    made, found = gel_learner(), []
    with made.live() as live:
        for repetition in (7, 8):
            found += live.push(frames(GEL.materials[1], repetition, 5)).touches
            live.again()
    first, second = found
    assert second.earlier == (first.stream,)
    assert second.prediction == made.predict(first.stream, second.stream) != made.predict(second.stream)


def test_the_memory_is_that_of_when_the_last_of_them_began():
    made = TactileLearner(sensor=PAD, embedding=EMBEDDINGS["kernels"])
    for repetition in range(4):
        for material in "ab":
            made.observe(material, slide(material, 50, np.random.default_rng(repetition)))
    touches = [slide("c", 50, RANDOM) for _ in range(2)]
    with made.live(contact="manual") as live:
        assert touched(live, touches[0]).prediction.material != "c"
        for repetition in range(4):
            made.observe("c", slide("c", 60, np.random.default_rng(repetition)))
        made.settle()
        second = touched(live, touches[1], again=True).prediction
    assert second == made.predict(*touches)
    assert second.material == "c"


@pytest.mark.parametrize("scene", [None, ["c", "b"], "nothing was observed"])
def test_a_scene_is_that_of_all_of_them_and_of_an_empty_memory_nothing_adds_up(scene):
    made, touches = learner(), [slide("a", 30, RANDOM), slide("a", 20, RANDOM)]
    if isinstance(scene, str):
        made, scene = TactileLearner(sensor=PAD, embedding=EMBEDDINGS["kernels"]), None
    with made.live(contact="manual", scene=scene) as live:
        touched(live, touches[0])
        assert touched(live, touches[1], again=True).prediction == made.predict(*touches, scene=scene)


@pytest.mark.parametrize("said", ["before it", "of it"])
def test_a_contact_too_brief_for_a_touch_changes_nothing_and_is_a_thing_of_which_nothing_is_known(said):
    made, touches = learner(), [slide("b", 30, RANDOM) for _ in range(2)]
    with made.live(contact="manual") as live:
        touched(live, touches[0])
        if said == "before it":
            live.again()
        live.begin()
        live.push(touches[1][:1])
        if said == "of it":  # the next is as that, whatever it was
            live.again()
        assert not live.end().touches and live.report.brief == 1
        expected = made.predict(*(touches if said == "before it" else touches[1:]))
        assert touched(live, touches[1]).prediction == expected


def test_gaps_and_steps_back_in_time_change_nothing():
    made, rows = learner(), slide("b", 60, RANDOM)
    with made.live(contact="manual") as live:
        live.begin()
        live.push(rows[:30], time=np.arange(30) / PAD.rate)
        first = live.push(rows[30], time=90.0).touches[0]
        live.again()
        live.begin()
        live.push(rows[31:], time=10 + np.arange(29) / PAD.rate)
        second = live.end().touches[0]
    assert first.end == "gap" and second.prediction == made.predict(rows[:30], rows[31:])


def test_only_so_many_touches_of_one_thing_are_held():
    made, touches = learner(), [slide("b", 10, RANDOM) for _ in range(MOST_EARLIER + 3)]
    with made.live(contact="manual") as live:
        touched(live, touches[0])
        found = [touched(live, touch, again=True) for touch in touches[1:]]
    assert max(len(touch.earlier) for touch in found) == MOST_EARLIER
    assert found[-1].prediction == made.predict(*touches[-MOST_EARLIER - 1 :])


def test_again_without_a_touch_before_says_what_to_do():
    with learner().live() as live:
        with pytest.raises(InputError, match="between two touches"):
            live.again()
        live.push(rest(300, RANDOM))
        with pytest.raises(InputError, match="none has ended yet"):
            live.again()
    with pytest.raises(InputError, match="closed"):
        live.again()

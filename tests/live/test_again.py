"""Several touches of one thing in a live session: what adds up, and what does not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from live_touches import EMBEDDINGS, GEL, frames, gel_learner, learner, predictions, rest, shift, slide, touched
from touches import PAD

from scroll_tactile import TactileLearner
from scroll_tactile.errors import InputError
from scroll_tactile.live.session import MOST_EARLIER

RANDOM = np.random.default_rng(14)


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


def test_so_many_touches_add_up_and_one_without_again_counts_by_itself():
    made, touches = learner(), [slide("c", 20, RANDOM) for _ in range(MOST_EARLIER + 3)]
    with made.live(contact="manual") as live:
        found = [touched(live, touch, again=place > 0) for place, touch in enumerate(touches)]
        alone = touched(live, touches[0])
    assert [len(touch.earlier) for touch in found] == [*range(MOST_EARLIER + 1), MOST_EARLIER, MOST_EARLIER]
    assert found[2].prediction == made.predict(*touches[:3])
    assert found[-1].prediction == made.predict(*touches[-MOST_EARLIER - 1 :])
    assert not alone.earlier and alone.prediction == made.predict(touches[0])
    assert alone.decided == touched(made.live(contact="manual"), touches[0]).decided


def test_touches_that_are_found_add_up_too():
    made, found = learner(), []
    with made.live() as live:
        for row in shift("aabb", 8)[0]:
            now = live.push(row)
            found += now.touches
            if now.ended and len(found) in (1, 3):
                live.again()
    assert [len(touch.earlier) for touch in found] == [0, 1, 0, 1]
    for one, two in (found[:2], found[2:]):
        assert one.prediction == made.predict(one.stream)
        assert two.prediction == made.predict(one.stream, two.stream)


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
    made, touches = TactileLearner(sensor=PAD, embedding=EMBEDDINGS["kernels"]), [slide("c", 50, RANDOM) for _ in "12"]
    for repetition in range(4):
        for material in "ab":
            made.observe(material, slide(material, 50, np.random.default_rng(repetition)))
    with made.live(contact="manual") as live:
        assert touched(live, touches[0]).prediction.material != "c"
        for repetition in range(4):
            made.observe("c", slide("c", 60, np.random.default_rng(repetition)))
        made.settle()
        second = touched(live, touches[1], again=True).prediction
    assert second == made.predict(*touches) and second.material == "c"


@pytest.mark.parametrize("scene", [None, ["c", "b"], "nothing was observed"])
def test_a_scene_is_that_of_all_of_them_and_of_an_empty_memory_nothing_adds_up(scene):
    made, touches = learner(), [slide("a", 30, RANDOM), slide("a", 20, RANDOM)]
    if isinstance(scene, str):
        made, scene = TactileLearner(sensor=PAD, embedding=EMBEDDINGS["kernels"]), None
    with made.live(contact="manual", scene=scene) as live:
        touched(live, touches[0])
        assert touched(live, touches[1], again=True).prediction == made.predict(*touches, scene=scene)


@pytest.mark.parametrize(("said", "adds"), [("before a brief one", True), ("of a brief one", False), ("of it", True)])
def test_it_is_of_the_next_touch_and_a_contact_too_brief_for_one_changes_nothing(said, adds):
    made, touches = learner(), [slide("b", 30, RANDOM) for _ in range(2)]
    with made.live(contact="manual") as live:
        live.begin()
        if said == "of it":
            live.again()
        live.push(touches[0])
        assert live.end().prediction == made.predict(touches[0])
        if said != "of it":
            if adds:
                live.again()
            live.begin()
            live.push(touches[1][:1])
            if not adds:  # the next is as that, whatever it was
                live.again()
            assert not live.end().touches and live.report.brief == 1
        assert touched(live, touches[1]).prediction == made.predict(*touches[0 if adds else 1 :])


def test_again_without_a_touch_before_says_what_to_do():
    with learner().live() as live:
        live.push(rest(300, RANDOM))
        with pytest.raises(InputError, match=r"none has ended yet.*between two touches"):
            live.again()
    with pytest.raises(InputError, match="closed"):
        live.again()

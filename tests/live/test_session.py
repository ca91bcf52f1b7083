"""A live session: what it predicts, what it gives back, and what it refuses."""

import gc
import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from live_touches import EMBEDDINGS, GEL, frames, gel_learner, learner, predictions, rest, shift, slide, touched
from touches import PAD

from scroll_tactile import Frames, TactileLearner
from scroll_tactile.errors import (
    ChannelCountError,
    InputError,
    NotFiniteError,
    ReadingsTypeError,
    UnknownMaterialError,
)
from scroll_tactile.live.session import KEPT
from scroll_tactile.signals.contact import in_contact
from scroll_tactile.signals.stream import validate

RANDOM = np.random.default_rng(9)


def require_prefixes(made, shown, touch):
    """Every prediction is the learner's for a beginning of the touch, to the bit."""
    for prediction in shown:
        count = round(prediction.seconds * made.sensor.rate)
        if count <= len(touch):
            assert made.predict(touch.readings[:count]) == prediction


@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 50), length=st.integers(2, 90), data=st.data())
@pytest.mark.parametrize("embedding", EMBEDDINGS)
def test_predictions_are_those_of_the_touch_s_beginnings(embedding, seed, length, data):
    made, touch = learner(embedding), slide("abc"[seed % 3], length, np.random.default_rng(seed))
    sizes = data.draw(st.lists(st.integers(0, 20), max_size=12))
    with made.live(contact="manual", risk=1e-12) as live:
        live.begin()
        shown, _ = predictions(live, touch, sizes)
        now = live.end()
    assert now.prediction == made.predict(touch)
    assert now.touches[0].stream == live.touch
    assert live.touch.readings.tobytes() == touch.astype(np.float32).tobytes()
    require_prefixes(made, shown, live.touch)


@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 20), sizes=st.lists(st.integers(0, 200), max_size=10))
def test_touches_do_not_depend_on_how_readings_are_dealt_into_blocks(seed, sizes):
    made, (rows, places) = learner(), shift("abca", seed)
    with made.live() as whole, made.live() as dealt:
        expected = [touch for row in rows for touch in whole.push(row).touches]
        _, ended = predictions(dealt, rows, sizes)
    assert ended == expected
    assert len(ended) == len(places)
    assert dealt.report == whole.report
    assert dealt.touch == ended[-1].stream
    for touch in ended:
        assert touch.prediction == made.predict(touch.stream)


def test_a_touch_is_found_known_and_learned_from():
    made, (rows, places) = learner(), shift("abc", 3)
    named = []
    with made.live() as live:
        for i, row in enumerate(rows):
            now = live.push(row)
            if now.ended:
                named.append(now.prediction.material)
                begin, end = places[len(named) - 1]
                assert abs(now.touches[0].at * PAD.rate - begin) <= 2
                assert abs(len(live.touch) - (end - begin)) <= 3
                assert i - end < PAD.rate
                begun = round(now.touches[0].at * PAD.rate)
                file = rows[begun : begun + len(live.touch)].astype(np.float32)
                assert live.touch.readings.tobytes() == file.tobytes()
    assert named == list("abc")
    copy = TactileLearner(sensor=PAD, embedding=EMBEDDINGS["kernels"])
    assert copy.observe("c", live.touch).key == live.touch.key


def test_a_touch_tells_the_half_second_at_rest_before_it():
    rows, places = shift("ab")
    session = learner().live()
    touches = [touch for row in rows for touch in session.push(row).touches]
    for (begin, _), touch in zip(places, touches, strict=True):
        found = round(touch.at * PAD.rate)
        assert abs(found - begin) <= 3
        assert np.array_equal(touch.rest.readings, rows[found - 25 : found].astype(np.float32))
    assert touched(learner().live(contact="manual"), rows[places[0][0] : places[0][1]]).rest is None


def test_decided_never_goes_back_and_what_happens_in_a_block_is_not_lost():
    made, (rows, _) = learner(repetitions=12), shift("ab", 4)
    with made.live(risk=0.3) as live:
        decided = False
        for row in rows:
            now = live.push(row)
            assert now.decided or not (decided and now.contact)
            decided = now.decided and now.contact
    with made.live(risk=0.3) as block:
        now = block.push(rows)
    assert now.ended and len(now.touches) == 2
    assert not now.contact and now.prediction == now.touches[-1].prediction
    assert block.report.undecided == sum(not touch.decided for touch in now.touches)


@pytest.mark.parametrize("count", [1, 3, 5, 30])
def test_frames_are_found_behind_the_gel_at_rest(count):
    made, rows = gel_learner(), frames(GEL.materials[1], 7, count)
    with made.live(risk=1e-12) as live:
        shown, ended = predictions(live, rows, [1] * len(rows))
    touching = np.flatnonzero(in_contact(validate(rows, GEL.sensor), "first"))
    if count == 1:  # one frame is none yet
        assert not ended
        return
    assert len(ended[0].stream) == 1 + len(touching)
    assert ended[0].prediction == made.predict(rows[[0, *touching]])
    require_prefixes(made, shown, live.touch)


def test_a_touch_that_never_ends_is_kept_up_to_a_limit():
    made = learner()
    limit = round(KEPT * PAD.rate)
    touch = slide("a", limit + 500, RANDOM)
    with made.live() as live:
        live.push(rest(800, RANDOM))
        ring = live._recent.maxlen
        first = live.push(touch)
        room = len(live._under_way.rows)
        for _ in range(3):
            now = live.push(slide("a", limit, RANDOM))
        assert (len(live._under_way.rows), live._recent.maxlen) == (room, ring)
        assert now.contact and now.seconds > 3 * KEPT
        assert first.prediction == now.prediction
        done = live.push(rest(200, RANDOM))
    assert done.ended and len(live.touch) == limit
    assert done.prediction == made.predict(live.touch)
    assert live.report.truncated == 1


def test_a_gap_before_the_first_reading_of_a_touch_does_not_end_it():
    rows, [(begin, end)] = shift("b")
    session = learner().live(contact="manual")
    session.push(rows[0], 0.0)
    session.begin()
    for i, row in enumerate(rows[begin:end]):
        session.push(row, 50.0 + i / PAD.rate)
    [touch] = session.end().touches
    assert touch.end == "end" and len(touch.stream) == end - begin
    assert session.report.gaps == 1


def test_a_decision_that_the_whole_touch_takes_back_is_called_revised():
    made, random = learner(repetitions=12), np.random.default_rng(3)
    with made.live(contact="manual", risk=0.3) as live:
        for rest_of_it, revised in (("a", None), ("b", "a")):
            live.begin()
            begun = slide("a", 50, random)
            now = live.push(begun[:20])
            assert now.decided and now.prediction.material == "a"
            live.push(begun[20:] if rest_of_it == "a" else slide(rest_of_it, 30, random))
            (touch,) = live.end().touches
            assert touch.prediction.material == rest_of_it
            assert (touch.revised and touch.revised.material) == revised
        assert (live.report.touches, live.report.revised) == (2, 1)


def test_a_decision_is_revised_where_the_whole_touch_cannot_tell_any_more():
    random = np.random.default_rng(2)
    touch = slide("a", 50, random)
    touch[20:] = np.clip(touch[20:] + 0.3 * random.standard_normal(touch[20:].shape), 0, 1)
    with learner(repetitions=7).live(contact="manual", risk=0.3) as live:
        live.begin()
        now = live.push(touch[:20])
        live.push(touch[20:])
        (ended,) = live.end().touches
    assert now.decided and now.prediction.known is True
    assert ended.decided and ended.prediction.known is None and ended.revised == now.prediction


def test_an_answer_says_how_old_it_is():
    with learner().live(contact="manual", risk=1e-12) as live:
        assert live.push(rest(10, RANDOM)).age == live.begin().age == 0
        shown, states = [], [live.push(row) for row in slide("a", 60, RANDOM)]
        assert live.end().age == 0
    for before, now in zip([None, *states], states, strict=False):
        fresh = now.prediction is not None and (before is None or now.prediction is not before.prediction)
        shown += [now.age] if fresh else []
        assert now.age == (0 if fresh or now.prediction is None else pytest.approx(before.age + 1 / PAD.rate))
    assert len(shown) > 1


def test_what_stays_undecided_says_so():
    with learner().live(contact="manual") as live:
        ended = touched(live, np.random.default_rng(0).uniform(0, 1, (50, 2)))
    assert not ended.decided and not ended.likely
    assert live.report.undecided == 1


@pytest.mark.parametrize(("repetitions", "known"), [(6, None), (12, True)])  # 18 touches are one too few to tell
def test_what_is_likely_is_decided_where_it_can_be_known(repetitions, known):
    with learner(repetitions=repetitions).live(contact="manual", risk=0.3) as live:
        live.begin()
        now = live.push(slide("b", 50, np.random.default_rng(5)))
        ended = live.end().touches[0]
    for answer in (now, ended):
        assert (answer.prediction.material, answer.likely, answer.decided) == ("b", True, known is True)
    assert now.prediction.known is ended.prediction.known is known
    assert live.report.undecided == (known is None)


def test_frames_without_a_resting_image_need_a_hand_and_of_nothing_observed_nothing_is_known():
    made = TactileLearner(sensor=GEL.sensor, embedding=Frames(rest=None))
    with pytest.raises(InputError, match="manual"):
        made.live()
    with made.live(contact="manual") as live:
        ended = touched(live, GEL.touch(GEL.materials[0], 0).readings)
    assert ended.prediction.material is None and not ended.decided and not ended.prediction.known


def test_sessions_opened_and_left_are_gone():
    made, rows, threads, counts = learner(), rest(110, RANDOM), threading.active_count(), []
    for _ in range(2):
        for _ in range(50):
            made.live().push(rows)
        gc.collect()
        counts.append(len(gc.get_objects()))
    assert counts[1] - counts[0] < 50 and threading.active_count() == threads


def test_a_scene_is_asked_for_by_its_names():
    made, touch = learner(), slide("a", 50, RANDOM)
    with made.live(contact="manual", scene=["c", "b"]) as live:
        assert touched(live, touch).prediction == made.predict(touch, scene=["b", "c"])


@pytest.mark.parametrize(
    ("given_", "kind", "message"),
    [
        ({"risk": 0}, InputError, "risk"),
        ({"risk": 1.5}, InputError, "risk"),
        ({"contact": "always"}, InputError, "'auto' or 'manual'"),
        ({"false_contacts": 0}, InputError, "false_contacts"),
        ({"false_contacts": float("nan")}, InputError, "false_contacts"),
        ({"scene": ["d"]}, UnknownMaterialError, "'d'"),
    ],
)
def test_settings_that_cannot_be_are_refused(given_, kind, message):
    with pytest.raises(kind, match=message):
        learner().live(**given_)


def test_begin_and_end_belong_to_manual_sessions_and_a_closed_one_ends_its_touch_and_takes_nothing():
    with learner().live() as live:
        for refused in (live.begin, live.end):
            with pytest.raises(InputError, match="manual"):
                refused()
    with learner().live(contact="manual") as live:
        assert live.push(np.empty((0, 2))) == live.push([])
        live.begin()
        live.push(slide("a", 20, RANDOM))
        before = live.push([])
        assert live.push(np.empty((0, 2)), time=[]) == before and before.seconds == 20 / PAD.rate
    assert len(live.touch) == 20 and live.report.touches == 1
    with pytest.raises(InputError, match="closed"):
        live.push(rest(1, RANDOM))
    live.close()


def test_what_are_no_readings_is_refused_in_the_middle_of_a_touch_and_changes_nothing():
    touch = slide("a", 40, RANDOM)
    with learner().live(contact="manual") as live:
        live.begin()
        live.push(touch[:20])
        for wrong in (np.zeros(3), np.zeros((4, 3)), np.zeros((2, 2, 2)), [[1.0, 2.0], [1.0]], 5.0):
            with pytest.raises(ChannelCountError):
                live.push(wrong)
        for wrong, kind in ((["a", "b"], ReadingsTypeError), ([np.nan, 0.5], NotFiniteError)):
            with pytest.raises(kind):
                live.push(wrong)
        with pytest.raises(NotFiniteError):
            live.push(np.array([np.inf, 0.5]))
        live.push(touch[20:])
        assert live.end().prediction == learner().predict(touch) and live.report.readings == 40


def test_missing_values_are_missing_where_the_sensor_says_so():
    sensor = PAD.model_copy(update={"non_finite": "missing"})
    made = TactileLearner(sensor=sensor, embedding=EMBEDDINGS["kernels"])
    for repetition in range(3):
        for material in "ab":
            made.observe(material, slide(material, 50, np.random.default_rng(repetition)))
    rows, places = shift("ab", 6)
    rows[::7, 0] = np.nan
    rows[[5, 130, 140]] = np.nan
    rows[places[1][0] - 30 : places[1][0]] = np.nan  # nothing is read at rest before the second
    with made.live() as live:
        _, ended = predictions(live, rows, [1] * len(rows))
        assert live.report.missing == np.isnan(rows).sum()
    assert [touch.rest is None for touch in ended] == [False, True]
    for touch, (begin, _) in zip(ended, places, strict=True):
        first = round(touch.at * PAD.rate)
        assert abs(first - begin) <= 3
        assert touch.prediction == made.predict(rows[first : first + len(touch.stream)])

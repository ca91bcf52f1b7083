"""A live session: what it predicts, what it gives back, and what it refuses."""

import gc
import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from live_touches import EMBEDDINGS, GEL, frames, gel_learner, learner, predictions, rest, shift, slide
from touches import PAD

from scroll_tactile import TactileLearner
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


def test_each_prediction_shows_when_readings_come_one_by_one():
    made, touch = learner(), slide("b", 50, RANDOM)
    with made.live(contact="manual", risk=1e-12) as live:
        live.begin()
        shown, _ = predictions(live, touch, [1] * 50)
    assert len(shown) > 3
    require_prefixes(made, shown, live.touch)
    assert [prediction.seconds for prediction in shown] == sorted({prediction.seconds for prediction in shown})


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
    session = learner().live(contact="manual")
    session.begin()
    session.push(rows[places[0][0] : places[0][1]])
    assert session.end().touches[0].rest is None


def test_decided_never_goes_back_and_what_happens_in_a_block_is_not_lost():
    made, (rows, _) = learner(), shift("ab", 4)
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


def test_what_stays_undecided_says_so():
    made = learner()
    strange = np.random.default_rng(0).uniform(0, 1, (50, 2))
    with made.live(contact="manual") as live:
        live.begin()
        live.push(strange)
        now = live.end()
    assert not now.decided and not now.touches[0].decided
    assert live.report.undecided == 1


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


def test_frames_without_a_resting_image_need_a_hand():
    from scroll_tactile import Frames

    made = TactileLearner(sensor=GEL.sensor, embedding=Frames(rest=None))
    with pytest.raises(InputError, match="manual"):
        made.live()
    with made.live(contact="manual") as live:
        live.begin()
        live.push(GEL.touch(GEL.materials[0], 0).readings)
        assert live.end().touches[0].prediction.material is None


def test_before_anything_was_observed_nothing_is_known():
    with TactileLearner(sensor=PAD, embedding=EMBEDDINGS["kernels"]).live() as live:
        now = live.push(shift("a")[0])
    assert now.prediction.material is None and not now.decided and not now.prediction.known


def test_sessions_opened_and_left_are_gone():
    made = learner()
    rows = rest(110, RANDOM)
    threads = threading.active_count()

    def opened():
        live = made.live()
        live.push(rows)

    opened()
    gc.collect()
    before = len(gc.get_objects())
    for _ in range(100):
        opened()
    gc.collect()
    assert len(gc.get_objects()) - before < 50
    assert threading.active_count() == threads


def test_a_scene_is_asked_for_by_its_names():
    made, touch = learner(), slide("a", 50, RANDOM)
    with made.live(contact="manual", scene=["c", "b"]) as live:
        live.begin()
        live.push(touch)
        now = live.end()
    assert now.prediction == made.predict(touch, scene=["b", "c"])
    with pytest.raises(UnknownMaterialError, match="'d'"):
        made.live(scene=["d"])


@pytest.mark.parametrize(
    ("given_", "message"),
    [
        ({"risk": 0}, "risk"),
        ({"risk": 1.5}, "risk"),
        ({"contact": "always"}, "'auto' or 'manual'"),
        ({"false_contacts": 0}, "false_contacts"),
        ({"false_contacts": float("nan")}, "false_contacts"),
    ],
)
def test_settings_that_cannot_be_are_refused(given_, message):
    with pytest.raises(InputError, match=message):
        learner().live(**given_)


def test_begin_and_end_belong_to_manual_sessions_and_closed_ones_take_nothing():
    with learner().live() as live:
        with pytest.raises(InputError, match="manual"):
            live.begin()
        with pytest.raises(InputError, match="manual"):
            live.end()
    with pytest.raises(InputError, match="closed"):
        live.push(rest(1, RANDOM))
    live.close()


def test_a_touch_under_way_ends_with_the_session():
    with learner().live(contact="manual") as live:
        live.begin()
        live.push(slide("a", 20, RANDOM))
    assert len(live.touch) == 20 and live.report.touches == 1


def test_a_block_of_none_changes_nothing():
    with learner().live(contact="manual") as live:
        assert live.push(np.empty((0, 2))) == live.push([])
        live.begin()
        live.push(slide("a", 10, RANDOM))
        before = live.push([])
        assert live.push(np.empty((0, 2)), time=[]) == before
        assert before.contact and before.seconds == 10 / PAD.rate


def test_a_block_of_many_readings_is_one_block():
    fast = PAD.model_copy(update={"rate": 1000.0})
    random = np.random.default_rng(6)
    rows = rest(10**5, random)
    for first in range(2000, 10**5, 20_000):
        rows[first : first + 500] = slide("a", 500, random)
    with TactileLearner(sensor=fast, embedding=EMBEDDINGS["kernels"]).live() as live:
        now = live.push(rows)
    assert len(now.touches) == 5
    assert live.report.ticks == 10**5


@pytest.mark.parametrize("wrong", [np.zeros(3), np.zeros((4, 3)), np.zeros((2, 2, 2)), [[1.0, 2.0], [1.0]], 5.0])
def test_another_number_of_channels_in_the_middle_of_a_touch(wrong):
    touch = slide("a", 40, RANDOM)
    with learner().live(contact="manual") as live:
        live.begin()
        live.push(touch[:20])
        with pytest.raises(ChannelCountError):
            live.push(wrong)
        live.push(touch[20:])
        assert live.end().prediction == learner().predict(touch)


def test_values_that_are_no_readings():
    with learner().live() as live:
        with pytest.raises(ReadingsTypeError):
            live.push(["a", "b"])
        with pytest.raises(NotFiniteError):
            live.push([np.nan, 0.5])
        with pytest.raises(NotFiniteError):
            live.push(np.array([np.inf, 0.5]))
        assert live.report.readings == 0


def test_missing_values_are_missing_where_the_sensor_says_so():
    sensor = PAD.model_copy(update={"non_finite": "missing"})
    made = TactileLearner(sensor=sensor, embedding=EMBEDDINGS["kernels"])
    for repetition in range(3):
        for material in "ab":
            made.observe(material, slide(material, 50, np.random.default_rng(repetition)))
    rows, places = shift("ab", 6)
    rows[::7, 0] = np.nan
    rows[[5, 130, 140]] = np.nan
    with made.live() as live:
        _, ended = predictions(live, rows, [1] * len(rows))
        assert live.report.missing == np.isnan(rows).sum()
    assert len(ended) == len(places)
    for touch, (begin, _) in zip(ended, places, strict=True):
        assert abs(touch.at * PAD.rate - begin) <= 3
        first = round(touch.at * PAD.rate)
        assert touch.prediction == made.predict(rows[first : first + len(touch.stream)])


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
    made, random = learner(), np.random.default_rng(3)
    with made.live(contact="manual", risk=0.3) as live:
        for rest_of_it, revised in (("a", None), ("b", "a")):
            live.begin()
            now = live.push(slide("a", 20, random))
            assert now.decided and now.prediction.material == "a"
            live.push(slide(rest_of_it, 30, random))
            (touch,) = live.end().touches
            assert touch.prediction.material == rest_of_it
            assert (touch.revised and touch.revised.material) == revised
        assert (live.report.touches, live.report.revised) == (2, 1)


def test_a_touch_counts_where_the_sensor_said_nothing_before_it():
    sensor = PAD.model_copy(update={"non_finite": "missing"})
    made = TactileLearner(sensor=sensor, embedding=EMBEDDINGS["kernels"])
    random = np.random.default_rng(0)
    live = made.live()
    live.push(rest(200, random))
    live.push(np.full((30, PAD.channels), np.nan))
    touches = [*live.push(slide("a", 60, random)).touches, *live.push(rest(80, random)).touches]
    assert len(touches) == 1 and touches[0].rest is None

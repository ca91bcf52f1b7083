"""From messages to answers; nothing of ROS is needed for it."""

import array
import copy
import itertools
import json
from collections import Counter

import numpy as np
import pytest
from live_touches import learner, shift, slide
from robot import Bare, ended, stamped, taught
from touches import PAD, SMALL

from scroll_tactile import Quantity, TactileLearner, errors
from scroll_tactile.clients.ros2 import Bridge
from scroll_tactile.clients.ros2.bridge import RESTLESS
from scroll_tactile.signals.correction import Correction

ROWS, PLACES = shift("ab")


@pytest.fixture
def own(tmp_path):
    with TactileLearner.open(taught(tmp_path / "memory", PAD, SMALL)) as opened:
        yield opened


def bridge(field="values", source=None, **how):
    answers, warnings = [], []
    made = Bridge(source or learner(), field, answer=answers.append, warn=warnings.append, **how)
    return made, answers, warnings


def run(made, rows=ROWS, start=1000.0, rate=50.0):
    for i, row in enumerate(rows):
        made.receive(stamped(row, start + i / rate), 5.0 + i / rate)


def test_answers_are_those_of_a_live_session():
    made, answers, warnings = bridge()
    run(made)
    session = learner().live()
    touches = [touch for i, row in enumerate(ROWS) for touch in session.push(row, 1000 + i / 50).touches]
    told = [answer for answer in answers if answer["event"] == "ended"]
    assert [answer["material"] for answer in told] == ["a", "b"] == [touch.prediction.material for touch in touches]
    assert [answer["probability"] for answer in told] == [
        touch.prediction.as_json()["probability"] for touch in touches
    ]
    assert [answer["candidates"] for answer in told] == [touch.prediction.candidates() for touch in touches]
    assert [answer["seconds"] for answer in told] == [touch.stream.seconds for touch in touches]
    assert not warnings
    assert made.status()["messages"] == made.status()["readings"] == len(ROWS)
    json.dumps(answers, allow_nan=False)


def test_a_topic_of_another_rate_and_odd_touches_are_spoken_of_once(own):
    made, _, warnings = bridge(source=own, contact="manual")
    run(made, np.tile(ROWS[:150], (2, 1)), rate=25.0)
    assert len(warnings) == 1 and "it has 25 readings a second, and sensor 'pad' has 50" in warnings[0]
    made.begin()
    run(made, np.full((50, ROWS.shape[1]), 0.5), start=2000.0)
    made.end()
    made.learn("A")
    assert any("A: nothing moves" in each for each in warnings) and any("beside 'a'" in each for each in warnings)


def test_a_watched_sensor_is_noted_at_rest_and_in_known_touches_that_nobody_learns(tmp_path):
    with TactileLearner.open(tmp_path / "m", sensor=PAD, embedding=SMALL) as own:
        random = np.random.default_rng(1)
        for material in "abc" * 12:
            own.observe(material, slide(material, 50, random))
        own.settle()

        def noted():
            return Counter(row.label for row in own._ledger.store.heads() if row.kind == "sense")

        made, answers, _ = bridge(source=own, watch=True)
        run(made)
        certain = [answer["decided"] and answer["known"] for answer in answers if answer["event"] == "ended"]
        assert certain == [True, True]
        assert noted() == {"": 2, "a": 1}  # of the last touch it may still be said what it was
        made.learn("b")
        made.close()
        assert noted() == {"": 2, "a": 1}  # its own row has the numbers
        made, *_ = bridge(source=own, watch=True)
        run(made, start=2000.0)
        made.close()
        assert noted() == {"": 4, "a": 2}  # the second touch has the readings of the one that was learned


def test_an_answer_is_given_only_when_something_changed():
    made, answers, _ = bridge()
    run(made)
    assert answers[0]["event"] == "began" and answers[0]["contact"]
    assert len(answers) < len(ROWS) / 10
    told = [{name: value for name, value in each.items() if name not in ("stamp", "seconds")} for each in answers]
    assert all(one != after for one, after in itertools.pairwise(told))


@pytest.mark.parametrize(("field", "said"), [("value", "nearest is 'values'"), ("header", "leads to a message")])
def test_the_first_message_without_the_field_says_what_there_is(field, said):
    made, _, _ = bridge(field)
    with pytest.raises(errors.FieldError, match=said):
        made.receive(stamped(ROWS[0], 1.0), 1.0)


@pytest.mark.parametrize("values", [[0.1], [0.1] * 3, [], [np.nan, 0.1], [np.inf, 0.1]], ids=str)
def test_messages_without_a_reading_are_left_out_and_said_once(values):
    made, answers, warnings = bridge()
    for i, row in enumerate(ROWS):
        made.receive(stamped(row, 1000 + i / 50), i / 50)
        made.receive(stamped(values, 1000 + i / 50), i / 50)
    assert made.report.refused == len(ROWS) and len(warnings) == 1
    assert ended(answers) == ["a", "b"]


def test_a_touch_is_learned_once_and_forgotten(own):
    made, _, _ = bridge(source=own)
    with pytest.raises(errors.InputError, match="none has ended"):
        made.learn("felt")
    run(made)
    assert made.learn("felt").startswith("felt: ")
    assert own.materials["felt"] == 1
    assert "learned already, as observation" in made.learn("felt") and own.materials["felt"] == 1
    again, _, _ = bridge(source=own)  # as after a restart
    run(again)
    assert "learned already" in again.learn("felt") and again.learned is None
    assert again.receipt == made.receipt == made.learned is not None
    with pytest.raises(errors.InputError, match="already, as 'felt' and not as 'denim': relabel one of them"):
        made.learn("denim")
    assert made.forget("felt") == "felt: 1 observation forgotten"
    with pytest.raises(errors.UnknownMaterialError):
        made.forget("felt")
    with pytest.raises(errors.InputError, match="manual"):
        made.begin()


def test_paused_a_touch_can_be_learned_and_resumed_it_answers_as_it_was_adjusted(own):
    made, answers, _ = bridge(source=own)
    run(made, ROWS[: PLACES[0][1] - 5])
    made.pause()
    assert answers[-1]["event"] == "paused" and not answers[-1]["contact"]
    made.adjust(risk=0.05, scene=["b", "c"])
    made.resume()
    assert made.learn("felt").startswith("felt: ")
    answers.clear()
    run(made, start=2000.0)
    assert {name for answer in answers for name, _ in answer.get("ranking", ())} == {"b", "c"}


def test_touches_that_somebody_else_begins_and_ends():
    made, answers, _ = bridge(contact="manual")
    rows = ROWS[slice(*PLACES[1])]
    assert made.end() == "no touch was under way"
    made.begin()
    run(made, rows[:1])
    assert made.end() == "the touch was too short to be one"
    assert answers[-1]["event"] == "brief" and not answers[-1]["contact"]
    made.begin()
    run(made, rows, start=2000.0)
    assert made.end().endswith(": b")
    assert answers[-1]["event"] == "ended" and answers[-1]["end"] == "end"


def test_answers_are_by_an_axis_of_labels_where_one_is_named():
    source = TactileLearner(sensor=PAD, embedding=SMALL, exemplars=0)
    for i in range(8):
        for name, way in (("a", "north"), ("b", "south")):
            source.observe(name, slide(name, 50, np.random.default_rng(i)), labels={"slip": way})
    made, answers, _ = bridge(source=source, of="slip")
    run(made)
    assert {answer["of"] for answer in answers} == {"slip"}
    assert ended(answers) == ["north", "south"]
    with pytest.raises(errors.AnnotationError, match="expected an axis that touches have labels on"):
        bridge(source=source, of="way")


@pytest.mark.parametrize("text", ["", "-1", "1.0", " 7", "٣", "1" * 20, "1" * 5000], ids=lambda text: text[:20])
def test_what_is_no_number_of_an_observation_is_refused(own, text):
    made, *_ = bridge(source=own)
    with pytest.raises(errors.InputError, match="expected the number of an observation"):
        made.retract(text)
    with pytest.raises(errors.ObservationError):
        made.retract("9" * 19)


def test_an_adaptation_is_not_taken_back_as_an_observation(own):
    row = own._ledger.adapt(Correction.none(PAD.channels))
    made, *_ = bridge(source=own)
    with pytest.raises(errors.InputError, match=r"an adaptation to a changed skin.*scroll-tactile memory retract"):
        made.retract(str(row))
    assert own.memory.correction is not None


def test_a_session_that_begins_anew_says_nothing_of_the_rest_before():
    made, _, warnings = bridge()
    run(made, np.concatenate([slide("b", 50, np.random.default_rng(9)), ROWS[:70]]))
    assert warnings == [RESTLESS]
    made.pause()
    made.resume()
    run(made, ROWS[:10], start=2000.0)
    assert warnings == [RESTLESS]


def test_a_paused_bridge_says_how_touches_can_begin_again():
    made, *_ = bridge(contact="manual")
    made.pause()
    for call in (made.begin, made.end, made.again):
        with pytest.raises(errors.InputError, match=r"no readings are taken.*activate"):
            call()
    made.resume()
    assert made.begin()


@pytest.mark.parametrize(
    ("stamp", "unstamped"),
    [
        (lambda i: None, 0),  # a message without a header
        (lambda i: 0, len(ROWS)),
        (lambda i: 0 if i % 10 == 7 else 1000 + i / 50, len(ROWS[7::10])),
    ],
    ids=["none", "zero", "some"],
)
def test_without_a_stamp_the_time_of_publishing_counts_on_the_stamps_clock(stamp, unstamped):
    made, answers, _ = bridge("values" if unstamped else "data")
    for i, row in enumerate(ROWS):
        message = stamped(row, stamp(i)) if unstamped else Bare(array.array("d", row))
        made.receive(message, 5 + i / 50)
    status = made.status()
    assert status["unstamped"] == unstamped
    assert status["gaps"] == status["steps_back"] == status["lost"] == 0
    assert ended(answers) == ["a", "b"]


def test_answers_carry_estimates_where_a_quantity_was_declared():
    source = copy.deepcopy(learner())
    source.declare(Quantity(name="force", unit="N", low=0.0, high=2.0, resolution=0.01))
    made, answers, _ = bridge(source=source)
    run(made)
    first = next(answer for answer in answers if answer["event"] == "ended")
    assert first["estimates"]["force"]["value"] is None and "0 sampled" in first["estimates"]["force"]["missing"]


def test_what_was_learned_last_is_taken_back_first_once_and_not_after_somebody_else_did(own):
    made, _, _ = bridge(source=own)
    numbers = []
    for i, name in enumerate(["wool", "felt", "lace", "silk", "cork"]):
        run(made, shift("b", seed=i)[0], start=1000.0 + 100 * i)
        made.learn(name)
        numbers.append(made.learned.sequence)
    made.forget("cork")
    assert made.learned.sequence == numbers[3]
    made.retract(str(numbers[3]))
    own.retract(numbers[2])
    for name, number in (("felt", numbers[1]), ("wool", numbers[0])):
        assert made.undo().startswith(f"{name}: observation {number} was taken back")
    assert made.learned is None and own.materials == {"a": 12, "b": 12, "c": 12}
    with pytest.raises(errors.InputError, match="there is none"):
        made.undo()


def test_what_was_met_adds_up_over_pauses():
    made, *_ = bridge()
    run(made)
    made.pause()
    once = made.status()
    made.resume()
    assert made.status() == once | {"learning": True}
    run(made, start=2000.0)
    both = made.status()
    assert (once["touches"], both["touches"]) == (2, 4)
    assert both["readings"] == both["messages"] == 2 * len(ROWS)

"""What a live session says, in MCAP files: read again with the package's reader, checked against their own schemas."""

import json
import subprocess
import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path

import bags
import numpy as np
import pytest
from commands import refused, run
from jsonschema import Draft202012Validator
from live_touches import learner, shift, slide
from mcap.reader import NonSeekingReader, make_reader
from touches import PAD, SMALL

from scroll_tactile import AnswerLog, Quantity, TactileLearner
from scroll_tactile.clients.learning.annotating import answer_log
from scroll_tactile.errors import InputError
from scroll_tactile.live.answers import LiveState, LiveTouch
from scroll_tactile.recordings import read
from scroll_tactile.results import Prediction
from scroll_tactile.signals.stream import validate

START = 1_760_000_000.0


def messages(path):
    """Topic, log time in ns, and content of each message, each checked against the schema that the file has."""
    with path.open("rb") as file:
        reader, found = make_reader(file), []
        assert reader.get_summary() is not None
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            found.append(checked(schema, channel, message))
    return found


def checked(schema, channel, message):
    assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
    about, content = json.loads(schema.data), json.loads(message.data)
    Draft202012Validator.check_schema(about)
    Draft202012Validator(about).validate(content)
    assert about["type"] == "object" and all(isinstance(each["type"], str) for each in about["properties"].values())
    return channel.topic, message.log_time, content


def logged(path, readings, session, start=START):
    states = []
    with session, AnswerLog(path) as log:
        for i, reading in enumerate(readings):
            states.append(session.push(reading, start + i / PAD.rate))
            log.note(states[-1], start + i / PAD.rate)
    return states


def test_all_that_a_session_says_is_read_again(tmp_path):
    readings, places = shift("ab")
    states = logged(tmp_path / "a.mcap", readings, learner().live())
    found = messages(tmp_path / "a.mcap")
    of = {topic: [(at, content) for t, at, content in found if t == topic] for topic, _, _ in found}
    assert len(of["/touch/state"]) == len(readings)
    assert [at for at, _ in of["/touch/state"]] == [round((START + i / 50) * 1e9) for i in range(len(readings))]
    assert [content["contact"] for _, content in of["/touch/state"]] == [state.contact for state in states]
    assert [content["contact"] for _, content in of["/touch/contact"]] == [True, False] * 2
    ended = [content for _, content in of["/touch/answer"] if content["ended"]]
    touches = [touch for state in states for touch in state.touches]
    assert [content["material"] for content in ended] == [*"ab"] == [touch.prediction.material for touch in touches]
    assert [content["probability"] for content in ended] == [touch.prediction.probability for touch in touches]
    assert {content["end"] for content in ended} == {"released"}
    answers = sum(b.prediction is not a.prediction and b.contact for a, b in pairwise([states[0], *states]))
    assert len(of["/touch/answer"]) >= answers + 2 > 4
    for (at, _), (begin, _) in zip(of["/touch/contact"][::2], places, strict=True):
        assert abs(at / 1e9 - START - begin / 50) < 0.2
    ours = read(tmp_path / "a.mcap", topic="/touch/state", field="seconds")
    assert ours.readings[:, 0].tolist() == [state.seconds for state in states]


def test_estimates_and_what_is_unknown_fit_the_schema(tmp_path):
    made, random = TactileLearner(sensor=PAD, embedding=SMALL), np.random.default_rng(3)
    made.declare(Quantity(name="force", unit="N", low=0.0, high=10.0, resolution=0.01))
    session = TactileLearner(sensor=PAD, embedding=SMALL).live(contact="manual")
    with AnswerLog(tmp_path / "nothing.mcap") as log:
        for state in (session.begin(), session.push(slide("a", 50, random)), session.end()):
            log.note(state, 0.0)
    contents = [content for topic, _, content in messages(tmp_path / "nothing.mcap") if topic == "/touch/answer"]
    assert contents[-1]["known"] == 0 and contents[-1]["material"] == "" and "novelty" not in contents[-1]
    for i in range(60):
        made.observe("abc"[i % 3], slide("abc"[i % 3], 50, random) * (0.5 + i / 120), values={"force": i / 10})
    session = made.live(contact="manual")
    with AnswerLog(tmp_path / "force.mcap") as log:
        for state in (session.begin(), session.push(slide("a", 50, random)), session.end()):
            log.note(state, 1.0)
    contents = [content for topic, _, content in messages(tmp_path / "force.mcap") if topic == "/touch/answer"]
    (estimate,), expected = contents[-1]["estimates"], state.touches[0].estimates["force"]
    assert estimate == {
        "name": "force",
        "unit": "N",
        "value": expected.value,
        "low": expected.low,
        "high": expected.high,
    }


def test_a_touch_behind_another_begins_and_what_cannot_be_told_is_neither(tmp_path):
    rows, prediction = np.full((10, 2), 0.5), Prediction("a", 0.9, (("a", 0.9),), 1.0, None, 0.2)
    ended = LiveTouch(validate(rows, PAD), prediction, False, 0.0, "gap")
    with AnswerLog(tmp_path / "a.mcap") as log:
        log.note(LiveState(True, 0.2, prediction), 0.2)
        log.note(LiveState(True, 0.1, None, False, True, (ended,)), 1.1)
    found = messages(tmp_path / "a.mcap")
    assert [content["seconds"] for topic, _, content in found if topic == "/touch/contact"] == [0.2, 0.1]
    assert [content["known"] for topic, _, content in found if topic == "/touch/answer"] == [-1, -1]


KILLED = """
import sys, time
sys.path[:0] = {path!r}
from live_touches import learner, shift
from scroll_tactile import AnswerLog
session, log = learner("own").live(), AnswerLog({file!r})
readings = [*shift("ab")[0], *shift("ba", seed=1)[0]]
for i, reading in enumerate(readings):
    log.note(session.push(reading), i / 50)
print(len(readings), flush=True)
time.sleep(300)
"""


def test_a_process_that_is_killed_leaves_all_but_the_last_second(tmp_path):
    file = tmp_path / "a.mcap"
    code = KILLED.format(path=sys.path, file=str(file))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        count = int(process.stdout.readline())
        process.kill()
    with file.open("rb") as stream:
        found = [checked(*each) for each in messages_of_a_cut_off_file(stream)]
    states = [content for topic, _, content in found if topic == "/touch/state"]
    assert count - 51 <= len(states) < count and Counter(topic for topic, _, _ in found)["/touch/contact"] >= 6
    ours = read(file, topic="/touch/state", field="seconds")
    assert ours.report.cut_off and ours.readings[:, 0].tolist() == [content["seconds"] for content in states]


def messages_of_a_cut_off_file(stream):
    reader = NonSeekingReader(stream).iter_messages(log_time_order=False)
    while True:
        try:
            yield next(reader)
        except StopIteration:
            return
        except Exception as error:  # its kinds differ; that the file ends is what they say
            assert "end" in str(error).lower() or "EndOfFile" in type(error).__name__, error
            return


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # the full file, closed
def test_a_log_is_new_open_and_has_times(tmp_path, monkeypatch):
    log = AnswerLog(tmp_path / "a.mcap")
    state = learner().live(contact="manual").begin()
    for wrong in (-1.0, float("nan"), 1e30):
        with pytest.raises(InputError, match="expected a time in seconds, of 0 or more"):
            log.note(state, wrong)
    log.close()
    log.close()
    with pytest.raises(InputError, match="is closed"):
        log.note(state, 0.0)
    with pytest.raises(InputError, match="is there already"):
        AnswerLog(tmp_path / "a.mcap")
    with pytest.raises(InputError, match="cannot be written: No such file"):
        AnswerLog(tmp_path / "none" / "a.mcap")
    full = Path("/dev/full").open("wb")  # noqa: SIM115
    monkeypatch.setattr(answer_log, "open", lambda *_: full, raising=False)
    with pytest.raises(InputError, match=r"b.mcap cannot be written: No space left"):
        AnswerLog(tmp_path / "b.mcap").note(state, 0.0)


def test_the_command_line_answers_a_bag_beside_itself(tmp_path):
    readings, _ = shift("ab")
    with TactileLearner.open(tmp_path / "memory", sensor=PAD, embedding=SMALL) as made:
        random = np.random.default_rng(1)
        for i in range(18):
            made.observe("abc"[i % 3], slide("abc"[i % 3], 50, random))
    store = bags.typestore(2)
    sent = [(bags.START + i / PAD.rate, bags.array(store, row)) for i, row in enumerate(readings)]
    bag = bags.write(tmp_path / "bag", store, {"/skin": sent}, form="mcap")
    how = ("live", tmp_path / "memory", bag, "--topic", "/skin", "--field", "data", "--mcap", tmp_path / "a.mcap")
    result = run(*how)
    assert result.exit_code == 0, result.output
    assert "touches: 2, " in result.output and f"written: {tmp_path / 'a.mcap'}" in result.output
    found = messages(tmp_path / "a.mcap")
    assert [at for topic, at, _ in found if topic == "/touch/state"] == [round(time * 1e9) for time, _ in sent]
    assert [content["material"] for topic, _, content in found if topic == "/touch/answer" and content["ended"]] == [
        *"ab"
    ]
    assert "is there already: give a new file" in refused(*how)

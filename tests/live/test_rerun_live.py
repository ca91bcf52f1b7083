"""examples/rerun_live.py: a live session written for Rerun, and read again by Rerun's own reader."""

import io
import sys

import numpy as np
import pytest
from live_touches import shift, slide
from rerun.chunk import RrdReader
from touches import PAD, SMALL

from examples.rerun_live import main, probability_of
from scroll_tactile import TactileLearner
from scroll_tactile.signals.image import tactile_image

READINGS, PLACES = shift(["a", "c", "b"])


@pytest.fixture(scope="module")
def memory(tmp_path_factory):
    place, random = tmp_path_factory.mktemp("rerun") / "memory", np.random.default_rng(1)
    with TactileLearner.open(place, sensor=PAD, embedding=SMALL) as learner:
        for _ in range(6):
            for material in "abc":
                learner.observe(material, slide(material, 50, random))
    return place


def logged(path, entity, component):
    """(seconds, value) of what was logged under an entity, in the order of its times."""
    found = []
    for chunk in RrdReader(path).stream():
        if chunk.entity_path == entity:
            rows = chunk.to_record_batch().to_pylist()
            found += [(row["time"].total_seconds(), row[component]) for row in rows if row.get(component) is not None]
    return sorted(found, key=lambda pair: pair[0])


def test_a_session_is_written_as_it_went(memory, tmp_path):
    np.save(tmp_path / "shift.npy", READINGS)
    main(memory, str(tmp_path / "shift.npy"), str(tmp_path / "s.rrd"))
    answers, touches, contacts = [], [], [(0.0, [0.0])]
    with TactileLearner.open(memory, mode="read") as learner, learner.live() as session:
        before = None
        for time, row in zip(np.arange(len(READINGS)) / PAD.rate, READINGS, strict=True):
            now = session.push(row, time)
            touches += now.touches
            if now.contact != bool(contacts[-1][1][0]):
                contacts.append((pytest.approx(time), [float(now.contact)]))
            if now.contact and now.prediction is not None and now.prediction is not before:
                before = now.prediction
                answers.append((pytest.approx(time), now.prediction))
    values = {path: logged(tmp_path / "s.rrd", path, "Scalars:scalars") for path in ("/readings", "/contact")}
    assert np.array_equal([value for _, value in values["/readings"]], READINGS)
    assert values["/contact"] == contacts[1:]
    assert len(touches) == 3 and len(answers) > 3
    for name in "abc":
        shown = logged(tmp_path / "s.rrd", f"/answer/probability/{name}", "Scalars:scalars")
        for at, prediction in answers:
            assert any(at == time and value == [dict(prediction.ranking)[name]] for time, value in shown)
        assert sum(np.isnan(value[0]) for _, value in shown) == 3  # a line ends with its touch
    novelty = logged(tmp_path / "s.rrd", "/answer/novelty", "Scalars:scalars")
    assert {prediction.novelty for _, prediction in answers} <= {value[0] for _, value in novelty}
    images = logged(tmp_path / "s.rrd", "/touch", "Tensor:data")
    assert [time for time, _ in images] == [pytest.approx(touch.at) for touch in touches]
    assert [data[0]["shape"] for _, data in images] == [[*tactile_image(touch.stream).shape] for touch in touches]
    events = [text for _, (text,) in logged(tmp_path / "s.rrd", "/events", "TextLog:text")]
    ended = [text for text in events if text.startswith("touched for")]
    assert [text.split(": ")[1].split(",")[0] for text in ended] == ["a", "c", "b"]
    with pytest.raises(SystemExit, match="is there already"):
        main(memory, str(tmp_path / "shift.npy"), str(tmp_path / "s.rrd"))


def test_lines_on_the_standard_input_are_readings(memory, tmp_path, monkeypatch):
    lines = "".join(",".join(map(str, row)) + "\n" for row in READINGS[:200].tolist())
    monkeypatch.setattr(sys, "stdin", io.StringIO(lines))
    main(memory, "-", str(tmp_path / "s.rrd"))
    written = logged(tmp_path / "s.rrd", "/readings", "Scalars:scalars")
    assert np.array_equal([value for _, value in written], READINGS[:200])


@pytest.mark.parametrize("name", ["a/b", "../c", "né", "x\x1b[2J"])
def test_a_name_cannot_leave_its_place_in_the_tree(name):
    path = probability_of(name)
    assert path.count("/") - path.count("\\/") == 2 and "\x1b" not in path

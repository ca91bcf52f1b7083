"""`scroll-tactile live --rerun`: a file, a viewer that listens, and what cannot be."""

import json
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from commands import refused, run
from live_touches import GEL as SCENE
from live_touches import frames, shift, slide
from rrd import colours, rows, scalars, tensors, texts
from touches import PAD, SMALL

from scroll_tactile import Frames, Quantity, Sensor, TactileLearner
from scroll_tactile.live.answers import LiveState, LiveTouch
from scroll_tactile.recordings import Recording, Report
from scroll_tactile.results import Estimate, Prediction
from scroll_tactile.signals.stream import validate
from scroll_tactile.simulation.gel import SMALL as GEL
from scroll_tactile.viewer import recording_log, streams
from scroll_tactile.viewer.streams import stream_to
from scroll_tactile.viewer.touch_log import TouchLog


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("live")
    random = np.random.default_rng(1)
    with TactileLearner.open(place / "memory", sensor=PAD, embedding=SMALL) as learner:
        learner.declare(Quantity(name="force", unit="N", low=0.0, high=10.0, resolution=0.01))
        for repetition in range(6):
            for material in "abc":
                learner.observe(material, slide(material, 50, random), values={"force": 1.0 + repetition})
    np.save(place / "shift.npy", shift("acb")[0])
    return place


def test_what_is_printed_is_what_is_streamed(folder, tmp_path):
    words = ("live", folder / "memory", folder / "shift.npy", "--json", "--rerun", tmp_path / "out.rrd")
    result = run(*words)
    assert result.exit_code == 0, result.output
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    found = rows(tmp_path / "out.rrd")
    ended = [line for line in lines if line["event"] == "ended"]
    assert len(tensors(found, "/touch")) == len(ended) == 3
    answers = [line for line in lines if line["event"] in ("prediction", "ended")]
    written = {
        name: [value for _, (value,) in scalars(found, f"/answer/probability/{name}", "time") if not np.isnan(value)]
        for name in "abc"
    }
    lines_of = [f"/answer/probability/{name}" for name in "abc" if written[name]]
    assert len(set(colours(found, lines_of))) == len(lines_of) == len(colours(found, lines_of)) > 1
    for line in answers:  # JSON has six digits
        assert line["probability"] in [float(f"{value:.6g}") for value in written[line["material"]]]
    novelty = [value for _, (value,) in scalars(found, "/answer/novelty", "time") if not np.isnan(value)]
    assert novelty == pytest.approx([line["novelty"] for line in answers], rel=1e-5)
    forces = [value for _, value in scalars(found, "/estimate/force", "time")]
    given = [line["estimates"]["force"] for line in answers if line.get("estimates", {}).get("force")]
    shown = [[own["value"], own["low"], own["high"]] for own in given if own["value"] is not None]
    assert np.array(forces) == pytest.approx(np.array(shown), rel=1e-5)
    assert sum(text.startswith("touched") for text in texts(found, "/events")) == 3
    assert "is there already" in refused(*words)


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # of a viewer that is ended while it writes
def test_a_viewer_that_listens_gets_it(folder, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"rerun+http://127.0.0.1:{port}/proxy"
    words = ("live", folder / "memory", folder / "shift.npy", "--rerun", address)
    assert "no viewer answers" in refused(*words)
    viewer = [sys.executable, "-m", "rerun", "--save", tmp_path / "got.rrd", "--port", port, "--bind", "127.0.0.1"]
    with subprocess.Popen([*map(str, viewer)], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL) as process:
        try:
            _wait_for(lambda: _listens(port))
            result = run(*words)
            assert result.exit_code == 0, result.output
            _wait_for(lambda: _touches(tmp_path / "got.rrd") == 3)
            process.send_signal(signal.SIGINT)
            process.wait(60)
        finally:
            process.kill()
    assert len(tensors(rows(tmp_path / "got.rrd"), "/touch")) == 3


@contextmanager
def _listener(said):
    """What accepts connections, says this to each, and closes it if that is not nothing; its port."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        taken = []

        def accept():
            with suppress(OSError):
                while True:
                    taken.append(server.accept()[0])
                    if said is not None:
                        taken[-1].sendall(said)
                        taken[-1].shutdown(socket.SHUT_RDWR)

        threading.Thread(target=accept, daemon=True).start()
        yield server.getsockname()[1]
        for connection in taken:
            connection.close()


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (None, "no viewer answers"),
        (b"SSH-2.0-OpenSSH_9.6\r\n", "no viewer answers"),
        (b"\0\0\0\4\0\0\0\0\0", "the viewer went away"),
    ],
)
def test_a_viewer_that_says_nothing_or_goes_away_is_one_red_line(folder, said, words, monkeypatch):
    monkeypatch.setattr(streams, "ANSWERS_WITHIN", 0.5)
    with _listener(said) as port:
        how = "live", folder / "memory", folder / "shift.npy", "--rerun", f"rerun+http://127.0.0.1:{port}/proxy"
        assert words in refused(*how)


def test_an_address_without_its_end_is_one_red_line(folder):
    with _listener(b"\0\0\0\4\0\0\0\0\0") as port:
        how = "live", folder / "memory", folder / "shift.npy", "--rerun", f"rerun+http://127.0.0.1:{port}"
        assert "/proxy at its end" in refused(*how)


def _listens(port):
    with socket.socket() as tried:
        return tried.connect_ex(("127.0.0.1", port)) == 0


def _touches(path):
    """How many touches a file has that is being written."""
    with warnings.catch_warnings(), suppress(OSError, RuntimeError, ValueError):
        warnings.simplefilter("ignore")  # it has no end yet
        return len(tensors(rows(path), "/touch"))
    return 0


def _wait_for(holds, seconds=60):
    until = time.monotonic() + seconds
    while not holds() and time.monotonic() < until:
        time.sleep(0.2)


@pytest.mark.parametrize("target", ["picture.png", "nowhere/out.rrd", "http://host", "", "rerun+http://host:x/proxy"])
def test_what_can_be_no_target_is_one_red_line(folder, target):
    line = refused("live", folder / "memory", folder / "shift.npy", "--rerun", target)
    assert "rrd" in line


def test_names_cannot_leave_their_place_in_the_tree(tmp_path):
    names = ("a/b", "../c", "né", "x\x1b[2J")
    prediction = Prediction(
        names[0], 0.7, tuple(zip(names, (0.7, 0.2, 0.1, 0.0), strict=True)), novelty=1.0, known=True, seconds=1.0
    )
    sensor = Sensor(name="p", channels=2, rate=50.0, low=0.0, high=1.0, unit="N", duration=1.0)
    with stream_to(str(tmp_path / "n.rrd")) as stream:
        log = TouchLog(stream, sensor, "hand")
        log.show(LiveState(True, 1.0, prediction, True), 1e9)
        log.close()
    found = rows(tmp_path / "n.rrd")
    under = [path for path in found if path.startswith("/hand/answer/probability/")]
    assert len(under) == 4 and all(path.count("/") - path.count("\\/") == 4 for path in under)
    assert not any("\x1b" in path or "\x1b" in text for path in found for text in (path, *texts(found, path)))
    assert scalars(found, "/hand/answer/known", "time") == [(1e9, [1.0])]


def test_lines_end_with_a_touch_and_estimates_without_a_number_are_left_out(tmp_path):
    stream_of = validate(np.full((10, 2), 0.5), PAD)
    prediction = Prediction("a", 0.9, (("a", 0.9), ("b", 0.1)), novelty=float("inf"), known=None, seconds=0.2)
    none = Estimate(None, None, None, "N", 0.1, known=True, missing="too few")
    ended = LiveTouch(stream_of, prediction, False, 3.0, "released", revised=prediction, estimates={"force": none})
    with stream_to(str(tmp_path / "e.rrd")) as stream:
        log = TouchLog(stream, PAD)
        log.show(LiveState(False, 0.2, prediction, False, True, (ended,)), 3.5)
        log.close()
    found = rows(tmp_path / "e.rrd")
    values = scalars(found, "/answer/probability/a", "time")
    assert values[0] == (pytest.approx(3.2), [0.9]) and np.isnan(values[1][1][0])
    assert "/answer/novelty" not in found and "/answer/known" not in found and "/estimate/force" not in found
    assert "revised" in texts(found, "/events")[0]


@pytest.mark.parametrize("seconds", [0.0, 60.0])
def test_a_cameras_frames_are_shown_where_contacts_cannot_be_found(tmp_path, monkeypatch, seconds):
    monkeypatch.setattr(recording_log, "LONGEST", 60.0 - seconds)
    shown = np.asarray(frames(SCENE.materials[1], 7, 12))
    recording = Recording("x", None, "", shown, np.arange(20) / GEL.rate, (), Report(20, None))
    learner = TactileLearner(sensor=GEL, embedding=Frames(rest=None))
    with stream_to(str(tmp_path / "c.rrd")) as stream:
        recording_log.log_recording(stream, recording, learner)
    found = rows(tmp_path / "c.rrd")
    assert sum("Image:buffer" in row.values for row in found["/readings"]) == 20
    assert any("no contact" in text for text in texts(found, "/events")) == (not seconds)


def test_a_cameras_frames_are_pictures(tmp_path):
    with stream_to(str(tmp_path / "c.rrd")) as stream:
        log = TouchLog(stream, GEL)
        log.take(np.full(GEL.shape, 7, np.uint8), 0.0)
        log.close()
    (row,) = [row for row in rows(tmp_path / "c.rrd")["/readings"] if "Image:buffer" in row.values]
    assert set(np.array(row.values["Image:buffer"][0]).tolist()) == {7}


def test_a_touch_that_begins_as_another_ends_is_decided_anew(tmp_path):
    prediction = Prediction("a", 0.9, (("a", 0.9),), 1.0, True, 0.2)
    ended = LiveTouch(validate(np.full((10, 2), 0.5), PAD), prediction, True, 0.0, "gap")
    with stream_to(str(tmp_path / "two.rrd")) as stream:
        log = TouchLog(stream, PAD)
        log.show(LiveState(True, 0.2, prediction, True), 0.2)
        log.show(LiveState(True, 0.2, prediction, True, True, (ended,)), 3.0)
        log.close()
    assert sum(text.startswith("decided") for text in texts(rows(tmp_path / "two.rrd"), "/events")) == 2

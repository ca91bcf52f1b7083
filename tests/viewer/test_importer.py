"""`rerun-importer-scroll-tactile`, as Rerun starts it; what it writes is read again by Rerun's reader."""

import os
import shutil
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import bags
import numpy as np
import pytest
from live_touches import shift, slide
from rrd import colours, rows, scalars, tensors, texts
from touches import PAD, SMALL

from scroll_tactile import TactileLearner
from scroll_tactile.clients.report.facts import MemoryFacts
from scroll_tactile.learner import TactileLearner as Learner
from scroll_tactile.signals.image import tactile_image
from scroll_tactile.viewer import importer

ROOT = Path(__file__).parents[2]
SCRIPT = (
    f"import sys; sys.path[:0] = {[str(ROOT), str(ROOT / 'store')]!r}; "
    "from scroll_tactile.viewer.importer import main; main()"
)
READINGS, PLACES = shift(["a", "c", "b"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("viewer")
    random = np.random.default_rng(1)
    with TactileLearner.open(place / "memory", sensor=PAD, embedding=SMALL) as learner:
        for _ in range(6):
            for material in "abc":
                learner.observe(material, slide(material, 50, random))
        learner.retract(1)
    np.save(place / "shift.npy", READINGS)
    return place


@pytest.fixture
def started(capfdbinary, monkeypatch):
    """Called as the executable is: its exit code, the size of its standard output, and its standard error."""

    def start(*words, out=None, **environment):
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        with pytest.raises(SystemExit) as end:
            importer.main([str(word) for word in words])
        written, error = capfdbinary.readouterr()
        if out is not None:
            out.write_bytes(written)
        return end.value.code, len(written), error.decode()

    return start


def test_the_exit_code_is_the_one_of_the_sdk():
    import rerun

    assert rerun.EXTERNAL_IMPORTER_INCOMPATIBLE_EXIT_CODE == importer.INCOMPATIBLE


def test_a_memory_shows_what_it_keeps_and_says(folder, tmp_path, started):
    from rerun.chunk import RrdReader

    flags = ("--application-id", "app", "--recording-id", "one", "--opened-application-id", "other", "--static")
    code, _, error = started(folder / "memory", *flags, "--entity-path-prefix", "hand", out=tmp_path / "m.rrd")
    assert (code, error) == (0, "")
    (recording,) = RrdReader(tmp_path / "m.rrd").recordings()
    assert (recording.application_id, recording.recording_id) == ("app", "one")
    found = rows(tmp_path / "m.rrd")
    with TactileLearner.open(folder / "memory", mode="read") as learner:
        facts, health, journal = MemoryFacts(learner, 0.05), learner.health(), learner.observations()
        place = {row.key: row.sequence for row in journal if row.state != "retracted"}
        for name in "abc":
            own = [touch for touch in facts.kept if touch.material == name]
            assert [row.times["observation"] for row in found[f"/hand/touches/{name}"]] == [place[t.key] for t in own]
            for shown, touch in zip(tensors(found, f"/hand/touches/{name}"), own, strict=True):
                assert np.array_equal(shown, touch.levels)
            held = {place[t.key]: t for t in facts.held_out if t.material == name}
            answers = scalars(found, f"/hand/held_out/{name}", "observation")
            assert {at: value for at, (value,) in answers} == {
                at: pytest.approx(t.probability[t.names.index(name)]) for at, t in held.items()
            }
            counts = scalars(found, f"/hand/count/{name}", "observation")
            assert [value for _, (value,) in counts] == list(range(1, learner.materials[name] + 1))
        grew = scalars(found, "/hand/health/evidence", "observation")
        assert [(at, value) for at, (value,) in grew] == [(at, pytest.approx(value)) for at, value in health.grew]
        assert {value for _, (value,) in scalars(found, "/hand/health/alarm", "observation")} == {2.0}
        last = max(row.times["observed"] for row in found["/hand/touch"])
        assert datetime.fromtimestamp(last, UTC).year == datetime.now(UTC).year
        unknown = [touch for touch in facts.held_out if touch.answer == touch.material and not touch.known]
        assert sum("called unknown" in text for text in texts(found, "/hand/events")) == len(unknown)
    held, counted = ([f"/hand/{room}/{name}" for name in "abc"] for room in ("held_out", "count"))
    assert colours(found, held) == colours(found, counted) and len(set(colours(found, held))) == 3
    assert "17 touches of 3 materials" in found["/hand/about"][-1].values["TextDocument:text"][0]


def test_names_of_a_memory_are_plain_text_to_the_viewer(tmp_path, started):
    sensor = PAD.model_copy(update={"name": "x ![p](http://127.0.0.1/leak.png)"})
    with TactileLearner.open(tmp_path / "memory", sensor=sensor, embedding=SMALL) as learner:
        learner.observe("a", slide("a", 50, np.random.default_rng(1)))
    assert started(tmp_path / "memory", out=tmp_path / "m.rrd")[0] == 0
    (kind,) = {row.values["TextDocument:media_type"][0] for row in rows(tmp_path / "m.rrd")["/about"]}
    assert kind == "text/plain"


def test_a_touch_that_is_of_two_materials_counts_with_each(tmp_path, started):
    touch = slide("a", 50, np.random.default_rng(1))
    with TactileLearner.open(tmp_path / "memory", sensor=PAD, embedding=SMALL) as learner:
        for name in "ab":
            learner.observe(name, touch)
    assert started(tmp_path / "memory", out=tmp_path / "m.rrd")[0] == 0
    found = rows(tmp_path / "m.rrd")
    assert scalars(found, "/count/a", "observation") == [(1, [1.0])]
    assert scalars(found, "/count/b", "observation") == [(2, [1.0])]


def test_a_recording_shows_the_answers_of_a_live_session(folder, tmp_path, started):
    assert started(folder / "shift.npy", SCROLL_TACTILE_MEMORY=str(folder / "memory"), out=tmp_path / "r.rrd")[0] == 0
    found = rows(tmp_path / "r.rrd")
    answers, touches, contact = [], [], []
    with TactileLearner.open(folder / "memory", mode="read") as learner, learner.live() as session:
        before = None
        for count, row in enumerate(READINGS):
            now = session.push(row)
            touches += now.touches
            if not contact or contact[-1][1] != [float(now.contact)]:
                contact.append((pytest.approx(count / PAD.rate), [float(now.contact)]))
            if now.contact and now.prediction is not None and now.prediction is not before:
                before = now.prediction
                answers.append((pytest.approx(count / PAD.rate), now.prediction))
    assert len(touches) == 3 and len(answers) > 3
    for shown, touch in zip(tensors(found, "/touch"), touches, strict=True):
        np.testing.assert_allclose(shown, tactile_image(touch.stream))
    for name in "abc":
        written = [pair for pair in scalars(found, f"/answer/probability/{name}", "time") if not np.isnan(pair[1][0])]
        for at, prediction in answers:
            assert any(at == time and value == [dict(prediction.ranking)[name]] for time, value in written)
    assert scalars(found, "/contact", "time") == contact
    assert np.array_equal(np.hstack(tensors(found, "/readings")), READINGS.T.astype(np.float32))
    level = scalars(found, "/level", "time")
    np.testing.assert_allclose([value for _, (value,) in level], READINGS.mean(axis=1), rtol=1e-5)
    assert sum(text.startswith("touched for") for text in texts(found, "/events")) == 3


def test_the_folder_of_a_bag_is_read_by_the_memorys_sensor_and_dated(folder, tmp_path, started):
    store = bags.typestore(2)
    messages = {
        "/wide": [(bags.START + i / 50, bags.array(store, np.zeros(5))) for i in range(100)],
        "/skin": [(bags.START + i / 50, bags.array(store, row)) for i, row in enumerate(READINGS)],
    }
    bag = bags.write(tmp_path / "bag", store, messages, form="mcap")
    words = (bag, "--memory", folder / "memory", "--application-id", "bag")
    assert started(*words, out=tmp_path / "b.rrd")[0] == 0
    found = rows(tmp_path / "b.rrd")
    assert len(tensors(found, "/touch")) == 3
    assert scalars(found, "/level", "time")[0][0] == pytest.approx(bags.START, abs=0.1)
    assert started(bag)[0] == importer.INCOMPATIBLE  # numbers of anything, and nobody said whose
    assert started(bag / "metadata.yaml", "--application-id", "bag")[:2] == (0, 0)
    assert started(next(bag.glob("*.mcap")), *words[1:3], "--application-id", "bag_0")[0] == 0


def test_a_known_sensors_bag_shows_contacts_without_a_memory(tmp_path, started):
    store, random = bags.typestore(2), np.random.default_rng(2)
    level = np.where((np.arange(900) > 400) & (np.arange(900) < 700), 900, 300)
    electrodes = (level[:, None] + random.integers(-3, 4, (900, 19))).astype(np.int16)
    messages = [
        (bags.START + i / 100, bags.biotac(store, row, bags.START + i / 100, i)) for i, row in enumerate(electrodes)
    ]
    bag = bags.write(tmp_path / "bag", store, {"/rh/tactile": messages}, form="db3")
    code, _, error = started(bag, out=tmp_path / "b.rrd")
    assert (code, error) == (0, "")
    found = rows(tmp_path / "b.rrd")
    assert [value for _, value in scalars(found, "/contact", "time")] == [[0.0], [1.0], [0.0]]
    assert tensors(found, "/touch")[0].shape[0] == 19
    assert not any("probability" in path for path in found)


def test_one_touch_without_rest_is_taken_whole(folder, tmp_path, started, monkeypatch):
    np.save(tmp_path / "t.npy", slide("a", 50, np.random.default_rng(7)))
    assert started(tmp_path / "t.npy", "--memory", folder / "memory", out=tmp_path / "t.rrd")[0] == 0
    found = rows(tmp_path / "t.rrd")
    assert len(tensors(found, "/touch")) == 1 and "no contact" in texts(found, "/events")[0]
    assert np.hstack(tensors(found, "/readings")).shape == (2, 50)
    monkeypatch.setattr("scroll_tactile.viewer.recording_log.LONGEST", 0.5)  # it takes one second
    assert started(tmp_path / "t.npy", "--memory", folder / "memory", out=tmp_path / "t.rrd")[0] == 0
    assert not tensors(rows(tmp_path / "t.rrd"), "/touch")


def test_missing_values_are_left_out_and_named(folder, tmp_path, started):
    touch = slide("a", 50, np.random.default_rng(7))
    touch[20:23] = np.nan
    np.save(tmp_path / "t.npy", touch)
    assert started(tmp_path / "t.npy", "--memory", folder / "memory", out=tmp_path / "t.rrd")[0] == 0
    assert sum("left out" in text for text in texts(rows(tmp_path / "t.rrd"), "/events")) >= 1


def test_what_is_not_ours_is_left_alone_without_a_word(folder, tmp_path, monkeypatch):
    for name in ("picture.png", "a.npy", "a.csv", "a.txt", "b.h5"):
        (tmp_path / name).write_bytes(b"\x93 anything")
    os.mkfifo(tmp_path / "pipe.npy")
    (tmp_path / "database").mkdir()
    (tmp_path / "database" / "CURRENT").write_text("MANIFEST-000001\n")
    (tmp_path / "empty").mkdir()
    others = [*tmp_path.iterdir(), tmp_path / "database" / "CURRENT", tmp_path / "nothing", Path("/dev/zero")]
    monkeypatch.setitem(sys.modules, "numpy", None)  # nothing that takes time is imported for them
    for path in others:
        with pytest.raises(SystemExit) as end:
            importer.main([str(path)])
        assert end.value.code == importer.INCOMPATIBLE, path


def test_readings_of_another_sensor_are_left_alone_before_they_are_read(folder, tmp_path, monkeypatch, capsys):
    np.save(tmp_path / "wide.npy", np.zeros((9, 7)))
    (tmp_path / "damaged.npy").write_bytes(b"\x93NUMPY\x01\x00")
    monkeypatch.setattr("scroll_tactile.viewer.recording_log.read", lambda *_, **__: pytest.fail("it was read"))
    with pytest.raises(SystemExit) as end:
        importer.main([str(tmp_path / "wide.npy"), "--memory", str(folder / "memory")])
    assert end.value.code == importer.INCOMPATIBLE
    assert "sensor 'pad'" in capsys.readouterr().err
    with pytest.raises(SystemExit) as end:
        importer.main([str(tmp_path / "damaged.npy"), "--memory", str(folder / "memory")])
    assert end.value.code == 1 and "damaged.npy" in capsys.readouterr().err
    (tmp_path / "damaged.bag").write_bytes(b"anything")
    for more, code in (([], importer.INCOMPATIBLE), (["--memory", str(folder / "memory")], 1)):
        with pytest.raises(SystemExit) as end:
            importer.main([str(tmp_path / "damaged.bag"), *more])
        assert end.value.code == code and "damaged.bag" in capsys.readouterr().err


def test_files_of_others_are_left_alone_where_the_environment_names_a_memory(folder, tmp_path, started):
    (tmp_path / "names.csv").write_text("name,age\nbob,3\n")
    (tmp_path / "letter.csv").write_text("dear sir,\nhello you\nx,y,z,w\n")
    np.save(tmp_path / "objects.npy", np.array([{}, 1], object), allow_pickle=True)
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "metadata.yaml").write_text("hello: 1\n")
    memory = str(folder / "memory")
    for name in ("names.csv", "letter.csv", "objects.npy", "site"):
        code, size, _ = started(tmp_path / name, "--application-id", name, SCROLL_TACTILE_MEMORY=memory)
        assert (code, size) == (importer.INCOMPATIBLE, 0), name
    assert started(tmp_path / "letter.csv", "--memory", memory)[0] == 1


def test_an_option_that_there_is_not_is_an_error_by_hand(folder, started):
    code, size, error = started(folder / "shift.npy", "--memroy", folder / "memory")
    assert (code, size) == (2, 0) and "came --memroy" in error


def test_a_recording_that_lies_in_a_memorys_folder_is_shown_by_itself(folder, tmp_path, started):
    shutil.copytree(folder / "memory", tmp_path / "memory")
    np.save(tmp_path / "memory" / "mine.npy", slide("a", 50, np.random.default_rng(7)))
    code, size, error = started(tmp_path / "memory" / "mine.npy", "--memory", folder / "memory")
    assert (code, error) == (0, "") and size > 0


def test_a_damaged_memory_is_an_error_that_says_so(folder, tmp_path, started):
    shutil.copytree(folder / "memory", tmp_path / "memory")
    log = next((tmp_path / "memory").glob("log-*"))
    log.write_bytes(log.read_bytes()[:100])
    shutil.rmtree(tmp_path / "memory" / "checkpoints")
    code, size, error = started(tmp_path / "memory")
    assert (code, size) == (1, 0) and "\nrerun-importer-scroll-tactile: " in "\n" + error
    assert "Traceback" not in error


def test_files_in_a_memory_are_shown_with_it(folder):
    inside = [path for path in (folder / "memory").rglob("*") if path.is_file()]
    assert len(inside) > 10
    for path in inside:
        assert importer._kind(path, "memory", False)[0] == "inside", path
    # Opened by a folder around it, Rerun gives the files alone: then one of them stands for the memory.
    kinds = {path.name: importer._kind(path, "data", False) for path in inside}
    assert kinds.pop("CURRENT") == ("memory", folder / "memory")
    assert {kind for kind, _ in kinds.values()} == {"inside"}


def test_rerun_itself_opens_a_memory(tmp_path):
    """Rerun finds the executable, starts it for the folder and for each file in it, and takes what it writes."""
    learner = Learner.open(tmp_path / "memory", sensor=PAD, embedding=SMALL)
    for material in "ab":
        learner.observe(material, slide(material, 50, np.random.default_rng(3)))
    shutil.copytree(tmp_path / "memory", tmp_path / "copy" / "felt")
    learner.close()
    (tmp_path / "bin").mkdir()
    executable = tmp_path / "bin" / "rerun-importer-scroll-tactile"
    executable.write_text(f'#!/bin/sh\nexec \'{sys.executable}\' -c "{SCRIPT}" "$@"\n')
    executable.chmod(0o755)
    command = [sys.executable, "-m", "rerun", tmp_path / "copy" / "felt", "--save", tmp_path / "out.rrd"]
    options = ["--port", "auto", "--bind", "127.0.0.1"]
    environment = {**os.environ, "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}"}
    done = subprocess.run([*command, *options], env=environment, capture_output=True, timeout=300, check=False)
    output = (done.stdout + done.stderr).decode()
    assert done.returncode == 0, output
    assert "ERROR" not in output
    found = rows(tmp_path / "out.rrd")
    assert len(tensors(found, "/touches/a")) == len(tensors(found, "/touches/b")) == 1

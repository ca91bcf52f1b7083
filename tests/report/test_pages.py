"""Pages in a real browser: nothing is asked for, nothing runs over, and what is odd is escaped or explained."""

import re
import shlex
from html import unescape
from html.parser import HTMLParser

import bags
import numpy as np
import pytest
from browser import Browser
from commands import refused, run
from robot_sets import robot_set

from scroll_tactile import Frames, Kernels, Quantity, Sensor, TactileLearner
from scroll_tactile.clients.report import memory_page, recording_page, save
from scroll_tactile.clients.report.channels import health_cards, health_section
from scroll_tactile.clients.report.page import cards, table
from scroll_tactile.errors import CapacityError, InputError
from scroll_tactile.prediction.predictor import Predictor
from scroll_tactile.recordings import read_intervals
from scroll_tactile.results import Health
from scroll_tactile.simulation.scene import Scene

PAD = Sensor(name="pad", channels=6, rate=50.0, low=0.0, high=255.0, unit="counts", duration=1.0)
SMALL = Kernels(seed=0, dimension=64)
ODD = ["<script>alert(1)</script>", "<img src=x onerror=alert(1)>", "\"'&amp;</svg>", "עור חום", "a" * 200]


@pytest.fixture(scope="module")
def browser():
    opened = Browser()
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def learner(tmp_path_factory):
    """Five materials, twelve touches of each, one of them retracted, in a folder."""
    scene = Scene(sensor=PAD)
    made = TactileLearner.open(tmp_path_factory.mktemp("page") / "memory", sensor=PAD, embedding=SMALL, exemplars=4)
    with made.batch():
        receipts = [made.observe(name, scene.touch(name, i)) for i in range(12) for name in scene.materials[:5]]
    made.retract(receipts[7])
    yield made
    made.close()


@pytest.fixture(scope="module")
def html(learner):
    """The page of that memory."""
    return memory_page(learner)


class Checked(HTMLParser):
    """Every element that opens closes, and none is of a kind that runs or fetches anything."""

    def __init__(self, html):
        super().__init__()
        self.open, self.kinds, self.text = [], set(), []
        self.feed(html)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.kinds.add(tag)
        assert tag not in ("script", "iframe", "object", "embed", "form", "base")
        for name, value in attrs:
            assert not name.startswith("on"), (tag, name)
            assert name != "src" or value.startswith("data:image/png;base64,")
            assert name != "href" or value.startswith(("#", "data:,"))
        if tag not in ("meta", "link", "img"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        assert tag == "path"

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def feel(learner, count, materials):
    """Observe so many touches of each of so many simulated materials."""
    scene = Scene(sensor=PAD)
    for i in range(count):
        for name in scene.materials[:materials]:
            learner.observe(name, scene.touch(name, i))


def words(html):
    """The text of a sound page."""
    return " ".join(Checked(html).text)


@pytest.mark.parametrize(
    ("width", "look"), [(320, "light"), (390, "light"), (390, "dark"), (1280, "light"), (1280, "dark"), (640, "print")]
)
def test_a_page_fits_every_width_and_asks_for_nothing(browser, html, tmp_path, width, look):
    save(html, tmp_path / "page.html")
    browser.show(tmp_path / "page.html", width, dark=look == "dark", media="print" if look == "print" else "screen")
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    assert browser.asked_for == [(tmp_path / "page.html").as_uri()]
    assert browser.said == []
    # No letters of a drawing lie outside it.
    over = """[...document.querySelectorAll('svg text')].filter(text => {
        const own = text.getBoundingClientRect(), all = text.ownerSVGElement.getBoundingClientRect();
        return own.left < all.left - 1 || own.right > all.right + 1 || own.bottom > all.bottom + 1;
    }).map(text => text.textContent)"""
    assert browser.evaluate(over) == []
    paper = browser.evaluate("getComputedStyle(document.body).backgroundColor")
    shade = sum(int(part) for part in re.findall(r"\d+", paper)[:3])
    assert shade < 120 if look == "dark" else shade > 700


def test_a_page_is_read_without_a_script_and_prints(browser, html, tmp_path):
    save(html, tmp_path / "page.html")
    browser.ask("Emulation.setScriptExecutionDisabled", value=True)
    browser.show(tmp_path / "page.html")
    browser.ask("Emulation.setScriptExecutionDisabled", value=False)
    assert browser.printed().startswith(b"%PDF")
    # Printed tables are whole: nothing is left to scroll.
    browser.show(tmp_path / "page.html", media="print")
    hidden = "[...document.querySelectorAll('.table')].filter(box => box.scrollHeight > box.clientHeight + 2).length"
    assert browser.evaluate(hidden) == 0


def test_the_policy_of_a_page_lets_nothing_run(browser, tmp_path):
    html = recording_page(_table(tmp_path)).replace("</main>", "<script>document.title = 'ran'</script></main>")
    save(html, tmp_path / "page.html")
    browser.show(tmp_path / "page.html")
    assert browser.evaluate("document.title") == "touch.csv"
    assert browser.said  # it says that it was refused


def test_odd_names_are_shown_and_not_run(browser, tmp_path):
    learner = TactileLearner(sensor=PAD, embedding=SMALL, exemplars=2)
    for i in range(3):
        for place, name in enumerate(ODD):
            learner.observe(name, Scene(sensor=PAD).touch(Scene(sensor=PAD).materials[place], i))
    html = memory_page(learner, name="\u202egpj.<b>exe\x1b[31m")
    assert "\u202e" not in html
    assert "\x1b" not in html
    text = words(html)
    assert all(name in text for name in ODD)
    assert "\\u202egpj.<b>exe\\x1b[31m" in text
    save(html, tmp_path / "page.html")
    browser.show(tmp_path / "page.html", 390)
    assert browser.evaluate("document.documentElement.scrollWidth") <= 390
    assert browser.said == []


def test_what_a_page_says_of_a_memory(learner, html):
    text = words(html)
    assert "5 materials, 59 touches" in text and "1 of them were retracted" in text
    assert learner.digest() in text and "all 6 alive" in text
    assert "What is missing" not in text
    assert text.count("A touch of ") == 6
    assert "Others of their sittings were learned: tomorrow's touches are harder" in text
    assert "Touches of another day are harder" in text
    assert len(html) < 400_000


def test_an_empty_memory_and_one_material_say_what_is_missing():
    learner = TactileLearner(sensor=PAD, embedding=SMALL)
    text = words(memory_page(learner))
    assert "nothing yet" in text
    assert "no touch was observed yet" in text
    feel(learner, 4, 1)
    text = words(memory_page(learner))
    assert "1 material, 4 touches" in text
    assert "teach a second one" in text
    learner.observe("silk", Scene(sensor=PAD).touch("silk", 0))
    assert "2 materials, 5 touches" in words(memory_page(learner))
    learner = TactileLearner(sensor=PAD, embedding=SMALL)
    feel(learner, 1, 3)
    text = words(memory_page(learner))
    assert "two materials with two touches or more of each" in text and "Nearest pairs" in text


def pasted(html):
    """The commands that a page has to be copied."""
    (found,) = re.findall("<pre[^>]*><code>(.*?)</code></pre>", html, re.S)
    return [shlex.split(line) for line in unescape(found).splitlines()]


def test_the_surest_of_the_wrong_touches_can_be_named_anew_by_a_line_to_paste(tmp_path):
    scene, path = Scene(sensor=PAD), tmp_path / "my memory"
    own, other = scene.materials[:2]
    with TactileLearner.open(path, sensor=PAD, embedding=SMALL, exemplars=0) as learner:
        feel(learner, 8, 3)
        mislabelled = learner.observe(own, scene.touch(other, 20), source="<b>.csv")
        html = memory_page(learner)
    assert "Touches it got wrong" in words(html) and "<b>.csv" in words(html)
    commands = pasted(html)
    ours = [line for line in commands if line[4] == str(mislabelled.sequence)]
    assert ours == [["scroll-tactile", "memory", "relabel", str(path), str(mislabelled.sequence), other]]
    assert run(*ours[0][1:]).exit_code == 0
    with TactileLearner.open(path, mode="read") as learner:
        assert learner.materials == {name: 8 + (name == other) for name in scene.materials[:3]}


def test_a_long_table_says_how_long_it_is():
    short, long = (table(["name", "number"], [["a", i] for i in range(count)], "it") for count in (40, 41))
    assert "long" not in short and "rows" not in short
    assert 'class="table long"' in long and "41 rows: the table scrolls." in long


def test_a_compacted_memory_and_one_that_keeps_no_readings(tmp_path):
    with TactileLearner.open(tmp_path / "m", sensor=PAD, embedding=SMALL, kept_touches=0, exemplars=0) as learner:
        feel(learner, 4, 3)
        learner.compact()
    with TactileLearner.open(tmp_path / "m", mode="read") as learner:
        text = words(memory_page(learner))
    assert "3 materials, 12 touches" in text
    assert "of no touch that could be left out the readings are kept" in text
    assert "no readings of touches are kept" in text
    assert "touches left out" in text


class Own(Kernels):
    """A user's embedding, that nobody but the user can make."""

    name = "own"

    @property
    def fingerprint(self):
        return "0f" * 32


def test_a_memory_of_an_own_embedding_is_shown_as_far_as_it_goes(tmp_path):
    with TactileLearner.open(tmp_path / "m", sensor=PAD, embedding=Own(dimension=64)) as learner:
        feel(learner, 4, 3)
    result = run("report", tmp_path / "m", tmp_path / "page.html")
    assert result.exit_code == 0, result.output
    text = words((tmp_path / "page.html").read_text())
    assert "3 materials, 12 touches" in text
    assert "12 touches of 3 materials were left out" in text
    assert "does not ship with scroll-tactile" in text


def test_a_camera_memory_shows_frames(browser, tmp_path):
    camera = Sensor(
        name="cam", channels=48 * 64 * 3, rate=25.0, low=0.0, high=255.0, unit="counts", duration=0.4,
        layout=(48, 64, 3), camera=True,
    )  # fmt: skip
    learner = TactileLearner(sensor=camera, embedding=Frames(), exemplars=6)
    random = np.random.default_rng(0)
    for i in range(3):
        for shift, name in enumerate(("knit", "weave")):
            frames = np.full((6, 48, 64, 3), 100.0) + random.normal(0, 1, (6, 48, 64, 3))
            frames[2:, 10 + i : 30, 10 + 8 * shift : 40] += 60
            learner.observe(name, frames.clip(0, 255))
    html = memory_page(learner)
    assert "a camera has no channels" in words(html)
    assert html.count('alt="a touch of') == 2
    save(html, tmp_path / "page.html")
    browser.show(tmp_path / "page.html", 390)
    assert browser.evaluate("[...document.images].every(image => image.naturalWidth > 0)") is True
    assert browser.evaluate("document.documentElement.scrollWidth") <= 390


def test_three_hundred_materials_make_a_small_page(browser, tmp_path):
    learner = TactileLearner(sensor=PAD, embedding=SMALL, exemplars=4)
    random = np.random.default_rng(0)
    own = random.uniform(20, 230, (300, 6))
    for _ in range(2):
        for number in range(300):
            waves = 20 * np.sin(np.arange(50)[:, None] * (1 + number % 7) / 5)
            learner.observe(f"material {number}", own[number] + waves + random.normal(0, 4, (50, 6)))
    html = memory_page(learner)
    assert len(html.encode()) < 3_000_000
    text = words(html)
    assert "300 materials, 600 touches" in text
    assert "Measured among 256 of 300 materials" in text
    assert "material 299" in text
    save(html, tmp_path / "page.html")
    browser.show(tmp_path / "page.html", 390)
    assert browser.evaluate("document.documentElement.scrollWidth") <= 390
    assert browser.evaluate("window.find('material 237')") is True


def test_more_materials_than_the_ridge_weighs_leave_a_page(learner, monkeypatch):
    def refuse(_):
        raise InputError("the readout weighs 1024 materials at most")

    monkeypatch.setattr(Predictor, "fitted", refuse)
    assert "Nothing could be fitted: the readout weighs 1024 materials at most" in words(memory_page(learner))

    def lack(_):
        raise CapacityError("no memory is left")

    monkeypatch.setattr(Predictor, "fitted", lack)
    with pytest.raises(CapacityError):
        memory_page(learner)


def _table(folder):
    """A recording of 300 readings of three channels at 100 Hz, the second dead, with a gap of half a second."""
    times = np.arange(300) / 100 + np.where(np.arange(300) >= 200, 0.5, 0.0)
    values = np.random.default_rng(0).normal(100, 10, (300, 3))
    values[:, 1] = 7.0
    rows = [f"{time:.3f},{a:.6g},{b:.6g},{c:.6g}" for time, (a, b, c) in zip(times, values, strict=True)]
    path = folder / "touch.csv"
    path.write_text("\n".join(["time,e1,e2,e3", *rows]) + "\n")
    return path


def _session(folder):
    """Three touches with rests between them, of which half a second is lost in the second."""
    random, scene = np.random.default_rng(0), Scene(sensor=PAD)
    parts = [20 + random.normal(0, 0.5, (150, 6))]
    for i in range(3):
        parts += [60 + scene.touch("silk", i).readings / 2, 20 + random.normal(0, 0.5, (100, 6))]
    readings = np.concatenate(parts)
    times, there = np.arange(len(readings)) / 50, np.ones(len(readings), bool)
    there[310:335] = False
    table = zip(times[there], readings[there], strict=True)
    rows = [",".join(f"{cell:.4f}" for cell in (at, *row)) for at, row in table]
    path = folder / "my session.csv"
    path.write_text("\n".join(["time,e1,e2,e3,e4,e5,e6", *rows]) + "\n")
    return path


def test_a_recording_shows_its_signal_and_gaps_and_proposes_touches(browser, tmp_path):
    html = recording_page(_session(tmp_path), field="e*", clock="time")
    text = words(html)
    assert "4 touches, proposed by contact" in text and "All channels, each from its least" in text
    assert "1 gap, the longest 0.52 s" in text and "50 Hz" in text
    assert html.count('class="own thin"') == 6 * 2  # each is broken where time was lost
    assert html.count("<title>a gap of 0.52 s before reading 310</title>") == 1
    assert html.count("<title>touch, readings") == 4
    (command,) = pasted(html)
    (tmp_path / "sensor.json").write_text(PAD.model_dump_json())
    given = {"memory": tmp_path / "m", "sensor.json": tmp_path / "sensor.json", "MATERIAL": "silk"}
    made = run(*[given.get(word, word) for word in command[1:]])
    assert made.exit_code == 0, made.output
    assert "4 touches of 1 material from" in made.output
    save(html, tmp_path / "page.html")
    browser.show(tmp_path / "page.html", 390)
    assert browser.evaluate("document.documentElement.scrollWidth") <= 390


def test_a_recording_says_what_learning_would_say_of_it_and_how_to_guess_its_sensor(tmp_path):
    readings = np.random.default_rng(0).uniform(0, 200, (200, 6))
    readings[:, 2] = 7
    times = np.arange(200) / 50 + 60.0 * (np.arange(200) >= 80)
    table = np.column_stack([times, readings])
    np.savetxt(tmp_path / "t.csv", table, delimiter=",", header="t,a,b,c,d,e,f", comments="")
    text = words(recording_page(tmp_path / "t.csv"))
    assert "1 gap in its times, the longest 60.02 s before reading 80" in text and "--rate keep takes it in one" in text
    assert "channel 2 (c) never moves while all others do" in text
    assert f"scroll-tactile sensor {tmp_path / 't.csv'} > sensor.json guesses" in text
    assert "by its times it has 50 readings a second" in words(
        recording_page(tmp_path / "t.csv", sensor=PAD.model_copy(update={"rate": 80.0}))
    )
    np.save(tmp_path / "touch.npy", readings[:, [0, 1, 3, 4, 5]])
    assert "Nothing that learning would speak of." in words(recording_page(tmp_path / "touch.npy", rate=50.0))


def test_channels_are_called_saturated_only_where_their_range_is_known(tmp_path):
    readings = np.clip(np.random.default_rng(0).normal(200, 80, (400, 6)), 0, 255)
    np.save(tmp_path / "touch.npy", readings)
    text = words(recording_page(tmp_path / "touch.npy", rate=50.0))
    assert "all 6 alive" in text and "whether one is saturated is not told" in text
    (tmp_path / "pad.json").write_text(PAD.model_dump_json())
    page, how = tmp_path / "page.html", ("report", tmp_path / "touch.npy")
    made = run(*how, page, "--rate", "50", "--sensor", tmp_path / "pad.json")
    assert made.exit_code == 0, made.output
    text = words(page.read_text())
    assert "6 saturated" in text and "that of sensor pad" in text
    assert "19 channels" in refused(*how, page, "--rate", "50", "--sensor", "biotac")
    with pytest.raises(InputError, match="both say whose"):
        recording_page(tmp_path / "touch.npy", rate=50.0, sensor=PAD, preset="biotac")


def test_a_known_message_type_gives_the_range_and_the_line_to_learn_it(tmp_path):
    store, values = bags.typestore(2), np.random.default_rng(0).integers(0, 4096, (60, 19)).astype(np.int16)
    stamps = [bags.START + i / 100 for i in range(60)]
    messages = [(at, bags.biotac(store, row, at)) for at, row in zip(stamps, values, strict=True)]
    path = bags.write(tmp_path / "hand", store, {"/left/tactile": messages}, form="mcap")
    html = recording_page(path)
    assert "that of preset biotac, of messages sr_robot_msgs/msg/BiotacAll" in words(html)
    expected = ["learn", "memory", str(path), "--preset", "biotac", "--topic", "/left/tactile", "--label", "MATERIAL"]
    assert pasted(html) == [["scroll-tactile", *expected]]


def test_the_command_tells_memories_from_recordings(learner, tmp_path):
    path = _table(tmp_path)
    made = run("report", path, tmp_path / "page.html", "--field", "e*", "--clock", "time")
    assert made.exit_code == 0, made.output
    assert "touch.csv" in (tmp_path / "page.html").read_text()
    assert "only of a recording" in refused("report", learner.path, tmp_path / "page.html", "--topic", "/x")
    assert "ends in .html" in refused("report", path, tmp_path / "touch.csv")
    assert "not there" in refused("report", tmp_path / "gone.mcap", tmp_path / "page.html")
    assert "cannot be written" in refused("report", path, tmp_path / "no" / "page.html")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["page.html", "touch.csv"]


def _learned_by_its_line(folder, source, *options):
    """Makes the page by the command, and pastes its line: the words of that, and what the memory then holds."""
    made = run("report", source, folder / "page.html", *options)
    assert made.exit_code == 0, made.output
    (command,) = pasted((folder / "page.html").read_text())
    (folder / "sensor.json").write_text(PAD.model_dump_json())
    given = {"memory": folder / "memory", "sensor.json": folder / "sensor.json", "MATERIAL": "silk"}
    done = run(*[given.get(word, word) for word in command[1:]])
    assert done.exit_code == 0, done.output
    with TactileLearner.open(folder / "memory", mode="read") as learner:
        return command, learner.materials


def test_the_line_has_the_table_and_the_sensor_that_the_page_was_given(tmp_path):
    np.save(tmp_path / "touch.npy", Scene(sensor=PAD).touch("silk", 0).readings)
    (tmp_path / "pad.json").write_text(PAD.model_dump_json())
    cut = tmp_path / "cut.csv"
    cut.write_text("file,begin,end,material\ntouch.npy,0,0.5,oak\ntouch.npy,0.5,0.9,silk\n")
    options = "--rate", "50", "--sensor", tmp_path / "pad.json", "--labels", cut
    command, materials = _learned_by_its_line(tmp_path, tmp_path / "touch.npy", *options)
    assert command[4:] == ["--sensor", str(tmp_path / "pad.json"), "--labels", str(cut)]
    assert materials == {"oak": 1, "silk": 1}
    intervals = read_intervals(cut)
    html = recording_page(tmp_path / "touch.npy", rate=50.0, sensor=PAD, intervals=intervals)
    assert pasted(html)[0][4:] == ["--sensor", "sensor.json", "--labels", "labels.csv"]
    assert "labels.csv, the table of its touches" in words(html)


def test_the_line_has_the_field_that_the_page_chose(tmp_path):
    import h5py

    scene = Scene(sensor=PAD)
    with h5py.File(tmp_path / "two.h5", "w") as file:
        file["left"], file["right"] = scene.touch("silk", 0).readings, scene.touch("silk", 1).readings
    command, materials = _learned_by_its_line(tmp_path, tmp_path / "two.h5")
    assert command[4:] == ["--sensor", "sensor.json", "--field", "left", "--label", "MATERIAL"]
    assert materials == {"silk": 1}


@pytest.mark.parametrize("named", [True, False])
def test_episodes_without_names_are_given_one_in_the_line(tmp_path, named):
    scene = Scene(sensor=PAD)
    folder = robot_set(tmp_path / "set", [(name, scene.touch(name, 0).readings) for name in scene.materials[:2]])
    if not named:
        (folder / "meta/tasks.parquet").unlink()
    command, materials = _learned_by_its_line(tmp_path, folder)
    assert command[4:] == ["--sensor", "sensor.json", *([] if named else ["--label", "MATERIAL"])]
    assert materials == (dict.fromkeys(scene.materials[:2], 1) if named else {"silk": 2})
    text = words((tmp_path / "page.html").read_text())
    assert ("2 touches of 2 names" if named else "2 touches, its episodes, of which some have no name") in text


@pytest.mark.parametrize(
    "readings",
    [
        np.ones((1, 3)),
        np.full((50, 3), np.nan),
        np.full((50, 3), np.inf),
        np.random.default_rng(0).normal(size=(50, 3)) * 1e300,
        np.full((50, 2), 1e-310),
        np.arange(600).reshape(-1, 3),
        np.random.default_rng(0).normal(size=(20, 3000)),
        np.zeros((5, 30, 40, 3), np.uint8),
        np.zeros(100),
    ],
)
@pytest.mark.parametrize("rate", [None, 100.0])
def test_odd_readings_leave_a_page(tmp_path, readings, rate):
    np.save(tmp_path / "odd.npy", readings)
    text = words(recording_page(tmp_path / "odd.npy", rate=rate))
    assert f"{len(readings)} readings" in text
    assert "nan" not in text.split()


def test_what_it_measures_is_shown_held_out():
    scene, learner = Scene(sensor=PAD), TactileLearner(sensor=PAD, embedding=SMALL, exemplars=0)
    learner.declare(Quantity(name="force <b>", unit="N", low=0.0, high=4.0, resolution=0.01))
    learner.declare(Quantity(name="heat", unit="K", low=0.0, high=400.0, resolution=1.0))
    for i in range(10):
        for name in scene.materials[:3]:
            learner.observe(name, scene.touch(name, i, force=0.5 + 0.1 * i), values={"force <b>": 0.5 + 0.1 * i})
    html = memory_page(learner, risk=0.2)
    Checked(html)
    text = words(html)
    assert "What it measures" in text and "each material held out, as if it were new" in text
    assert "0.5 true" in html and "How heat is estimated: 0 sampled touches" in text
    learner = TactileLearner(sensor=PAD, embedding=SMALL, exemplars=0)
    learner.observe("felt", scene.touch("felt", 0))
    assert "What it measures" not in words(memory_page(learner))


def test_a_name_is_escaped_once_on_a_page():
    changed = Health(3, None, (), "material", 100.0, 0.01, 10, 9, ("A&B 'x'",), ((1, 0.1), (3, 2.1)))
    for html in (cards(health_cards(changed)), health_section(changed)):
        assert "A&B 'x' feels otherwise" in words(html)
    assert "the one that learned: a material changed" in words(cards(health_cards(changed)))
    scene, learner = Scene(sensor=PAD), TactileLearner(sensor=PAD, embedding=SMALL, exemplars=0)
    learner.declare(Quantity(name="size", unit="'&", low=0.0, high=4.0, resolution=0.01))
    for i in range(10):
        for name in scene.materials[:3]:
            learner.observe(name, scene.touch(name, i, force=0.5 + 0.1 * i), values={"size": 0.5 + 0.1 * i})
    text = words(memory_page(learner, risk=0.2))
    assert "'& on average" in text and "'& wide" in text and "&#x27;" not in text


def test_each_axis_of_labels_has_a_section():
    scene, learner = Scene(sensor=PAD), TactileLearner(sensor=PAD, embedding=SMALL, exemplars=0)
    for i in range(10):
        for name in scene.materials[:3]:
            touch = scene.touch(name, i)
            ways = {"way <b>": ["back", "forth"][i % 2], "once": "said"} if i else None
            learner.observe(name, touch.readings[::-1] if i % 2 else touch, labels=ways)
    html = memory_page(learner)
    Checked(html)
    text = words(html)
    assert "27 touches of 2 labels on way <b> were left out one by one: 100.0% right" in text
    assert "By once" in text and "there is one of the labels on once, with nothing to be mixed up with" in text
    assert "30 touches of 3 materials were left out" in text
    assert html.count('id="axis-') == 2

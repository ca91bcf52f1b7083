"""Many files are learned, gone on with and evaluated; what is wrong in one file costs no other."""

import re
import shutil
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
from bags import START, biotac, typestore, write
from live_touches import GEL, frames, gel_learner, shift
from live_touches import learner as live_learner
from touches import PAD, SETTINGS, require_same, stream

from examples.paper.readers import biotac_slide
from scroll_tactile import Kernels, TactileLearner, sensors
from scroll_tactile.clients.learning import learning
from scroll_tactile.clients.learning.fleet import learn
from scroll_tactile.clients.learning.learning import evaluate_sources, learn_sources
from scroll_tactile.clients.learning.sources import Refused, SourceOptions, find_sources, source_touches
from scroll_tactile.errors import FieldError, InputError, MaterialError
from scroll_tactile.recordings import Interval
from scroll_tactile.results import Prediction

FOLDERS = SourceOptions(by="folder")


def put(path, touch):
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, stream(touch))
    return path


@pytest.fixture
def data(tmp_path):
    """Folders of two materials, three touches each."""
    for i in range(6):
        put(tmp_path / "data" / "ab"[i % 2] / f"{i}.npy", (i, 60))
    return tmp_path / "data"


EXPECTED = [("ab"[i % 2], (i, 60)) for i in range(6)]


@pytest.fixture
def learner(tmp_path):
    with TactileLearner.open(tmp_path / "m", **SETTINGS) as opened:
        yield opened


def sources_of(*paths):
    found, refused = find_sources([str(path) for path in paths])
    assert not refused
    return found


def test_progress_goes_touch_by_touch_though_a_batch_becomes_durable_together(data, learner):
    told, sources = [], sources_of(data)
    learn_sources(learner, sources, FOLDERS, lambda what, done, of: told.append((what.split(";")[0], done, of)))
    assert {of for *_, of in told} == {6}
    done = [at for _, at, _ in told]
    assert done == sorted(done) and done[-1] == 6
    assert list(dict.fromkeys(what for what, *_ in told)) == [f"{i} touches" for i in range(7)]


class TestSources:
    def test_folders_are_looked_through_and_each_file_comes_once(self, data, monkeypatch):
        again = [data / "b" / "1.npy", data, data / ".." / "data" / "a"]
        found = sources_of(*again)
        assert [Path(path).name for path in found] == ["1.npy", "0.npy", "2.npy", "4.npy", "3.npy", "5.npy"]
        assert found[0] == str(again[0])
        monkeypatch.chdir(data)
        assert find_sources(["b", "s3://bucket/x.npy"])[0] == ["b/1.npy", "b/3.npy", "b/5.npy", "s3://bucket/x.npy"]

    def test_what_holds_nothing_is_refused_and_the_rest_is_found(self, data, tmp_path):
        (tmp_path / "empty" / "deep").mkdir(parents=True)
        (tmp_path / "notes.md").write_text("1,2\n")
        paths = [tmp_path / "none", tmp_path / "empty", tmp_path / "notes.md", data / "a"]
        found, refused = find_sources(list(map(str, paths)))
        assert len(found) == 3
        assert [(each.source, each.why.split("; ")[-1].split(": ")[-1]) for each in refused] == [
            (str(paths[0]), "it is not there"),
            (str(paths[1]), "there is none in this folder"),
            (str(paths[2]), "a file of this kind is none"),
        ]

    @pytest.mark.parametrize(
        ("options", "error", "match"),
        [
            ({"material": "a", "by": "file"}, InputError, "in one way"),
            ({"material": ""}, MaterialError, "1 to 200"),
            ({"by": "folder:x"}, InputError, "'folder:2' or 'group:2'; came 'folder:x'"),
            ({"preset": "biotacc"}, InputError, "expected a preset"),
            ({"columns": "25-44"}, FieldError, "such as 25:44 or 0,3,5:9, counted from 0; came '25-44'"),
            ({"cut": "intervals"}, InputError, "takes intervals=, a table"),
            ({"cut": "none", "intervals": (Interval("a", 0, 1, "x"),)}, InputError, "came cut='none'"),
        ],
    )
    def test_options_that_do_not_fit_together_are_refused(self, options, error, match):
        with pytest.raises(error, match=match):
            SourceOptions(**options)

    def test_contacts_are_where_a_live_session_finds_them(self, tmp_path):
        rows, places = shift("abc")
        np.save(tmp_path / "t.npy", rows)
        made = live_learner()
        found = list(source_touches(made, str(tmp_path / "t.npy"), SourceOptions(cut="contact", material="a")))
        with made.live() as session:
            ended = session.push(rows).touches
        assert [touch.stream for touch in found] == [touch.stream for touch in ended]
        spans = [each.source.rpartition("npy")[2].strip("[]").split(":") for each in found]
        assert np.abs(np.array(spans, int) - places).max() <= 3

    def test_a_gap_in_time_ends_a_contact(self, tmp_path):
        rows, places = shift("ab")
        middle = sum(places[0]) // 2
        times = np.arange(len(rows)) / PAD.rate + 10.0 * (np.arange(len(rows)) >= middle)
        table = np.column_stack([times, rows])
        np.savetxt(tmp_path / "t.csv", table, delimiter=",", header="time,x,y", comments="", fmt="%.17g")
        made = live_learner()
        options = SourceOptions(cut="contact", material="a")
        first, *others = source_touches(made, str(tmp_path / "t.csv"), options)
        assert first.source.endswith(f":{middle}]") and len(others) == 2

    def test_no_contact_and_another_sensor_are_refused(self, tmp_path):
        np.save(tmp_path / "rest.npy", shift("a")[0][:110])
        np.save(tmp_path / "other.npy", np.zeros((200, 5)))
        for name, why in (("rest", "no contact was found"), ("other", "another sensor's recording")):
            (refused,) = source_touches(live_learner(), str(tmp_path / f"{name}.npy"), SourceOptions(cut="contact"))
            assert isinstance(refused, Refused) and why in refused.why

    def test_contacts_of_a_camera_begin_with_the_frame_at_rest_and_share_none(self, tmp_path):
        pictures = np.concatenate([frames(GEL.materials[0], number, 5) for number in range(3)])
        np.save(tmp_path / "gel.npy", pictures.astype(np.uint8))
        made = gel_learner()
        found = list(source_touches(made, str(tmp_path / "gel.npy"), SourceOptions(cut="contact", material="a")))
        with made.live() as session:
            first = session.push(np.load(tmp_path / "gel.npy")).touches[0]
        np.testing.assert_array_equal(found[0].stream.readings, first.stream.readings)
        spans = [list(map(int, each.source.rpartition("npy")[2].strip("[]").split(":"))) for each in found]
        assert len(spans) == 3 and (np.diff(np.concatenate(spans)) >= 0).all()

    def test_names_with_anything_in_them_are_kept_printable_and_bounded(self, tmp_path, learner):
        odd = put(tmp_path / ("fé[b]\x1b\n" + "x" * 200) / "=1+1 .npy", (0, 60))
        done = learn_sources(learner, [str(odd)], SourceOptions(material="[red]a"))
        assert done.learned == {"[red]a": 1} and not done.refused
        (row,) = learner.observations()
        assert row.source.isprintable() and r"fé[b]\x1b\n" in row.source and row.source.endswith("=1+1 .npy")
        deep = tmp_path.joinpath(*["d" * 200] * 6)
        (touch,) = source_touches(learner, str(put(deep / "t.npy", (1, 60))), SourceOptions(material="a"))
        assert len(touch.source) == 1000 and touch.source[0] == "…" and touch.source.endswith("/t.npy")


class TestLearn:
    def test_folders_are_learned_as_the_same_touches_observed(self, data, learner):
        done = learn_sources(learner, sources_of(data), FOLDERS)
        assert (done.files, done.learned, done.skipped, done.refused) == (6, {"a": 3, "b": 3}, 0, [])
        require_same(learner, EXPECTED)
        assert {row.source: row.material for row in learner.observations()} == {
            str(data / name / f"{touch[0]}.npy"): name for name, touch in EXPECTED
        }

    def test_a_touch_counts_once_by_its_content(self, data, learner, tmp_path):
        learner.observe("a", stream((0, 60)))
        put(tmp_path / "other" / "a" / "copy.npy", (4, 60))
        done = learn_sources(learner, sources_of(data, tmp_path / "other"), FOLDERS)
        assert (done.learned, done.skipped) == ({"a": 2, "b": 3}, 2)
        again = learn_sources(learner, sources_of(data), FOLDERS)
        assert (again.learned.total(), again.skipped) == (0, 6)
        require_same(learner, EXPECTED)

    def test_a_touch_under_two_names_is_refused(self, data, learner):
        learn_sources(learner, sources_of(data), FOLDERS)
        (row,) = (row for row in learner.observations() if row.source.endswith("/0.npy"))
        learner.relabel(row.sequence, "silk")
        done = learn_sources(learner, sources_of(data), FOLDERS)
        assert done.skipped == 5
        assert [each.source for each in done.refused] == [str(data / "a" / "0.npy")]
        assert "has this touch already, as 'silk' and not as 'a'" in done.refused[0].why
        learner.retract(learner.observations()[-1].sequence)
        assert learn_sources(learner, sources_of(data), FOLDERS).learned == {"a": 1}
        require_same(learner, EXPECTED)

    def test_what_is_wrong_in_one_file_costs_no_other(self, data, learner):
        (data / "a" / "bad.npy").write_bytes(b"\x93NUMPY broken")
        (data / "a" / "bad.csv").write_text("1,2\n1,two\n")
        np.save(data / "b" / "other.npy", np.zeros((60, 3)))
        np.save(data / "b" / "short.npy", np.zeros((1, 2)))
        np.save(data / "b" / "nan.npy", np.full((60, 2), np.nan))
        done = learn_sources(learner, sources_of(data), FOLDERS)
        require_same(learner, EXPECTED)
        why = {Path(each.source).name: each.why for each in done.refused}
        assert done.files == 11 and set(why) == {"bad.npy", "bad.csv", "other.npy", "short.npy", "nan.npy"}
        assert "may be damaged" in why["bad.npy"] and "row 2, column 2" in why["bad.csv"]
        assert "another sensor's recording" in why["other.npy"] and "at least 2 readings" in why["short.npy"]
        assert "reading 0, channel 0 is nan" in why["nan.npy"]

    def test_what_nothing_names_is_refused(self, data, learner):
        done = learn_sources(learner, sources_of(data), SourceOptions())
        assert len(done.refused) == 6 and "nothing names it" in done.refused[0].why
        assert learner.observations() == []

    @pytest.mark.parametrize("after", [1, 2, 3, 5])
    def test_an_interruption_loses_little_and_the_same_call_goes_on(self, data, tmp_path, monkeypatch, after):
        monkeypatch.setattr(learning, "BATCH_TOUCHES", 2)

        def interrupt(what, done, of):
            if done == after:
                raise KeyboardInterrupt

        with TactileLearner.open(tmp_path / "m", **SETTINGS) as learner:
            with pytest.raises(KeyboardInterrupt):
                learn_sources(learner, sources_of(data), FOLDERS, interrupt)
            assert after - 2 < len(learner.observations()) <= after
        with TactileLearner.open(tmp_path / "m") as learner:
            done = learn_sources(learner, sources_of(data), FOLDERS)
            assert done.learned.total() + done.skipped == 6
            require_same(learner, EXPECTED)

    def test_long_files_become_durable_piece_by_piece(self, tmp_path, learner, monkeypatch):
        monkeypatch.setattr(learning, "BATCH_BYTES", 1000)
        with h5py.File(tmp_path / "d.h5", "w") as file:
            for i in range(5):
                file[f"data/demo_{i}/obs/touch"] = stream((i, 60))
        sizes = []
        batch = TactileLearner.batch
        monkeypatch.setattr(TactileLearner, "batch", lambda self: sizes.append(1) or batch(self))
        done = learn_sources(learner, [str(tmp_path / "d.h5")], SourceOptions(material="a"))
        assert done.learned == {"a": 5} and len(sizes) == 2  # of three touches, and two
        assert [row.source for row in learner.observations()][:2] == [
            f"{tmp_path}/d.h5[0:60]",
            f"{tmp_path}/d.h5[60:120]",
        ]
        require_same(learner, [("a", (i, 60)) for i in range(5)])

    def test_intervals_name_and_cut(self, tmp_path, learner):
        whole = np.concatenate([stream((0, 60)), stream((1, 60)), stream((2, 60))[:1]])
        times = np.arange(121)[:, None] / 50
        header = "time,x,y"
        np.savetxt(
            tmp_path / "t.csv", np.hstack([times, whole]), delimiter=",", header=header, comments="", fmt="%.17g"
        )
        intervals = (
            Interval("t.csv", -0.01, 1.19, "a"),
            Interval("t.csv", 1.19, 2.39, "b"),
            Interval("t.csv", 2.39, 2.5, "c"),
        )
        done = learn_sources(learner, [str(tmp_path / "t.csv")], SourceOptions(intervals=intervals))
        assert done.learned == {"a": 1, "b": 1}
        assert [each.source for each in done.refused] == [f"{tmp_path}/t.csv[120:121]"]
        require_same(learner, [("a", (0, 60)), ("b", (1, 60))])

    @pytest.mark.parametrize(
        ("files", "typed", "by", "names"),
        [
            (["felt/1.csv", "oak/1.csv"], ["."], "folder", {"felt": 1, "oak": 1}),
            (["felt/1/t.csv", "oak/1/t.csv"], ["."], "folder:1", {"felt": 1, "oak": 1}),
            (["felt/1/t.csv", "oak/1/t.csv"], ["felt/1/t.csv", "oak/1/t.csv"], "folder:7", {"felt": 1, "oak": 1}),
            (["a/felt/t.csv", "b/felt/u.csv"], ["a", "b"], "folder", {"felt": 2}),
            (["a/felt/t.csv", "b/felt/u.csv"], ["."], "folder:2", {"felt": 2}),
            (["felt/t.csv"], ["felt"], "folder:1", {"felt": 1}),
            (
                ["felt/1/t.csv", "oak/2/t.csv"],
                ["."],
                "folder",
                "'1' is a number.*folder:1' for felt, oak; .*:2' for 1, 2",
            ),
            (["7/t.csv"], ["7"], "folder", "'7' is a number"),
            (["a/felt/t.csv", "b/felt/u.csv"], ["."], "folder", "'felt' lies in several.*folder:2' for felt"),
            (["felt/t.csv"], ["."], "folder:2", "it has no folder 2; expected by='folder:1', felt"),
        ],
    )
    def test_folders_name_materials_where_they_are_names(self, tmp_path, files, typed, by, names):
        for number, name in enumerate(files):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            np.savetxt(tmp_path / name, stream((number, 60)), delimiter=",", fmt="%.17g")
        levels = len(tmp_path.parts) - 1
        by = by.replace("7", str(levels + 1))  # of a file that was typed, its path counts
        learn_them = partial(
            learn, [tmp_path / each for each in typed], tmp_path / "m", SourceOptions(by=by), sensor=PAD
        )
        if isinstance(names, dict):
            assert learn_them(workers=1).learned == names
            return
        try:
            said = learn_them(workers=1).refused[0].why
        except InputError as error:
            said = str(error)
        assert re.search(names, said), said
        assert not (tmp_path / "m").exists()

    def test_a_column_names_what_is_touched_from_then_on(self, tmp_path, learner):
        rows = [*stream((0, 60)).tolist(), *stream((1, 60)).tolist()]
        lines = [f"{x!r},{y!r},{'ab'[i >= 60]}" for i, (x, y) in enumerate(rows)]
        (tmp_path / "t.csv").write_text("\n".join(["0,1,what", *lines]))
        done = learn_sources(learner, [str(tmp_path / "t.csv")], SourceOptions(labels="what"))
        assert done.learned == {"a": 1, "b": 1}
        require_same(learner, [("a", (0, 60)), ("b", (1, 60))])

    def test_bags_are_learned_as_the_arrays_in_them(self, real_data, tmp_path):
        recordings = biotac_slide.load(real_data, "biotac")
        chosen = range(0, len(recordings.streams), len(recordings.streams) // 10)
        settings = {"sensor": sensors.BIOTAC, "embedding": Kernels(seed=0, dimension=64)}
        plain, store = TactileLearner(**settings), typestore(1)
        for i in chosen:
            material, touch = recordings.materials[i], recordings.streams[i]
            plain.observe(material, touch)
            messages = [
                (START + j / 100, biotac(store, row.astype(np.int16), START + j / 100, j))
                for j, row in enumerate(touch.readings)
            ]
            (tmp_path / "bags" / material).mkdir(parents=True, exist_ok=True)
            write(tmp_path / "bags" / material / f"{i}.bag", store, {"/rh/tactile": messages}, form="bag")
        with TactileLearner.open(tmp_path / "m", **settings) as learner:
            done = learn_sources(learner, sources_of(tmp_path / "bags"), SourceOptions(by="folder", preset="biotac"))
            assert done.learned.total() == len(chosen) and not done.refused
            assert learner.digest() == plain.digest()
            source = learner.observations()[0].source
            assert source.endswith(".bag /rh/tactile tactiles[0].electrodes")


class TestEvaluate:
    def test_figures_are_those_of_the_answers(self, data, learner, monkeypatch):
        said = {0: ("a", 0.9, True), 1: ("a", 0.8, True), 2: ("a", 0.7, False), 3: ("b", 1.0, True)}
        learn_sources(learner, sources_of(data), FOLDERS)
        for name in ("4", "5"):
            shutil.move(data / "ab"[name == "5"] / f"{name}.npy", data / f"{name}.npy")
        put(data / "new" / "6.npy", (6, 60))
        put(data / "new" / "7.npy", (7, 60))
        said |= {6: ("a", 0.6, True), 7: ("b", 0.5, False)}
        given = {stream((i, 60)).tobytes(): answer for i, answer in said.items()}
        by_key = {learner.stream(stream((i, 60))).key: answer for i, answer in said.items()}
        assert len(by_key) == len(given) == 6

        def predict(self, touch, of=None, scene=None):
            material, probability, known = by_key[touch.key]
            return Prediction(material, probability, ((material, probability),), 0.0, known, touch.seconds)

        monkeypatch.setattr(TactileLearner, "predict", predict)
        done = evaluate_sources(learner, sources_of(data / "a", data / "b", data / "new"), FOLDERS, with_learned=True)
        assert (len(done.of_learned), len(done.of_others)) == (4, 2)
        assert done.answers.accuracy == 0.75
        assert done.answers.confusions() == [("b", "a", 1)]
        assert done.calibration_error == pytest.approx((0.1 + 0.8 + 0.3 + 0) / 4)
        wrong = [(Path(each.touch.source).name, each.prediction.material) for each in done.wrong]
        assert wrong == [("1.npy", "a"), ("6.npy", "a")]

    def test_a_memory_answers_what_it_learned_and_what_cannot_be_read_is_listed(self, data, learner):
        learn_sources(learner, sources_of(data), FOLDERS)
        before = learner.digest()
        np.save(data / "a" / "other.npy", np.zeros((60, 3)))
        put(data / "b" / "9.npy", (9, 60))
        done = evaluate_sources(learner, sources_of(data), FOLDERS)
        assert (done.seen, len(done.answered)) == (6, 1)
        done = evaluate_sources(learner, sources_of(data), FOLDERS, with_learned=True)
        assert (done.seen, len(done.answered)) == (6, 7)
        assert [Path(each.source).name for each in done.refused] == ["other.npy"]
        for each in done.answered:
            assert each.prediction == learner.predict(each.touch.stream)
        assert learner.digest() == before

    def test_nothing_familiar_has_no_calibration_error(self, data, learner):
        done = evaluate_sources(learner, sources_of(data), FOLDERS)
        assert done.calibration_error is None and not done.of_learned and len(done.of_others) == 6
        assert done.wrong == []

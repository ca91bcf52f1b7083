"""What studies share: folds, cells that are read back, means, and results that say what made them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from paper_touches import recorded, untimed

from examples.paper.readers.labelled import thinned
from examples.paper.runs.cells import Cell, pooled, run_cells, split, time_left
from examples.paper.runs.results import show, write_result
from examples.paper.runs.runfile import RunFile
from examples.paper.studies.table1 import PAPER, Table1, rows
from scroll_tactile.errors import InputError


@pytest.fixture(scope="module")
def recordings():
    return recorded()


class TestSplit:
    def test_every_touch_is_learned_or_held_or_tested(self, recordings):
        parts = split(recordings, 1, seed=0)
        assert (len(parts.streams), len(parts.validation), len(parts.test)) == (21, 3, 12)
        assert {name for name, _ in parts.validation} == set(recordings.materials)
        keys = [item.key for item in parts.streams] + [item.key for _, item in [*parts.validation, *parts.test]]
        assert sorted(keys) == sorted(stream.key for stream in recordings.streams)
        assert len(set(parts.touch)) == 12
        held = [{item.key for _, item in split(recordings, 0, seed).validation} for seed in (0, 0, 1)]
        assert held[0] == held[1] != held[2]
        fewer = split(recordings, 0, seed=0, every=2)
        assert (len(fewer.streams), len(fewer.validation), len(fewer.test)) == (9, 3, 12)

    def test_a_thinned_set_has_a_fifth_of_each_material_in_each_fold(self):
        few = thinned(recorded(each=18, ordered=True), 5)
        assert few.fold[:6].tolist() == [0, 1, 2, 0, 1, 2] and len(set(few.materials[:6])) == 1
        assert few.repetition[:6].tolist() == [0, 1, 2, 15, 16, 17] and len(few) == 18
        frames = recorded(materials=2, each=12)
        video = np.tile(np.repeat(np.arange(6), 2), 2)
        few = thinned(replace(frames, repetition=video, fold=video % 2), 5)
        assert few.repetition[:4].tolist() == [0, 0, 1, 1]

    def test_frames_of_a_video_are_not_parted(self, recordings):
        # Four frames to a recording, three recordings of each material, each its own fold.
        video = np.tile(np.repeat(np.arange(3), 4), 3)
        parts = split(replace(recordings, repetition=video, fold=video), 2, seed=0)
        assert len(parts.test) == 12 and len(set(parts.touch)) == 3
        assert len(parts.validation) == 0  # two recordings are too few to hold one out
        more = np.tile(np.repeat(np.arange(6), 2), 3)
        parts = split(replace(recordings, repetition=more, fold=more // 2), 2, seed=0)
        held = {item.key for _, item in parts.validation}
        pairs = [{recordings.streams[i].key, recordings.streams[i + 1].key} for i in range(0, 36, 2)]
        assert len(held) == 6 and all(pair <= held or not pair & held for pair in pairs)

    def test_materials_that_no_other_fold_trains_are_named(self, recordings):
        alone = replace(recordings, name="odd", fold=np.repeat([0, 1, 2], 12))
        with pytest.raises(InputError, match=r"'bark'.*never trained on"):
            split(alone, 0, seed=0)
        with pytest.raises(InputError, match=r"out of \[0, 1, 2\]; came 7"):
            split(recordings, 7, seed=0)


CELLS = [Cell("a", fold, system) for system in ("quick", "slow") for fold in (0, 1)]


class TestCells:
    def measured(self, folder, asked, stop=None, **more):
        def measure(cell, progress):
            asked.append(cell)
            if cell == stop:
                raise KeyboardInterrupt
            return {"right": cell.fold}

        return list(run_cells(folder, {"run": "some study", "seed": 0} | more, [recorded()], CELLS, measure))

    def test_a_killed_run_loses_the_cell_in_hand_alone(self, tmp_path):
        asked = []
        with pytest.raises(KeyboardInterrupt):
            self.measured(tmp_path / "run", asked, stop=CELLS[2])
        found = self.measured(tmp_path / "run", asked)
        assert asked == [*CELLS[:3], *CELLS[2:]]
        assert [(cell, figures["right"]) for cell, figures in found] == [(cell, cell.fold) for cell in CELLS]
        assert self.measured(tmp_path / "run", asked) == found and len(asked) == 5
        assert json.loads((tmp_path / "run" / "some-study.json").read_text())["plan"]["seed"] == 0
        with pytest.raises(InputError, match="seed 0 there, 1 here"):
            self.measured(tmp_path / "run", asked, seed=1)

    def test_other_data_and_other_code_are_refused(self, tmp_path, monkeypatch):
        monkeypatch.syspath_prepend(tmp_path)
        file = tmp_path / "mine_alone.py"
        file.write_text("from examples.own_system import NearestMean\n")
        study = Table1([recorded()], ("mine_alone:NearestMean",), folder=tmp_path / "run")
        ((_, first),) = study.run({"RoboSkin-20": [0]})
        assert [figures for _, figures in study.run({"RoboSkin-20": [0]})] == [first]
        file.write_text("from examples.own_system import NearestMean  # changed\n")
        with pytest.raises(InputError, match="begun with other the file of mine_alone:NearestMean"):
            list(study.run({"RoboSkin-20": [0]}))
        with pytest.raises(InputError, match="other recordings or folds of RoboSkin-20"):
            list(replace(study, sets=[recorded(seed=1)]).run({"RoboSkin-20": [0]}))

    def test_time_left_is_that_of_the_same_system_where_it_is_known(self):
        cells = [Cell("a", 0, "slow"), Cell("a", 1, "slow"), Cell("b", 0, "slow"), Cell("a", 0, "quick")]
        assert time_left({}, cells) == ""
        assert time_left({cells[0]: 30.0}, cells[1:2]) == ", about 30 s left"
        assert time_left({cells[0]: 30.0, cells[2]: 90.0}, cells[1:2]) == ", about 30 s left"  # of the same set
        assert time_left({cells[0]: 240.0, cells[3]: 1.0}, cells) == ", about 8 min left"

    def test_folds_of_unequal_size_count_by_touches(self):
        assert pooled([{"right": 1, "tested": 1}, {"right": 0, "tested": 3}])["mean"] == 0.25


class TestTable1:
    def test_rows_stand_beside_the_papers(self, recordings):
        systems = ("svm-spikes", "conv-lstm")
        whole = list(Table1([recordings], systems, epochs=2).run({"RoboSkin-20": [0, 1]}))
        found = {row["key"]: row["sets"]["RoboSkin-20"] for row in rows(whole)}
        spikes, network = found["svm-spikes"], found["conv-lstm"]
        assert spikes["paper"] == PAPER["svm-spikes"]["RoboSkin-20"] == 0.633
        assert spikes["difference"] == pytest.approx(spikes["mean"] - 0.633) and spikes["folds"] == 2
        # A network's accuracy after each epoch, over the folds: the first epochs are the curves of efficiency.
        first = [figures["epochs"][0]["accuracy"] for cell, figures in whole if cell.system == "conv-lstm"]
        assert [point[0] for point in network["points"]] == [1, 2] and "points" not in spikes
        assert network["points"][0][1:] == [pytest.approx(np.mean(first)), pytest.approx(np.std(first, ddof=1))]
        again = list(Table1([recordings], systems, epochs=2).run({"RoboSkin-20": [0, 1]}))
        assert untimed([figures for _, figures in again]) == untimed([figures for _, figures in whole])
        # Blocked folds, and the control of random weights, are not in the paper.
        ours = {"right": 3, "tested": 4, "seconds": 1.0}
        cells = [Cell("BioTac-20 blocked", 0, "svm"), Cell("BioTac-20", 0, "least-squares-random")]
        for row in rows([(cell, ours) for cell in cells]):
            for alone in row["sets"].values():
                assert (alone["mean"], alone["paper"], alone["difference"]) == (0.75, None, None)

    @pytest.mark.parametrize(
        ("wrong", "message"),
        [
            ({"systems": ("cnn",)}, "came cnn"),
            ({"systems": ("vision-lda",)}, "need the weights"),
            ({"epochs": 0}, "epochs"),
            ({"seed": -1}, "seed"),
            ({"sets": [recorded(), recorded()]}, "different names"),
        ],
    )
    def test_studies_that_cannot_be_are_refused(self, recordings, wrong, message):
        with pytest.raises(InputError, match=message):
            Table1(**({"sets": [recordings], "systems": ("svm",)} | wrong))


def test_a_result_is_whole_or_not_there(tmp_path, capsys):
    result = {"mean": 0.1 + 0.2, "nan": float("nan"), "rows": [[i, i / 3] for i in range(40)], "names": ["x" * 70] * 2}
    write_result(tmp_path / "r.json", result)
    text = (tmp_path / "r.json").read_text()
    assert json.loads(text)["rows"][1] == [1, 0.333333] and json.loads(text)["nan"] is None
    assert max(map(len, text.splitlines())) <= 120 and "0.3," in text
    with pytest.raises(InputError, match="cannot be written"):
        write_result(tmp_path / "none" / "r.json", result)


def test_a_table_on_screen_shows_what_its_rows_have(capsys):
    columns = {"name": "{./name}", "right": "{?./right|±}"}
    show("[title]", columns, [{"name": "[bold]ours", "right": {"mean": 0.5, "sd": 0.25}}, {"name": "other"}])
    shown = capsys.readouterr().out
    assert "[title]" in shown and "[bold]ours" in shown and "50.0 ± 25.0" in shown


class TestRunFile:
    def test_notes_come_back(self, tmp_path):
        RunFile(tmp_path / "run" / "notes.json", {"seed": 0}).note("a", [1, 2])
        again = RunFile(tmp_path / "run" / "notes.json", {"seed": 0})
        assert again.notes == {"a": [1, 2]}

    def test_a_link_in_the_place_of_the_draft_is_not_followed(self, tmp_path):
        record, others = tmp_path / "run" / "notes.json", tmp_path / "others"
        others.write_text("theirs")
        RunFile(record, {"seed": 0})
        record.with_name("notes.json.new").symlink_to(others)
        RunFile(record, {"seed": 0}).note("a", 1)
        assert others.read_text() == "theirs" and RunFile(record, {"seed": 0}).notes["a"] == 1

    def test_another_run_is_refused_by_what_differs(self, tmp_path):
        RunFile(tmp_path / "notes.json", {"seed": 0, "kind": "x"})
        with pytest.raises(InputError, match="seed 0 there, 1 here"):
            RunFile(tmp_path / "notes.json", {"seed": 1, "kind": "x"})

    def test_other_things_in_the_folder_are_left_alone(self, tmp_path):
        (tmp_path / "thesis.txt").write_text("mine")
        with pytest.raises(InputError, match="empty folder"):
            RunFile(tmp_path / "notes.json", {})
        assert [file.name for file in tmp_path.iterdir()] == ["thesis.txt"]

    @pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": 9, "plan": {}, "notes": {}}', "\x00"])
    def test_damaged_notes_are_refused(self, tmp_path, text):
        (tmp_path / "notes.json").write_text(text)
        with pytest.raises(InputError, match="notes"):
            RunFile(tmp_path / "notes.json", {})

"""Objects under a camera: classified by video, and their attributes graded before they are touched."""

import json

import numpy as np
import pytest
from commands import refused, run

from examples.paper.fabric.objects import Objects, most_often, object_groups, summary
from examples.paper.fabric.unseen import fit_heads
from examples.paper.readers import physiclear
from examples.paper.readers.labelled import Recordings
from scroll_tactile.errors import DatasetError, InputError
from scroll_tactile.readouts.attributes import solve
from scroll_tactile.readouts.task import Task
from scroll_tactile.signals.stream import Stream
from scroll_tactile.simulation.gel import SMALL, Gel
from scroll_tactile.statistics.grid import in_units, to_codes
from scroll_tactile.statistics.statistics import Statistics

GEL = Gel()
FINE = {name: {"grain": i % 3, "depth": i // 2} for i, name in enumerate(GEL.materials)}


def recordings(videos=4):
    """Videos of simulated frames in contact, each in a fold of its own."""
    marks = [(name, i) for name in GEL.materials for i in range(videos)]
    touches = [GEL.touch(name, i).readings[2:4] for name, i in marks]
    return Recordings(
        name="simulated",
        sensor=SMALL,
        streams=[Stream(SMALL, readings) for readings in touches],
        materials=[name for name, _ in marks],
        repetition=np.array([i for _, i in marks]),
        fold=np.array([i for _, i in marks]),
        ordered=False,
    )


@pytest.fixture(scope="module")
def results():
    pytest.importorskip("sklearn")
    return list(Objects(recordings(), FINE, groups=2, trees=5).run([0]))


def test_known_objects_are_classified_by_video_by_vote_and_by_frame(results):
    known = [item for item in results if item["part"] == "known, counts"]
    assert [item["tested"] for item in known] == [6]
    assert all(item["learned"] == 18 for item in known)
    assert np.mean([item["video"] for item in known]) >= 0.75
    for item in known:
        assert {round(item[name] * 6, 6) % 1 for name in ("video", "vote", "trees", "trees' vote")} == {0}
        assert round(item["frame"] * 12, 6) % 1 == 0


def test_attributes_are_graded_of_objects_left_out(results):
    new = [item for item in results if item["part"] == "never touched"]
    assert sorted(name for item in new for name in item["objects"]) == sorted(GEL.materials)
    assert all(item["tested"] == 4 * len(item["objects"]) == 24 - item["learned"] for item in new)
    assert all(item["attributes"].keys() == {"grain", "depth"} for item in new)
    for item in new:
        for reported in item["attributes"].values():
            assert reported.keys() == {"right", "composed", "always", "trees", "penalty", "gamma"}
            assert all(0 <= reported[name] <= 1 for name in ("right", "composed", "always", "trees"))
    means = summary(results)
    assert means["known, counts"]["video"]["mean"] == np.mean(
        [item["video"] for item in results if item["part"] == "known, counts"]
    )
    assert "grain, always" in means["never touched"]


def test_an_interrupted_run_goes_on_and_another_is_refused(tmp_path, results):
    task = Objects(recordings(), FINE, groups=2, trees=0, folder=tmp_path / "run")
    first = next(iter(task.run([0])))
    assert "trees" not in first
    assert first["digest"] == results[0]["digest"]
    again = next(iter(Objects(recordings(), FINE, groups=2, trees=0, folder=tmp_path / "run").run([0])))
    assert again == first  # its seconds too: it was read back
    with pytest.raises(InputError, match="seed 0 there, 1 here"):
        next(iter(Objects(recordings(), FINE, groups=2, seed=1, trees=0, folder=tmp_path / "run").run([0])))


def test_settings_that_cannot_be_are_refused():
    with pytest.raises(InputError, match="no more than the 6 objects"):
        Objects(recordings(), FINE, groups=7)
    with pytest.raises(InputError, match="expected folds out of"):
        list(Objects(recordings(), FINE, groups=2, trees=0).run([9]))


def test_groups_share_the_names_out():
    groups = object_groups([str(i) for i in range(23)], 4, 1)
    assert sorted(map(len, groups)) == [5, 6, 6, 6]
    assert groups == object_groups([str(i) for i in range(23)], 4, 1)
    assert groups != object_groups([str(i) for i in range(23)], 4, 2)
    assert most_often(["b", "a", "b", "a", "c"]) == "a"


def test_heads_for_the_unseen_are_chosen_by_leaving_objects_out():
    """An attribute that the first feature shows is graded of new objects; an object left out was never there."""
    rng = np.random.default_rng(0)
    statistics, shown = Statistics(6, (1,)), {}
    centres = rng.uniform(-0.5, 0.5, (30, 6))
    for i, centre in enumerate(centres):
        rows = centre + 0.05 * rng.standard_normal((5, 6))
        statistics.add(f"m{i:02}", {1: to_codes(rows, 1.0)})
        shown[f"m{i:02}"] = {"bright": int(centre[0] > 0)}
    known = {name: value for name, value in shown.items() if name < "m20"}
    head = fit_heads(statistics, 1, known, ["bright"])["bright"]
    reported = [head(in_units(centre, 1.0)) for centre in centres[20:]]
    assert np.mean([item == shown[f"m{i + 20}"]["bright"] for i, item in enumerate(reported)]) >= 0.8
    # Leaving one out by the formula is leaving it out of the system.
    counts, sums = statistics.totals(1)
    means = sums[:20] / counts[:20, None] - head.origin
    lower = Task.of(statistics, 1, statistics.names(1)).scatter
    scatter = np.tril(lower) + np.tril(lower, -1).T
    gram = means @ np.linalg.solve(scatter + head.penalty * np.trace(scatter) / 6 * np.eye(6), means.T)
    system = np.linalg.inv(solve(gram, head.gamma).inverse)
    targets = np.array([[known[f"m{i:02}"]["bright"] == value for value in head.values] for i in range(20)], float)
    error = 0.0
    for i in range(20):
        others = np.delete(np.arange(21), i)
        known_others = np.append(np.delete(targets, i, axis=0), [[0, 0]], axis=0)
        left = np.linalg.solve(system[np.ix_(others, others)], known_others)
        error += np.square(targets[i] - system[i, others] @ left).sum()
    assert error == pytest.approx(head.error)
    with pytest.raises(InputError, match="observed was 1"):
        fit_heads(statistics, 1, {"m00": known["m00"]}, ["bright"])


class TestCommand:
    def test_videos_are_streams_of_all_their_frames(self, gelsight):
        read = physiclear.videos(physiclear.load(gelsight))
        assert len(read) == 9
        assert all(stream.readings.shape == (4, 120, 160, 3) for stream in read.streams)
        assert sorted(set(zip(read.materials, read.repetition.tolist(), strict=True))) == [
            (name, video) for name in ("apple", "pen", "rug") for video in (0, 3, 5)
        ]
        assert physiclear.read_attributes(gelsight)["pen"] == {"hardness": 1, "roughness": 1, "texture": 2}

    def test_it_runs_from_the_data_to_the_figures(self, gelsight, tmp_path):
        words = ("fabric", "gelsight", "--data", gelsight, "--folds", "0", "--groups", "3", "--trees", "0")
        predicted = run(*words, "--json", tmp_path / "g.json").output
        assert all(name in predicted for name in physiclear.ATTRIBUTES)
        result = json.loads((tmp_path / "g.json").read_text())
        assert result["command"].startswith("python -m examples.paper fabric gelsight --data")
        assert result["attributes"].keys() == {"apple", "pen", "rug"}
        assert result["means"]["known, counts"]["video"]["mean"] == 1.0
        assert len(result["parts"]) == 4

    @pytest.mark.parametrize("reported", ["", "{}", '{"hardness": {"apple": 5}, "roughness": {}, "texture": {}}'])
    def test_attributes_that_cannot_be_read_are_named(self, gelsight, reported):
        (gelsight / "physiclear" / "attributes.json").write_text(reported)
        with pytest.raises(DatasetError, match=r"attributes\.json"):
            physiclear.read_attributes(gelsight)
        assert "attributes.json" in refused("fabric", "gelsight", "--data", gelsight)

"""Annotations that are cut off, that cannot be put in their place, or would leave the data set by its links."""

import json
import os
import shutil

import live_touches
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from live_touches import slide
from robot_sets import contents, robot_set

from scroll_tactile import annotate
from scroll_tactile.clients.learning.annotating import annotation_run, placing
from scroll_tactile.clients.learning.annotating.touch_columns import events_type
from scroll_tactile.errors import InputError, RecordingError


def made(folder, files=(0, 0, 1), **more):
    random = np.random.default_rng(5)
    touched = [(f"slide {m}", slide(m, n, random).astype(np.float32)) for m, n in zip("bca", (50, 40, 60), strict=True)]
    return robot_set(folder, touched, files=files, **more)


@pytest.fixture
def folder(tmp_path):
    return made(tmp_path / "set")


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    folder = tmp_path_factory.mktemp("expected")
    return contents(annotate(live_touches.learner(), made(folder / "set"), field="pad").output)


def cut_at(monkeypatch, holder, name, holds, *words, **options):
    """Annotate in a process that ends where a function is about to be called with what `holds` is true of."""
    own = getattr(holder, name)

    def cut_off(*args, **how):
        if holds(*args):
            raise KeyboardInterrupt
        return own(*args, **how)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(holder, name, cut_off)
        annotate(*words, **options)


def begun(monkeypatch, learner, folder, **options):
    """An annotation that is cut off behind its first file."""

    def second(source, name, *_):
        return name.endswith("001.parquet")

    cut_at(monkeypatch, annotation_run, "write_data", second, learner, folder, field="pad", **options)


def cut_while_moving(monkeypatch, learner, folder, **options):
    def second(path, target):
        return "annotating" in f"{path}" and f"{target}" == f"{folder}/data/chunk-000/file-001.parquet"

    cut_at(monkeypatch, type(folder), "replace", second, learner, folder, field="pad", **options)


def cut_before_the_record_is_removed(monkeypatch, learner, folder, **options):
    def last(path, *_):
        return path.name == placing.RECORD

    cut_at(monkeypatch, type(folder), "unlink", last, learner, folder, field="pad", **options)


def test_files_that_are_being_moved_are_moved_whatever_is_asked_then(folder, expected, monkeypatch):
    cut_while_moving(monkeypatch, live_touches.learner(), folder, in_place=True)
    grown = live_touches.learner("own")
    with pytest.raises(InputError, match=r"was cut off while its files were moved: it is whole now.*memory.*replace"):
        annotate(grown, folder, field="nothing", in_place=True, cut="contact")
    now = {name: data for name, data in contents(folder).items() if not name.startswith("meta.before/")}
    assert now == expected and not folder.with_name("set.annotating").exists()
    with pytest.raises(InputError, match=r"has 'observation.touch.known' already: replace=True"):
        annotate(grown, folder, field="pad", in_place=True)
    assert annotate(grown, folder, field="pad", in_place=True, replace=True).frames == 150


@pytest.mark.parametrize("in_place", [True, False])
def test_other_options_say_which_folder_to_remove_to_begin_anew(folder, expected, monkeypatch, in_place):
    learner, work = (
        live_touches.learner(),
        folder.with_name("set.annotating" if in_place else "set-annotated.annotating"),
    )
    begun(monkeypatch, learner, folder, in_place=in_place)
    with pytest.raises(InputError, match=rf"cut 'episodes' there, 'contact' here.*remove {work} to begin anew"):
        annotate(learner, folder, field="pad", in_place=in_place, cut="contact")
    shutil.rmtree(work)
    done = annotate(learner, folder, field="pad", in_place=in_place)
    assert {name: data for name, data in contents(done.output).items() if "meta.before" not in name} == expected


def test_a_file_called_as_the_record_is_one_of_the_data_sets(folder, expected):
    (folder / "annotation.json").write_text("mine")
    done = annotate(live_touches.learner(), folder, field="pad")
    assert contents(done.output) == expected | {"annotation.json": b"mine"}


@pytest.mark.parametrize("in_place", [True, False])
def test_a_cut_while_the_work_folder_is_removed_leaves_what_the_same_call_ends(folder, expected, monkeypatch, in_place):
    learner = live_touches.learner()
    cut_before_the_record_is_removed(monkeypatch, learner, folder, in_place=in_place)
    done = annotate(learner, folder, field="pad", in_place=in_place)
    assert done.frames == 150 and not list(folder.parent.glob("*.annotating"))
    assert {name: data for name, data in contents(done.output).items() if "meta.before" not in name} == expected
    with pytest.raises(InputError, match="already"):
        annotate(learner, folder, field="pad", in_place=in_place)


def test_a_new_folder_that_was_moved_away_since_is_not_said_to_be_there(folder, monkeypatch):
    learner = live_touches.learner()
    cut_before_the_record_is_removed(monkeypatch, learner, folder)
    shutil.rmtree(folder.with_name("set-annotated"))
    with pytest.raises(
        InputError, match=r"set-annotated is not there.*remove .*set-annotated.annotating to begin anew"
    ):
        annotate(learner, folder, field="pad")


def linked_metadata(folder, outside):
    (folder / "meta/notes.txt").symlink_to(outside / "secret")


def linked_folder_of_metadata(folder, outside):
    (folder / "meta/more").symlink_to(outside)


def device(folder, outside):
    (folder / "meta/zero").symlink_to("/dev/zero")


def fifo(folder, outside):
    os.mkfifo(folder / "meta/pipe")


def linked_logs(folder, outside):
    (folder / "mcap").symlink_to(outside)


def linked_frames(folder, outside):
    (folder / "data").rename(folder / "frames")
    (folder / "data").symlink_to(folder / "frames")


@pytest.mark.parametrize(
    "change", [linked_metadata, linked_folder_of_metadata, device, fifo, linked_logs, linked_frames]
)
@pytest.mark.parametrize("in_place", [True, False])
def test_links_out_of_the_data_set_are_followed_nowhere(folder, tmp_path, monkeypatch, change, in_place):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "secret").write_text("SECRET")
    (outside / "episode_000000.mcap").write_text("precious")
    change(folder, outside)
    before, answered = contents(folder), []
    monkeypatch.setattr(annotation_run, "write_data", lambda *_: answered.append(1))
    how = {"field": "pad", "forms": ("numbers", "mcap"), "replace": True, "in_place": in_place}
    with pytest.raises((InputError, RecordingError), match=r"leads out of|is a link|is a (FIFO|device)"):
        annotate(live_touches.learner(), folder, **how)
    assert not answered and contents(folder) == before and (outside / "secret").read_text() == "SECRET"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["outside", "set"]


def test_a_link_that_came_meanwhile_is_not_followed(folder, tmp_path, monkeypatch):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "episode_000000.mcap").write_text("precious")
    own = annotation_run.place
    monkeypatch.setattr(annotation_run, "place", lambda *args: (folder / "mcap").symlink_to(outside) or own(*args))
    with pytest.raises(InputError, match="mcap is a link"):
        annotate(live_touches.learner(), folder, field="pad", in_place=True, forms=("numbers", "mcap"))
    assert (outside / "episode_000000.mcap").read_text() == "precious"


def test_names_that_climb_out_of_the_data_set_are_refused(folder):
    info = json.loads((folder / "meta/info.json").read_text())
    info["data_path"] = "data/../../set/" + info["data_path"]
    (folder / "meta/info.json").write_text(json.dumps(info))
    before = contents(folder)
    with pytest.raises(RecordingError, match=r"names data outside|leads out"):
        annotate(live_touches.learner(), folder, field="pad")
    assert contents(folder) == before


def test_another_file_system_is_refused_before_anything_is_answered(folder, monkeypatch):
    monkeypatch.setattr(placing, "_device", lambda path: 1 if path == folder else 2)
    monkeypatch.setattr(annotation_run, "write_data", lambda *_: pytest.fail("answered"))
    with pytest.raises(InputError, match=r"set lies on another file system than .*: give output="):
        annotate(live_touches.learner(), folder, field="pad", in_place=True)


def test_an_output_that_is_a_link_to_nothing_is_there(folder, tmp_path, monkeypatch):
    (tmp_path / "out").symlink_to(tmp_path / "nowhere")
    monkeypatch.setattr(annotation_run, "write_data", lambda *_: pytest.fail("answered"))
    with pytest.raises(InputError, match="out is there already"):
        annotate(live_touches.learner(), folder, field="pad", output=tmp_path / "out")


@pytest.mark.parametrize("rate", [10.0, 24.0, 110.0])
def test_frames_far_from_the_sensors_rate_are_refused(tmp_path, rate):
    with pytest.raises(InputError, match=r"expected frames at about the sensor's 50 readings a second"):
        annotate(live_touches.learner(), made(tmp_path / "set", rate=rate), field="pad")


@pytest.mark.parametrize("rate", [25.0, 30.0, 100.0])
def test_frames_near_it_are_taken(tmp_path, rate):
    assert annotate(live_touches.learner(), made(tmp_path / "set", rate=rate), field="pad").touches == 3


@pytest.mark.parametrize(("name", "numbers"), [("file-001.parquet", [0] * 60), ("file-000.parquet", [0, 1, 0] * 30)])
def test_an_episode_in_two_places_is_refused(folder, monkeypatch, name, numbers):
    path = folder / "data/chunk-000" / name
    table = pq.read_table(path)
    place = table.schema.names.index("episode_index")
    pq.write_table(table.set_column(place, "episode_index", pa.array(sorted(numbers[:50]) + numbers[50:])), path)
    monkeypatch.setattr(annotation_run, "write_data", lambda *_: pytest.fail("answered"))
    with pytest.raises(RecordingError, match=r"episode 0 .*in two places.*one after the other"):
        annotate(live_touches.learner(), folder, field="pad", forms=("numbers", "mcap"))


def test_what_others_say_of_their_events_stays(tmp_path):
    rows = [[{"role": "user", "content": "hi", "style": "interjection", "camera": None, "tool_calls": None}]] * 150
    about = {"dtype": "language", "shape": [1], "names": ["mine"], "info": {"author": "me"}}
    more = {"language_events": (about, pa.array(rows, events_type()))}
    done = annotate(live_touches.learner(), made(tmp_path / "set", more=more), field="pad", replace=True)
    assert json.loads((done.output / "meta/info.json").read_text())["features"]["language_events"] == about

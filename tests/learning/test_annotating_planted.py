"""Data sets that come with the work folder of an annotation, made to harm: nothing outside the data set is written."""

import json

import live_touches
import numpy as np
import pytest
from live_touches import slide
from robot_sets import contents, robot_set

from scroll_tactile import annotate
from scroll_tactile.clients.learning.annotating import annotation_run
from scroll_tactile.errors import InputError

COUNTED = {"frames": 1, "answered": 1, "touches": 1, "events": 1, "left_out": 0}
SUMMARY = {"episodes": 1, **COUNTED}
MOVING = {"asked": {}, "done": {}, "summary": SUMMARY, "moving": ["meta/info.json"]}


@pytest.fixture
def bundle(tmp_path):
    """A folder of a home, with a data set and its own .bashrc in it."""
    folder = tmp_path / "bundle"
    robot_set(folder / "set", [("slide a", slide("a", 50, np.random.default_rng(3)).astype(np.float32))])
    (tmp_path / ".bashrc").write_text("mine")
    (folder / ".bashrc").write_text("theirs")
    return folder


def planted(bundle, notes, name="set"):
    """The work folder of an annotation of the data set, with these notes."""
    work = bundle / f"{name}.annotating"
    (work / "set").mkdir(parents=True)
    plan = {"dataset": str(bundle / "set"), "target": str(bundle / name)}
    (work / "annotation.json").write_text(json.dumps({"format": 1, "plan": plan, "notes": notes}))
    return work


HARMFUL = {
    "climbing": MOVING | {"moving": ["../../.bashrc"]},
    "climbing, kept": MOVING | {"moving": ["../../.bashrc"], "kept": "meta.before"},
    "climbing back": MOVING | {"moving": ["data/../../../.bashrc"]},
    "climbing to frames": MOVING | {"moving": ["data/../../../frames.parquet"]},
    "absolute": MOVING | {"moving": ["/frames.parquet"]},
    "another file": MOVING | {"moving": [".git/config"]},
    "not the shortest": MOVING | {"moving": ["meta//info.json"]},
    "no letters": MOVING | {"moving": ["data/\ud800.parquet"]},
    "a null": MOVING | {"moving": ["data/\0.parquet"]},
    "the data set itself": MOVING | {"moving": ["."]},
    "a number": MOVING | {"moving": [1]},
    "a text": MOVING | {"moving": "abc"},
    "nothing": MOVING | {"moving": []},
    "kept elsewhere": MOVING | {"kept": "../.."},
    "kept as metadata": MOVING | {"kept": "meta"},
    "kept as a number": MOVING | {"kept": 1},
    "asked as a list": MOVING | {"asked": [1]},
    "done as a list": MOVING | {"done": [1]},
    "done without counts": MOVING | {"done": {"a": {}}},
    "summary as a list": MOVING | {"summary": []},
    "summary of more": MOVING | {"summary": SUMMARY | {"output": 1}},
    "summary of texts": MOVING | {"summary": SUMMARY | {"frames": "1"}},
    "moving alone": {"moving": ["meta/info.json"]},
    "done alone": {"done": {"a": COUNTED}},
}


@pytest.mark.parametrize("notes", HARMFUL.values(), ids=HARMFUL)
def test_notes_that_no_annotation_wrote_are_refused(bundle, notes):
    work, before = planted(bundle, notes), contents(bundle.parent)
    with pytest.raises(InputError, match=rf"no annotation wrote these: .*Remove {work} to begin anew"):
        annotate(live_touches.learner(), bundle / "set", field="pad", in_place=True)
    assert contents(bundle.parent) == before


def test_no_files_are_moved_into_a_new_folder(bundle):
    planted(bundle, MOVING, "set-annotated")
    before = contents(bundle.parent)
    with pytest.raises(InputError, match="files are moved, though a new folder is made"):
        annotate(live_touches.learner(), bundle / "set", field="pad")
    assert contents(bundle.parent) == before


@pytest.mark.parametrize("link", ["", "set", "set/meta", "set/meta/info.json", "annotation.json.new"])
@pytest.mark.parametrize("in_place", [True, False])
def test_links_in_the_work_folder_are_not_followed(bundle, tmp_path, link, in_place):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "info.json").write_text("precious")
    work = bundle / ("set.annotating" if in_place else "set-annotated.annotating")
    (work / link).parent.mkdir(parents=True, exist_ok=True)
    (work / link).symlink_to(outside / "info.json" if link.endswith((".json", ".new")) else outside)
    before = contents(tmp_path)
    with pytest.raises(InputError, match=rf"is a link, .*remove {work} to begin anew"):
        annotate(live_touches.learner(), bundle / "set", field="pad", in_place=in_place)
    assert contents(tmp_path) == before


def test_frames_in_files_that_are_no_parquet_by_name_are_not_changed_in_place(bundle, monkeypatch):
    folder = bundle / "set"
    info = json.loads((folder / "meta/info.json").read_text())
    info["data_path"] = "data/chunk-{chunk_index:03d}/file-{file_index:03d}"
    (folder / "meta/info.json").write_text(json.dumps(info))
    (folder / "data/chunk-000/file-000.parquet").rename(folder / "data/chunk-000/file-000")
    with monkeypatch.context() as patch, pytest.raises(InputError, match=r"'data/chunk-000/file-000'.*give output="):
        patch.setattr(annotation_run, "write_data", lambda *_: pytest.fail("answered"))
        annotate(live_touches.learner(), folder, field="pad", in_place=True)
    assert annotate(live_touches.learner(), folder, field="pad").frames == 50

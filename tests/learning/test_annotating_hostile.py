"""Data sets that claim what is not so: nothing of theirs is lost, and what is refused is refused before the answers."""

import json
import os
from pathlib import Path

import live_touches
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from live_touches import slide
from robot_sets import FIELD, contents, robot_set, whole

from scroll_tactile import annotate
from scroll_tactile.clients.learning.annotating import annotation_run
from scroll_tactile.errors import FieldError, InputError, RecordingError
from scroll_tactile.recordings import read

FRAMES = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


@pytest.fixture
def folder(tmp_path):
    random = np.random.default_rng(5)
    return robot_set(tmp_path / "set", [(f"slide {m}", slide(m, 50, random).astype(np.float32)) for m in "ab"])


@pytest.fixture
def unanswered(monkeypatch):
    """Nothing is answered."""
    monkeypatch.setattr(annotation_run, "write_data", lambda *_: pytest.fail("answered"))


@pytest.mark.parametrize("name", ["timestamp", "note"])
def test_what_a_robot_recorded_is_never_replaced_whoever_is_said_to_have_written_it(folder, name):
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"][name]["info"] = {"written by": "scroll-tactile"}
    (folder / "meta/info.json").write_text(json.dumps(info))
    before = pq.read_table(folder / FRAMES)
    annotate(live_touches.learner(), folder, field="pad", in_place=True, replace=True)
    assert whole(folder).select(before.schema.names).equals(before)
    assert name in json.loads((folder / "meta/info.json").read_text())["features"]


@pytest.mark.parametrize("data", [b"", b"some", b"some" * 300_000])
def test_the_holes_of_a_file_are_copied_as_holes(folder, data):
    with (folder / "notes.bin").open("wb") as file:
        file.write(data[:4])
        file.seek(1 << 28)
        file.write(data)
        file.truncate(1 << 29)
    if 512 * (folder / "notes.bin").stat().st_blocks > 1 << 26:
        pytest.skip("a file has no holes here: the file system writes them out")
    copy = annotate(live_touches.learner(), folder, field="pad").output / "notes.bin"
    assert copy.stat().st_size == 1 << 29 and 512 * copy.stat().st_blocks < 1 << 26
    with copy.open("rb") as file:
        assert file.read(5) == data[:4].ljust(5, b"\0")
        file.seek((1 << 28) - 1)
        assert file.read(len(data) + 2) == b"\0" + data + b"\0"


def frames(folder, count, **columns):
    """Write as many frames, which take next to no room on the disk, with these columns in the place of theirs."""
    none, numbers = np.zeros(count, int), np.arange(count)
    whole = {"timestamp": numbers / 50, "frame_index": none, "episode_index": none, "index": none, "task_index": none}
    readings = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(2 * count, np.float32)), 2)
    packed = dict.fromkeys(("episode_index", "index"), "DELTA_BINARY_PACKED")
    table = pa.table({FIELD: readings, **(whole | columns)})
    pq.write_table(table, folder / FRAMES, compression="zstd", use_dictionary=False, column_encoding=packed)


def test_logs_are_bounded_by_what_the_data_set_has_on_the_disk(folder, unanswered):
    frames(folder, 3000, episode_index=np.arange(3000))
    with pytest.raises(RecordingError, match=r"claims to hold .* steps of work in"):
        annotate(live_touches.learner(), folder, field="pad", forms=("numbers", "mcap"))


def test_short_episodes_that_are_there_have_their_logs(tmp_path, monkeypatch):
    random = np.random.default_rng(5)
    folder = robot_set(tmp_path / "set", [("a", slide("a", 10, random)) for _ in range(300)])
    monkeypatch.setattr(annotation_run._Rewritten, "write", lambda *_: pytest.fail("the answers are begun"))
    with pytest.raises(pytest.fail.Exception, match="begun"):
        annotate(live_touches.learner(), folder, field="pad", forms=("numbers", "mcap"))


def test_a_link_to_nothing_takes_the_name_that_metadata_would_be_kept_by(folder, tmp_path):
    (folder / "meta.before").symlink_to(tmp_path / "nowhere")
    before = contents(folder / "meta")
    done = annotate(live_touches.learner(), folder, field="pad", in_place=True)
    assert done.kept == folder / "meta.before-2" and contents(done.kept) == before
    assert not (tmp_path / "nowhere").exists()


def test_no_name_to_keep_metadata_by_is_said_before_anything_is_answered(folder, unanswered):
    for name in ("meta.before", *(f"meta.before-{number}" for number in range(2, 1000))):
        (folder / name).mkdir()
    with pytest.raises(InputError, match=r"everything from meta.before to meta.before-999: remove some, or .*output="):
        annotate(live_touches.learner(), folder, field="pad", in_place=True)
    assert not folder.with_name("set.annotating").exists()


def changed(folder, name, change):
    """Write a table of the data set as a function makes it."""
    pq.write_table(change(pq.read_table(folder / name)), folder / name)


def with_column(table, name, values):
    return table.set_column(table.schema.names.index(name), name, values)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("missing", [1, 100])
def test_frames_without_the_number_of_their_episode_are_refused_and_nothing_else_is_said(folder, unanswered, missing):
    values = pa.array([None] * missing + [0] * (100 - missing), pa.int64())
    changed(folder, FRAMES, lambda table: with_column(table, "episode_index", values))
    for use in (lambda: annotate(live_touches.learner(), folder, field="pad"), lambda: read(folder, field="pad")):
        with pytest.raises(FieldError, match=r"'episode_index' of .* has rows without a number; expected one in each"):
            use()


def test_a_file_without_rows_is_said_to_have_none(folder, unanswered):
    changed(folder, FRAMES, lambda table: table.slice(0, 0))
    for use in (lambda: annotate(live_touches.learner(), folder, field="pad"), lambda: read(folder, field="pad")):
        with pytest.raises(RecordingError, match=r"file-000.parquet has no rows: remove it, or write it again"):
            use()


def test_metadata_in_files_of_any_name_are_copied(folder):
    name = os.fsencode(folder / "meta") + b"/notes \xff.txt"
    try:
        Path(os.fsdecode(name)).write_text("mine")
    except OSError:
        pytest.skip("a file has no such name here: the file system takes text only")
    done = annotate(live_touches.learner(), folder, field="pad", in_place=True)
    assert (done.kept / os.fsdecode(b"notes \xff.txt")).read_text() == "mine"


TABLES = {
    "none": (lambda table: table.drop_columns(["episode_index"]), r"0 columns 'episode_index'"),
    "two": (lambda table: table.append_column("episode_index", table["episode_index"]), r"2 columns .*int64, int64"),
    "lists": (lambda table: with_column(table, "episode_index", pa.array([[0], [1]])), r"1 columns .*list"),
    "texts": (lambda table: with_column(table, "episode_index", pa.array(["0", "1"])), r"1 columns .*string"),
}


@pytest.mark.parametrize(("change", "said"), TABLES.values(), ids=TABLES)
def test_tables_of_episodes_are_looked_at_before_anything_is_answered(folder, unanswered, change, said):
    changed(folder, EPISODES, change)
    with pytest.raises(FieldError, match=rf"{EPISODES} of .* has {said}.*expected one of whole numbers"):
        annotate(live_touches.learner(), folder, field="pad")
    assert not folder.with_name("set-annotated.annotating").exists()


def test_statistics_are_looked_at_before_anything_is_answered(folder, unanswered):
    (folder / "meta/stats.json").write_text("[1]")
    with pytest.raises(RecordingError, match=r"meta/stats.json of .* is a list; expected names"):
        annotate(live_touches.learner(), folder, field="pad")

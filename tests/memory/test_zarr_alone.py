"""A checkpoint opened with `zarr.open` alone has what the learner has: statistics, sample, kept touches, exemplars."""

import numpy as np
import pytest
import zarr
from touches import OBSERVED, filled, stream

KEPT = 3  # observations behind the compaction checkpoint


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A compacted memory, open, and its checkpoints as zarr opens them: the newest, and that of the compaction."""
    learner, _ = filled(tmp_path_factory.mktemp("made") / "m")
    learner.compact(keep=KEPT)
    groups = [zarr.open(folder, mode="r") for folder in sorted((learner.path / "checkpoints").iterdir())]
    yield learner, *sorted(groups, key=lambda group: -group.attrs["last_sequence"])
    learner.close()


def keys(group, name):
    return [row.tobytes() for row in group[name][...]]


def test_all_arrays_are_numbers_and_nothing_else_is_needed(made):
    for group in made[1:]:
        for name, array in group.arrays():
            assert array.dtype.kind in "iuf", name
            assert np.asarray(array[...]).shape == array.shape
            names = [codec["name"] for codec in array.metadata.to_dict()["codecs"]]
            assert names == ["bytes", "zstd"]


def test_the_statistics_are_the_learners(made):
    learner, group, _ = made
    statistics, told = learner.memory.statistics, group.attrs["attributes"]
    names = told["statistics"]["materials"]
    assert dict(zip(names, group["statistics-observations"][...].tolist(), strict=True)) == learner.materials
    for scale in statistics.scales:
        counts = dict(zip(names, group[f"statistics-rows-{scale}"][...].tolist(), strict=True))
        assert counts == dict(zip("abc", statistics.counts(scale, list("abc")).tolist(), strict=True))
        sums = group[f"statistics-sums-{scale}"]
        assert sums.dtype == np.int64
        assert sums[...].tolist() == statistics.sums(scale, names).tolist()
        if f"statistics-second-{scale}" in group:
            packed = group[f"statistics-second-{scale}"][...]
        else:
            rows = group[f"statistics-codes-{scale}"][...].astype(np.int64)
            packed = (rows @ rows.T)[np.tril_indices(len(rows))]
        assert packed.tolist() == statistics.second(scale).packed().tolist()


def test_the_sample_is_the_learners(made):
    learner, group, _ = made
    own = list(learner.memory.sample)
    assert group.attrs["attributes"]["sample"]["materials"] == [material for material, *_ in own]
    assert keys(group, "sample-keys") == [key for _, key, _ in own]
    pairs = group["sample-pairs"][...]
    assert pairs.tolist() == np.concatenate([touch.pairs for *_, touch in own]).tolist()
    rows = group["sample-rows"][...].T
    assert rows.tolist() == np.concatenate([touch.rows for *_, touch in own]).tolist()


def test_the_kept_touches_are_the_learners(made):
    learner, group, _ = made
    own, sensor = learner.memory.kept.touches(), learner.sensor
    ends = np.cumsum(group["kept-columns"][...] * sensor.channels)
    levels = np.split(group["kept-levels"][...], ends[:-1])
    assert keys(group, "kept-keys") == [touch.key for touch in own]
    for touch, found in zip(own, levels, strict=True):
        assert found.reshape(sensor.channels, -1).tolist() == touch.levels.tolist()


def test_the_exemplars_are_readings_in_the_sensors_unit(made):
    _, _, group = made
    readings = group["exemplars-held-readings"]
    assert readings.dtype == np.float32
    touches = np.split(readings[...], np.cumsum(group["exemplars-held-lengths"][...])[:-1])
    materials = group.attrs["attributes"]["exemplars"]["materials"]
    compacted = [(name, np.clip(stream(touch), 0, 1).astype(np.float32)) for name, touch in OBSERVED[:-KEPT]]
    assert len(touches) == len(compacted)
    for material, found in zip(materials, touches, strict=True):
        assert any(name == material and np.array_equal(found, given) for name, given in compacted)

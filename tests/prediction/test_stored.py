"""The model that a writer keeps: read by whoever opens the memory, to the bit, and never believed where it is wrong."""

import logging
import mmap
import shutil
from dataclasses import replace

import numpy as np
import pytest
import scroll_tactile_store.derived
from prediction.test_current import OBSERVED, SETTINGS, bits, fed, stream
from scroll_tactile_store import DamageError, check_store, repair_store
from scroll_tactile_store.derived import read_derived, write_derived
from scroll_tactile_store.layout import read_current
from touches import SmallSample

from scroll_tactile import TactileLearner
from scroll_tactile.persistence.ledger import axis_name
from scroll_tactile.prediction.fitting import Draft
from scroll_tactile.prediction.stored import MAPPED, NAME


def opened(path, mode="read", **settings):
    return TactileLearner.open(path, mode=mode, **SETTINGS, **settings)


def make(path, observed=OBSERVED):
    with opened(path, "write") as learner:
        for material, seed in observed:
            learner.observe(material, stream(material, seed))
        return bits(learner)


def files(path):
    return {one.relative_to(path): one.read_bytes() for one in path.rglob("*") if one.is_file()}


def kept(path):
    return path / "derived" / NAME


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A memory whose writer kept its model, and what that answered."""
    path = tmp_path_factory.mktemp("kept") / "m"
    return path, make(path)


@pytest.fixture
def path(made, tmp_path):
    """A copy of it, somewhere else."""
    return shutil.copytree(made[0], tmp_path / "m")


@pytest.fixture
def fits(monkeypatch):
    """How many models were fitted."""
    found, fit = [], Draft.fit

    def counted(draft, extractor):
        found.append(1)
        return fit(draft, extractor)

    monkeypatch.setattr(Draft, "fit", counted)
    return found


@pytest.mark.parametrize("mode", ["read", "write"])
def test_who_opens_the_memory_answers_as_the_writer_did_and_fits_nothing(made, path, fits, mode, caplog):
    before = files(path)
    with opened(path, mode) as learner:
        assert bits(learner) == made[1]
    learner.close()  # it is closed already
    assert (fits, caplog.records) == ([], [])
    if mode == "read":
        assert files(path) == before
    else:
        assert kept(path).read_bytes() == before[kept(path).relative_to(path)]


def test_without_it_the_model_is_fitted_and_a_writer_keeps_it_again(made, path, fits):
    shutil.rmtree(path / "derived")
    before = files(path)
    reader = opened(path)
    reader.close()
    assert bits(reader) == made[1]  # closed, it fits all the same, and writes nothing
    assert (files(path), fits) == (before, [1])
    fits.clear()
    with opened(path, "write") as learner:
        assert bits(learner) == made[1]
    assert fits == [1]
    with opened(path) as learner:
        assert bits(learner) == made[1]
    assert fits == [1]


def test_what_was_asked_for_nothing_keeps_nothing(tmp_path):
    with opened(tmp_path / "m", "write") as learner:
        learner.observe("a", stream("a", 1))
    assert not (tmp_path / "m" / "derived").exists()


def test_a_model_that_followed_answers_the_same_after_opening(path, fits):
    with opened(path, "write") as learner:
        for seed in range(30, 32):
            learner.observe("a", stream("a", seed))
        said = bits(learner)
    assert fits == []  # its readouts were solved again, from the integers
    with opened(path) as reader:
        assert bits(reader) == said
        reader.settle()
        assert bits(reader) == bits(fed([*OBSERVED, ("a", 30), ("a", 31)]))


@pytest.mark.parametrize("change", ["observed", "new", "retracted"])
def test_rows_behind_the_checkpoint_are_taken_in(path, fits, change):
    learner = opened(path, "write")
    if change == "retracted":
        learner.retract(2)
    else:
        learner.observe("a" if change == "observed" else "d", stream("a", 40))
    wanted = learner.digest()
    learner._ledger.saves = False
    learner.close()  # as if its process had died
    with opened(path) as reader:
        assert reader.digest() == wanted
        said, numbers = bits(reader), reader.memory.statistics
        model = reader._predictor.current.present(reader._ledger)
        assert model.names == list(numbers.materials)
        for scale, readout in model.readouts.items():
            assert readout.counts.sum() == numbers.counts(scale, numbers.names(scale)).sum()
        assert fits == []
        assert all(np.isfinite(float.fromhex(novelty)) for _, novelty, _ in said)
        reader.settle()
        observed = [one for i, one in enumerate(OBSERVED) if (change, i) != ("retracted", 1)]
        whole = fed(observed)
        if change != "retracted":
            whole.observe("a" if change == "observed" else "d", stream("a", 40))
        assert bits(reader) == bits(whole)


def test_composition_rests_on_touches_held_out_and_is_fitted(path, fits):
    with opened(path, "write") as learner:
        for name, share in (("a", 1.0), ("b", 0.0), ("c", 0.5)):
            learner.describe(name, {"wool": share, "silk": 1 - share})
        assert learner.compose(stream("a", 50)).constituents
    assert fits


def test_another_readout_fits_its_own(path, fits):
    with opened(path, readout="ridge") as learner:
        assert bits(learner) == bits(fed(OBSERVED, readout="ridge"))
    assert fits


def test_one_of_another_checkpoint_or_release_is_not_read(made, path, fits, monkeypatch):
    earlier = kept(path).read_bytes()
    with opened(path, "write") as learner:
        learner.observe("a", stream("a", 60))
        learner.settle()
        said = bits(learner)
    kept(path).write_bytes(earlier)
    fits.clear()
    with opened(path) as learner:
        assert bits(learner) == said
    assert fits == [1]
    monkeypatch.setattr("scroll_tactile.prediction.stored.MADE_BY", "another")
    with opened(made[0]) as learner:
        assert bits(learner) == made[1]
    assert fits == [1, 1]


def test_a_damaged_file_is_not_used(made, path, fits):
    whole = kept(path).read_bytes()
    for place in (0, 41, len(whole) // 2, len(whole) - 1):
        harmed = bytearray(whole)
        harmed[place] ^= 1
        kept(path).write_bytes(harmed)
        with opened(path) as learner:
            learner.predict(stream("a", 50))
    assert len(fits) == 4
    kept(path).write_bytes(whole[:-40])
    with opened(path) as learner:
        assert bits(learner) == made[1]
    kept(path).unlink()
    (path.parent / "elsewhere").write_bytes(whole)
    kept(path).symlink_to(path.parent / "elsewhere")  # which is not followed
    with opened(path) as learner:
        assert bits(learner) == made[1]
    assert len(fits) == 6
    kept(path).unlink()
    kept(path).mkdir()
    kept(path).with_name(f"{NAME}.new").write_bytes(whole[:1000])  # half written, and replaced
    with opened(path, "write") as learner:
        assert bits(learner) == made[1]  # and it closes


def by_slip(learner):
    return [learner.predict(stream("a", seed), of="slip") for seed in range(50, 53)]


def test_the_model_of_an_axis_is_kept_beside_it_and_refused_where_it_is_wrong(tmp_path, fits):
    path, name = tmp_path / "m", axis_name(NAME, "slip")
    with opened(path, "write") as learner:
        for i, (material, seed) in enumerate(OBSERVED):
            learner.observe(material, stream(material, seed), labels={"slip": "ne"[i % 2]} if i % 5 else None)
        learner._predictor.prepare_to_store()
        told = bits(learner), by_slip(learner)
    assert len(fits) == 2
    for mode in ("read", "write"):
        with opened(path, mode) as learner:
            assert (bits(learner), by_slip(learner)) == told
    assert len(fits) == 2
    with opened(path, "write") as learner:
        learner.observe("a", stream("a", 80))  # without a label: the axis has the same touches
        followed = by_slip(learner)
    with opened(path) as learner:
        assert by_slip(learner) == followed
        learner.settle()
    assert len(fits) == 4
    whole = (path / "derived" / name).read_bytes()
    forge(path, of_array("moments", lambda array: np.full_like(array, np.nan)), name)
    forged = (path / "derived" / name).read_bytes()
    for data in (forged, whole[:5000] + bytes([whole[5000] ^ 1]) + whole[5001:]):
        (path / "derived" / name).write_bytes(data)
        fits.clear()
        with opened(path) as learner:
            assert len(by_slip(learner)) == 3
        assert len(fits) == 1


def forge(path, change, name=NAME):
    """The same file with other arrays or attributes, under a digest that is right."""
    follows = read_current(path / "CURRENT").newest.sha256
    about, arrays = read_derived(path, name, follows)
    about, arrays = change(dict(about), dict(arrays))
    arrays = {own: np.ascontiguousarray(array) for own, array in arrays.items()}
    write_derived(
        path,
        name,
        follows,
        scroll_tactile_store.records.to_json("attributes", about),
        arrays,
        [*filter(mapped, arrays)],
    )


def load(learner, change):
    """Have a memory read what it keeps with other arrays or attributes; the model, or None where it refuses them."""
    current, ledger = learner._predictor.current, learner._ledger
    stored = ledger.derived(NAME)
    about, arrays = change(dict(stored.attributes), dict(stored.arrays))
    forged = replace(stored, attributes=about, arrays={own: np.ascontiguousarray(a) for own, a in arrays.items()})
    current.discard_stored()
    current._tried_stored = False
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ledger, "derived", lambda name: forged)
        current._load_stored(ledger)
    return current._model


def mapped(name):
    return name.startswith(tuple(f"{kind}-" for kind in MAPPED))


def of_array(name, do):
    return lambda about, arrays: (about, {**arrays, name: do(arrays[name])})


def less(name):
    return lambda about, arrays: (about, {key: array for key, array in arrays.items() if key != name})


def names_of_arrays(path):
    return sorted(read_derived(path, NAME, read_current(path / "CURRENT").newest.sha256)[1])


def test_what_no_model_has_is_refused_and_fitted(made, path, fits):
    """Every array left out, of another shape, type or value; every attribute of another type."""
    changes, refused, allowed = [], 0, []
    # The others are empty here: see `many` for these.
    names = [name for name in names_of_arrays(path) if not name.startswith("others-")]
    for name in sorted({name.rstrip("-0123456789"): name for name in names}.values()):
        if name not in ("kept-keys", "banks"):  # without them it is a model without kept touches, or without banks
            changes.append((name, less(name)))
        changes.append((name, of_array(name, lambda array: array[..., :-1] if array.ndim else array)))
        changes.append((name, of_array(name, lambda array: np.repeat(array, 2, axis=0))))
        changes.append((name, of_array(name, lambda array: array.astype(np.complex64).view(np.float32))))
        changes.append((name, of_array(name, lambda array: array[None])))
    for name in ("near-solved-15", "moments", "weights", "spread", "dependence", "scale_novelty", "origin-15"):
        changes.append((name, of_array(name, lambda array: np.full_like(array, np.nan))))
    for name in ("names-15", "kept-order", "kept-materials", "targets", "bank-rows-0"):
        changes.append((name, of_array(name, lambda array: array + 2**40)))
        changes.append((name, of_array(name, lambda array: array - 2**40)))
    for name in ("made_by", "readout", "names", "scales", "calibrations", "moments", "least", "longest", "fitted_to"):
        for value in (None, -1, 10**30, [1.5]):
            changes.append((name, lambda about, arrays, n=name, v=value: ({**about, n: v}, arrays)))
    with opened(path) as learner:
        for name, change in changes:
            if load(learner, change) is None:
                refused += 1
            else:
                allowed.append(name)
                assert bits(learner)
    assert refused > 100
    assert not allowed
    forge(path, less("moments"))
    with opened(path) as learner:
        assert bits(learner) == made[1]
    assert fits == [1]


def test_what_is_learned_never_rests_on_banks_that_were_read(path):
    names = [name for name in names_of_arrays(path) if name.startswith("bank-thresholds")]
    forge(path, lambda about, arrays: (about, {n: a + 5 if n in names else a for n, a in arrays.items()}))
    with opened(path, "write") as learner:
        learner.predict(stream("a", 50))
        learner.observe("a", stream("a", 70))
        assert learner.digest() == fed([*OBSERVED, ("a", 70)]).digest()


@pytest.mark.parametrize("failing", ["new_file", "payload_digest"])
def test_a_failure_to_write_it_changes_nothing_else(made, path, monkeypatch, caplog, failing):
    def fail(*args):
        raise OSError(28, "No space left on device")

    with opened(path, "write") as learner:
        learner.observe("a", stream("a", 60))
        learner.settle()
        said = bits(learner)
        monkeypatch.setattr(scroll_tactile_store.derived, failing, fail)
        with caplog.at_level(logging.WARNING):
            learner.close()
    assert "will be made again" in caplog.text
    monkeypatch.undo()
    assert [problem for problem in check_store(path) if problem.kind != "leftover"] == []
    with opened(path) as learner:
        assert bits(learner) == said


def test_a_reader_keeps_its_sums_where_a_writer_has_replaced_the_checkpoint(path):
    with opened(path) as reader:
        with opened(path, "write") as writer:
            writer.observe("a", stream("a", 80))
        assert reader.digest() == fed(OBSERVED).digest()
        assert len(reader.memory.sample) == len(OBSERVED)
        assert reader.refresh()
        assert reader.digest() == fed([*OBSERVED, ("a", 80)]).digest()


@pytest.mark.parametrize("array", ["second-15", "places-1048576"])
def test_sums_that_are_damaged_after_opening_are_named_and_the_memory_can_be_repaired(path, array):
    chunk = next(one for one in path.glob(f"checkpoints/*/{array}/c/**/*") if one.is_file())
    with opened(path) as reader:
        data = chunk.read_bytes()
        chunk.write_bytes(data[:20] + bytes([data[20] ^ 1]) + data[21:])
        for _ in range(2):
            with pytest.raises(DamageError, match=rf"array '{array}' of checkpoint .* cannot be read"):
                reader.digest()
        chunk.write_bytes(data)
        assert reader.digest() == fed(OBSERVED).digest()
    chunk.write_bytes(data[:-1])
    repair_store(path)
    with opened(path) as reader:
        assert reader.digest() == fed(OBSERVED).digest()


def test_compacting_leaves_nothing_of_what_was_forgotten(path):
    with opened(path, "write") as learner:
        learner.forget("b")
        learner.compact()
        assert not kept(path).exists()


@pytest.fixture
def many(monkeypatch, tmp_path):
    """A memory of more materials than are sampled, held in single precision, and what it answered."""
    monkeypatch.setattr("scroll_tactile.readouts.task.IN_DOUBLE", 2)
    monkeypatch.setattr("scroll_tactile.memory.state.TouchSample", SmallSample)
    path = tmp_path / "many"
    with opened(path, "write") as learner:
        for seed in range(4):
            for material in "abcdef":
                learner.observe(material, stream(material, seed))
        bits(learner)
        learner.observe("e", stream("e", 20))  # its readouts follow
        return path, bits(learner)


def test_of_many_materials_who_opens_the_memory_maps_what_was_solved_and_fits_nothing(many, fits):
    path, said = many
    with opened(path) as reader:
        assert bits(reader) == said
        for readout in reader._predictor.current._model.readouts.values():
            assert len(readout.others)
            assert isinstance(source(readout.others.means), mmap.mmap)
        with opened(path, "write") as writer:
            writer.observe("g", stream("f", 21))
            assert "g" in dict(writer.predict(stream("f", 50)).ranking)
            told = bits(writer)
        assert bits(reader) == said  # it keeps what it mapped where a writer has replaced it
    assert fits == []  # the readouts were solved again, from the integers
    with opened(path) as reader:
        assert bits(reader) == told


def source(array):
    """What has the bytes of an array."""
    while isinstance(array, np.ndarray):
        array = array.base
    return array.obj if isinstance(array, memoryview) else array

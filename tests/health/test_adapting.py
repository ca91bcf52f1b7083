"""A changed skin taken over: what is found out of it, what is read through it, and all that stays as it was."""

import json
import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import refused, run
from forging import checkpoint_of, put_checkpoint, put_row
from scroll_tactile_store import ReadOnlyError, StoreError
from touches import spoil

from scroll_tactile import Adaptation, Kernels, Scene, Sensor, TactileLearner, errors, sensors
from scroll_tactile.clients.learning.fleet import learn
from scroll_tactile.clients.report import memory_page
from scroll_tactile.health.channel_numbers import channel_numbers, from_text
from scroll_tactile.memory.gate import check_memory
from scroll_tactile.signals.correction import Correction
from scroll_tactile.signals.stream import Stream, validate

PAD = Sensor(name="pad", channels=8, rate=50.0, low=0.0, high=1000.0, unit="counts", duration=1.0)
SCENE = Scene(sensor=PAD, seed=3)
NAMES = SCENE.materials[:5]
HOW: dict[str, Any] = {"embedding": Kernels(dimension=64)}
RANDOM = np.random.default_rng(0)
GAINS, OFFSETS = RANDOM.uniform(0.8, 1.2, 8), RANDOM.uniform(-20, 20, 8)
DEAD = 5

Skin = Callable[[Stream], np.ndarray[Any, Any]]


def touch(name: str, repetition: int) -> Stream:
    return SCENE.touch(name, repetition)


def other(stream: Stream) -> np.ndarray[Any, Any]:
    """What another unit reads."""
    return np.clip(stream.readings * GAINS + OFFSETS, 0, 1000).astype(np.float32)


def broken(stream: Stream) -> np.ndarray[Any, Any]:
    """What another unit reads, one channel of which is dead."""
    readings = other(stream)
    readings[:, DEAD] = 0
    return readings


def five(skin: Skin = other, first: int = 50) -> list[tuple[str, Any]]:
    return [(name, skin(touch(name, first))) for name in NAMES]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A memory of ten touches of five materials."""
    path = tmp_path_factory.mktemp("adapting") / "made"
    with TactileLearner.open(path, sensor=PAD, **HOW) as learner, learner.batch():
        for i in range(10):
            for name in NAMES:
                learner.observe(name, touch(name, i))
    return path


@pytest.fixture
def path(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "memory"))


def correction(learner: TactileLearner) -> str | None:
    found = learner.memory.correction
    return None if found is None else found.to_text()


def test_a_reading_at_an_end_of_the_range_stays_and_a_stream_is_corrected_once() -> None:
    lost = np.arange(8) == DEAD
    guess = np.array([[0.5, 0, 0, 0, 0, 0, 0, 0.25]], np.float32)
    skin = Correction(np.full(8, 2, np.float32), np.full(8, 100, np.float32), lost, guess)
    stream = validate(np.tile([[0.0], [50.0], [500.0], [1000.0]], 8), PAD)
    read = skin.applied(stream)
    assert read.readings[:, 0].tolist() == [0, 0, 200, 1000]
    assert read.readings[:, DEAD].tolist() == [250, 250, 350, 750]  # half of the first channel, and a quarter
    assert read.mask is not None
    assert (read.mask == lost).all()
    assert (read.raw, read.readings.flags.writeable) == (stream, False)
    assert skin.applied(read) is read
    part = read.first(0.04)
    assert (part.raw, part.missing) == (stream.first(0.04), 2)
    assert pickle.loads(pickle.dumps(read)).raw == stream
    gaps = np.where(np.arange(4)[:, None] == 1, np.nan, stream.readings)
    gappy = validate(gaps, PAD.model_copy(update={"non_finite": "missing"}))
    assert skin.applied(gappy).missing == gappy.missing + 3  # of the channel that is left out, but for its gap
    text = skin.to_text()
    assert Correction.from_text(text, PAD).to_text() == text
    for wrong in (None, "=", text[:-4], Correction.none(9).to_text()):
        with pytest.raises(errors.InputError, match="a gain and an offset"):
            Correction.from_text(wrong, PAD)


def test_another_unit_is_read_as_the_one_that_learned(path: Path) -> None:
    with TactileLearner.open(path) as learner:
        digest, count = learner.digest(), learner.memory.sequence
        before = [learner.predict(other(touch(name, i))) for name in NAMES for i in range(60, 63)]
        done = learner.adapt(five())
        assert (done.kept, done.sequence, done.left_out) == (True, count + 1, ())
        assert np.abs(np.log(np.array(done.gains) / GAINS)).mean() < 0.3 * np.abs(np.log(GAINS)).mean()
        assert done.after < 1 < done.before
        assert learner.digest() == digest
        after = [learner.predict(other(touch(name, i))) for name in NAMES for i in range(60, 63)]
        assert np.mean([p.novelty for p in after]) < np.mean([p.novelty for p in before])
        assert [p.material for p in after] == np.repeat(NAMES, 3).tolist()
        learner.retract(done)
        assert [learner.predict(other(touch(name, i))) for name in NAMES for i in range(60, 63)] == before
        assert learner.digest() == digest


def test_what_is_learned_through_it_is_what_its_readings_would_be_by_themselves(path: Path, tmp_path: Path) -> None:
    shutil.copytree(path, tmp_path / "plain")
    with TactileLearner.open(path) as learner, TactileLearner.open(tmp_path / "plain") as plain:
        learner.adapt(five())
        for name in NAMES:
            raw = other(touch(name, 70))
            read = learner.stream(raw)
            receipt = learner.observe(name, raw)
            assert learner.observe(name, read).repeated  # not corrected twice
            assert plain.observe(name, read.readings).key == receipt.key
            learner.sense(raw, name)
            store = learner._ledger.store
            assert store is not None
            rows = [head for head in store.heads(receipt.sequence - 1) if "channels" in head.attributes]
            measured = channel_numbers(read)
            assert measured is not None
            for head in rows:
                found = from_text(head.attributes["channels"], 8)
                assert found is not None and found.tobytes() == measured.tobytes()
        assert learner.digest() == plain.digest()


def test_it_holds_over_restart_compaction_backup_reembedding_and_snapshots(path: Path, tmp_path: Path) -> None:
    learner = TactileLearner.open(path)
    reader = TactileLearner.open(path, mode="read")
    learner.adapt(five(broken))
    kept, digest = correction(learner), learner.digest()
    assert correction(reader) is None
    assert reader.refresh() and correction(reader) == kept
    reader.close()
    assert correction(pickle.loads(pickle.dumps(learner))) == kept
    assert learner._ledger.store is not None
    learner._ledger.store.close()  # as if the power failed: the row is replayed
    with TactileLearner.open(path) as learner:
        assert (correction(learner), learner.digest()) == (kept, digest)
        learner.observe(NAMES[0], other(touch(NAMES[0], 80)))
        for keep in (20, 0):  # before the row, and behind it
            learner.compact(keep=keep)
            assert correction(learner) == kept
            learner.backup(tmp_path / f"copy-{keep}")
        digest = learner.digest()
    for keep in (20, 0):
        with TactileLearner.open(tmp_path / f"copy-{keep}") as copy:
            assert (correction(copy), copy.digest()) == (kept, digest)
            copy.retract(51)  # compacted or not
            assert correction(copy) is None
        with TactileLearner.open(tmp_path / f"copy-{keep}") as copy:
            assert (correction(copy), copy.digest()) == (None, digest)
        assert check_memory(tmp_path / f"copy-{keep}") == []


def test_a_compaction_checkpoint_behind_it_has_it(path: Path) -> None:
    with TactileLearner.open(path) as learner:
        learner.adapt(five())
        for i in range(2):
            learner.observe(NAMES[0], other(touch(NAMES[0], 80 + i)))
        learner.compact(keep=1)
        kept, store = correction(learner), learner._ledger.store
        assert store is not None and store.state().newest is not None
        newest, learner._ledger.saves = store.state().newest, False
    spoil(path, newest)
    with TactileLearner.open(path) as learner:
        assert learner.memory.checkpoint != newest and correction(learner) == kept


def test_reembedding_keeps_it_and_reads_what_was_learned_as_it_was_read(path: Path) -> None:
    with TactileLearner.open(path) as learner:
        learner.adapt(five())
        learner.observe(NAMES[0], other(touch(NAMES[0], 80)))
        kept, digest = correction(learner), learner.digest()
        learner.reembed(Kernels(dimension=128))
        learner.reembed(Kernels(dimension=64))
        assert (correction(learner), learner.digest()) == (kept, digest)


def test_another_robots_adaptation_stays_with_it(path: Path, tmp_path: Path) -> None:
    shutil.copytree(path, tmp_path / "robot")
    with TactileLearner.open(tmp_path / "robot") as robot:
        robot.adapt(five())
        for name in NAMES:
            robot.observe(name, other(touch(name, 90)))
        read = [robot.stream(other(touch(name, 90))).readings for name in NAMES]
        robot.pack(tmp_path / "robot.stm")
        robot.pack(tmp_path / "small.stm", rows=False)
        digest = robot.digest()
    for where in ("robot", "robot.stm"):
        shutil.copytree(path, tmp_path / f"{where}-merged")
        with TactileLearner.open(tmp_path / f"{where}-merged") as learner:
            own = learner.adapt(five(broken))
            kept = correction(learner)
            learner.merge(tmp_path / where)
            assert (learner.digest(), correction(learner)) == (digest, kept)
            assert all(learner.names_of(Stream(PAD, readings, raw=validate(readings, PAD))) for readings in read)
            learner.retract(own)
            assert correction(learner) is None
        assert check_memory(tmp_path / f"{where}-merged") == []
    with TactileLearner.open(tmp_path / "empty", sensor=PAD, **HOW) as learner:
        learner.merge(tmp_path / "small.stm")
        assert (learner.digest(), correction(learner)) == (digest, None)
        with pytest.raises(errors.InputError, match="too few numbers of the channels"):
            learner.adapt(five())


def test_a_second_one_replaces_the_first_until_it_is_retracted(path: Path) -> None:
    with TactileLearner.open(path) as learner:
        first = learner.adapt([(name, learner.stream(readings)) for name, readings in five()])
        one = correction(learner)
        second = learner.adapt([(name, learner.stream(readings)) for name, readings in five(broken, 51)])
        two = correction(learner)
        assert (first.left_out, second.left_out) == ((), (DEAD,))  # by what the skin read, not what was corrected
        again = learner.adapt([(name, learner.stream(readings)) for name, readings in five()])
        assert (again.gains, again.offsets) == (first.gains, first.offsets)
        learner.retract(again)
        assert correction(learner) == two
        learner.retract(first)
        assert correction(learner) == two
        learner.retract(second)
        assert correction(learner) is None
        for receipt in (second, 51, Adaptation(False, "", None, (), (), (), 1.0, 1.0)):
            with pytest.raises(errors.ObservationError):
                learner.retract(receipt)
        for row in (1, 10**6):
            with pytest.raises(errors.ObservationError, match="one of another memory"):
                learner.retract(Adaptation(True, "", row, (), (), (), 1.0, 1.0))
        with pytest.raises(errors.ObservationError, match="of kind 'adapt'"):
            learner.retract(learner.memory.sequence)  # a retraction cannot be taken back
        assert one != two


def test_what_the_memory_does_not_know_even_so_is_refused_before_there_is_a_row(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with TactileLearner.open(path) as learner:
        rows, digest = learner.memory.sequence, learner.digest()
        monkeypatch.setattr(TactileLearner, "_unknown", lambda learner, touches: len(list(touches)))
        done = learner.adapt(five())
        assert (done.kept, done.sequence) == (False, None) and "5 of 5 touches are unknown even so" in done.why
        assert (learner.memory.sequence, learner.digest(), correction(learner)) == (rows, digest, None)


def test_later_and_retracted_touches_are_no_part_of_what_it_is_compared_with(path: Path) -> None:
    with TactileLearner.open(path) as learner:
        first = learner.adapt(five(), until=49)
        learner.retract(first)
        learner.retract(50)
        assert learner.adapt(five()).gains == first.gains


def test_no_more_than_some_are_kept_to_come_back_to(path: Path) -> None:
    skins = [replace(Correction.none(8), gains=np.full(8, 1 + i / 32, np.float32)) for i in range(20)]
    with TactileLearner.open(path) as learner:
        rows = [learner._ledger.adapt(skin) for skin in skins]
    with TactileLearner.open(path) as learner:
        assert list(learner.memory.corrections) == rows[-16:]
        with pytest.raises(errors.ObservationError, match="no adaptation that counts"):
            learner.retract(rows[3])
        learner.retract(rows[-1])
        assert correction(learner) == skins[-2].to_text()
    assert check_memory(path) == []


def test_a_dead_channel_is_left_out_and_one_that_always_was_is_not(path: Path, tmp_path: Path) -> None:
    with TactileLearner.open(path) as learner:
        done = learner.adapt(five(broken))
        assert (done.kept, done.left_out, done.gains[DEAD], done.offsets[DEAD]) == (True, (DEAD,), 1.0, 0.0)
        true = touch(NAMES[1], 60)
        read = learner.stream(broken(true))
        away = [np.abs(each - true.readings[:, DEAD]).mean() for each in (read.readings[:, DEAD], 0)]
        assert away[0] < 0.5 * away[1]  # what the others say of it
        assert read.mask is not None and read.mask[:, DEAD].all() and read.missing == len(read)
        stuck = broken(touch(NAMES[1], 60))
        stuck[:, DEAD] = 700  # whatever it reads from now on
        assert learner.stream(stuck) == read
        assert learner.predict(stuck) == learner.predict(read)
        assert learner.predict(read).material == NAMES[1]

    def always(stream: Stream) -> np.ndarray[Any, Any]:
        readings = stream.readings.copy()
        readings[:, DEAD] = 0
        return readings

    with TactileLearner.open(tmp_path / "dead", sensor=PAD, **HOW) as learner:
        with learner.batch():
            for name, i in [(name, i) for i in range(6) for name in NAMES]:
                learner.observe(name, always(touch(name, i)))
        done = learner.adapt(five(broken))
        assert (done.kept, done.left_out, done.gains[DEAD], done.offsets[DEAD]) == (True, (), 1.0, 0.0)


def test_a_skin_that_did_not_change_is_left_as_it_is(path: Path) -> None:
    with TactileLearner.open(path) as learner:
        rows = learner.memory.sequence
        for first in (50, 60, 70):
            done = learner.adapt(five(lambda stream: stream.readings, first))
            assert (done.kept, done.sequence, learner.memory.sequence) == (False, None, rows)
            assert "reads as it did" in done.why


def test_touches_that_it_was_made_of_can_be_learned_and_retracted(path: Path) -> None:
    with TactileLearner.open(path) as learner:
        digest = learner.digest()
        own = [learner.observe(name, readings) for name, readings in five()]  # by the changed skin, as it read
        done = learner.adapt(five())
        kept = correction(learner)
        for receipt, (name, readings) in zip(own, five(), strict=True):
            assert learner.observe(name, readings).repeated  # learned before: not once more, corrected
            assert learner.names_of(readings) == [name]
            learner.retract(receipt)
        assert (learner.digest(), correction(learner)) == (digest, kept)
        learner.retract(done)
        assert learner.adapt(five()).gains == done.gains  # they were no part of what it is compared with
        with pytest.raises(errors.InputError, match="behind `until`"):
            learner.adapt(five(), until=0)


def test_a_batch_that_is_lost_takes_it_along(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with TactileLearner.open(path) as learner:
        with pytest.raises(KeyError), learner.batch():
            learner.adapt(five())
            raise KeyError  # what came before an exception is kept
        kept = correction(learner)
        assert kept is not None
        store = learner._ledger.store
        assert store is not None

        def full(*args: Any, **kwargs: Any) -> Any:
            raise StoreError("full")

        with pytest.raises(StoreError), learner.batch():
            learner.adapt(five(broken, 51))
            assert correction(learner) != kept
            monkeypatch.setattr(store, "append", full)
            learner.observe(NAMES[0], touch(NAMES[0], 99))
        monkeypatch.undo()
        with pytest.raises(StoreError):
            monkeypatch.setattr(store, "append", full)
            learner.adapt(five(broken, 51))
        monkeypatch.undo()
    with TactileLearner.open(path) as learner:
        assert check_memory(path) == []


def test_the_touch_under_way_keeps_what_it_began_with(path: Path) -> None:
    raw = other(touch(NAMES[3], 75))
    with TactileLearner.open(path) as learner:
        before = learner.predict(raw)
        session = learner.live(contact="manual")
        session.begin()
        session.push(raw[:20])
        learner.adapt(five())
        session.push(raw[20:])
        (first,) = session.end().touches
        assert first.stream.raw is None
        session.begin()
        session.push(raw)
        (second,) = session.end().touches
        assert second.stream == learner.stream(raw)
        assert second.prediction == learner.predict(raw) == learner.predict(second.stream)
        assert first.prediction == before != second.prediction
        assert learner.observe(NAMES[3], second.stream).key == second.stream.key
        assert learner.observe(NAMES[3], raw).repeated


def test_a_beginning_keeps_what_is_guessed_of_a_lost_channel(path: Path) -> None:
    raw = broken(touch(NAMES[1], 60))
    long = np.concatenate([raw, raw])  # longer than any touch that was learned: its beginning is judged
    with TactileLearner.open(path) as learner:
        learner.adapt(five(broken))
        whole = learner.stream(raw)
        part = whole.first(0.5)
        assert part.readings[:, DEAD].tolist() == whole.readings[:25, DEAD].tolist() != [0.0] * 25
        assert part == learner.stream(raw[:25])
        assert learner.predict(long).novelty == learner.predict(learner.stream(long)).novelty
        assert learner.predict(long).material == learner.predict(raw).material


def test_what_cannot_be_adapted_is_refused_and_changes_nothing(path: Path, tmp_path: Path) -> None:
    pairs = five()
    with TactileLearner.open(path) as learner:
        rows = learner.memory.sequence
        for touches, kind, match in (
            ([], errors.InputError, "3 different touches or more"),
            (pairs[:2], errors.InputError, "3 different touches or more"),
            ([pairs[0]] * 5, errors.InputError, "3 different touches or more"),
            ([(NAMES[0], other(touch(NAMES[0], i))) for i in range(5)], errors.InputError, "2 materials or more"),
            ([*pairs, ("felt", other(touch(NAMES[0], 3)))], errors.UnknownMaterialError, "never were \\['felt'\\]"),
            ([*pairs, (NAMES[1], pairs[0][1])], errors.InputError, "one touch came as"),
            ([*pairs, (NAMES[1], pairs[0][1][:2])], errors.InputError, "three readings or more"),
            ([*pairs, (NAMES[1], np.zeros((9, 7)))], errors.ChannelCountError, "shape"),
            ([*pairs, (NAMES[1], Scene(sensor=sensors.BIOTAC).touch("bark", 0))], errors.SensorMismatchError, "pad"),
            ([*pairs, ("", pairs[0][1])], errors.MaterialError, "name"),
            (pairs[0][1], errors.InputError, "pairs of a material"),
            (7, errors.InputError, "pairs of a material"),
        ):
            with pytest.raises(kind, match=match):
                learner.adapt(touches)  # type: ignore[arg-type]
        for wrong in (-1, True, "1"):
            with pytest.raises(errors.InputError, match="until"):
                learner.adapt(pairs, until=wrong)  # type: ignore[arg-type]
        assert (learner.memory.sequence, correction(learner)) == (rows, None)
        done = learner.adapt(dict(pairs))
    with pytest.raises(errors.InputError, match=f"row {done.sequence}, of which"):
        learn([str(tmp_path)], path)
    with TactileLearner.open(path, mode="read") as learner:
        with pytest.raises(ReadOnlyError):
            learner.adapt(five(lambda stream: stream.readings))  # though it would be left as it is
        with pytest.raises(ReadOnlyError):
            learner.retract(done)
    with pytest.raises(errors.UnknownMaterialError):
        TactileLearner(sensor=PAD).adapt(pairs)
    with TactileLearner.open(tmp_path / "new", sensor=PAD, **HOW) as learner:
        for name in NAMES:
            learner.observe(name, touch(name, 0))
        with pytest.raises(errors.InputError, match="too few"):
            learner.adapt(pairs)
    with (
        TactileLearner.open(tmp_path / "eye", sensor=sensors.GELSIGHT) as learner,
        pytest.raises(errors.InputError, match="has pixels"),
    ):
        learner.adapt(pairs)


@pytest.mark.parametrize("attributes", [{}, {"correction": "AAAA"}])
def test_a_forged_row_is_refused(path: Path, attributes: dict[str, Any]) -> None:
    put_row(path, kind="adapt", label="", key=b"", attributes=attributes)
    with pytest.raises(StoreError, match="row 51"):
        TactileLearner.open(path)


def test_a_forged_checkpoint_is_refused(path: Path) -> None:
    with TactileLearner.open(path) as learner:
        learner.compact()
    attributes, arrays = checkpoint_of(path)
    for wrong in (3, [[1, "AAAA"]]):
        put_checkpoint(path, {**attributes, "corrections": wrong}, arrays, compaction=True)
        with pytest.raises(StoreError, match=r"checkpoint .* is not what is written there"):
            TactileLearner.open(path)


def test_the_command_and_the_page(path: Path, tmp_path: Path) -> None:
    for name, readings in five():
        (tmp_path / "new" / name).mkdir(parents=True)
        np.save(tmp_path / "new" / name / "touch.npy", readings)
    told = run("memory", "adapt", path, tmp_path / "new", "--label-by", "folder")
    text = " ".join(told.output.split())
    assert told.exit_code == 0 and "adapted: by row 51; later touches are read through it" in text
    with TactileLearner.open(path, mode="read") as learner:
        assert "read through the adaptation in row 51" in memory_page(learner)
    told = run("memory", "adapt", path, tmp_path / "new", "--label-by", "folder", "--json")
    assert json.loads(told.output)["sequence"] == 52
    assert run("memory", "retract", path, 52).exit_code == run("memory", "retract", path, 51).exit_code == 0
    assert "behind `until`" in refused("memory", "adapt", path, tmp_path / "new", "--label-by", "folder", "--until", 0)
    for name in NAMES:
        np.save(tmp_path / "new" / name / "touch.npy", touch(name, 50).readings)
    told = run("memory", "adapt", path, tmp_path / "new", "--label-by", "folder")
    assert told.exit_code == 1 and "not adapted" in told.output
    assert "3 different touches" in refused("memory", "adapt", path, tmp_path / "new", "--label", NAMES[0])[:400]

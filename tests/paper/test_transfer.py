"""Transfer between tasks and across sensors: what is learned, what is evaluated, what is kept, and that it can work."""

import json
from dataclasses import replace

import numpy as np
import pytest

from examples.paper.readers.labelled import Recordings
from examples.paper.readers.physiclear import HALF_SIZE
from examples.paper.runs.cells import silent
from examples.paper.transfer.aligning import Known, MapsAcross, OneReadout
from examples.paper.transfer.few_touches import (
    WidestFeatures,
    WidestReadout,
    draw_touches,
    few_touches,
)
from examples.paper.transfer.sensors import ALONE, WAYS, SensorTransfer
from examples.paper.transfer.sensors import rows as sensor_rows
from examples.paper.transfer.shared_features import SharedFeatures
from examples.paper.transfer.tasks import TRAINING, TUNED, TaskTransfer, rows
from scroll_tactile import Kernels, Vision
from scroll_tactile.errors import InputError, WeightsError
from scroll_tactile.learner import TactileLearner
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import validate

PATCH = Sensor(name="patch", channels=6, rate=50.0, low=0.0, high=255.0, unit="counts", duration=1.2)
STRIP = Sensor(name="strip", channels=9, rate=100.0, low=0.0, high=1000.0, unit="counts", duration=0.6)
CYCLES = {"slow": 2.0, "middle": 5.0, "fast": 11.0}  # a second


def touched(sensor, material, number, shift=0.0):
    """A wave of the material's own frequency under all channels, with noise; the same whatever the sensor."""
    random = np.random.default_rng([sensor.channels, [*CYCLES].index(material), number])
    i = np.arange(60)[:, None] / sensor.rate
    wave = np.sin(2 * np.pi * (CYCLES[material] * i + random.uniform(0, 1) + 0.05 * np.arange(sensor.channels)))
    half = sensor.high / 2
    return validate(half * (1 + shift + 0.5 * wave + random.normal(0, 0.03, wave.shape)), sensor)


def recorded(sensor, each=10, shift=0.0, name=None):
    names = [material for material in CYCLES for _ in range(each)]
    numbers = np.tile(np.arange(each), len(CYCLES))
    streams = [touched(sensor, material, i, shift) for material, i in zip(names, numbers.tolist(), strict=True)]
    return Recordings(name or sensor.name, sensor, streams, names, numbers, numbers % 5, ordered=True)


class TestFewTouches:
    def test_the_widest_readout_says_what_a_learner_says(self):
        vision = Vision(None, seed=1, stages=(1,))
        readout, learner = WidestReadout(WidestFeatures(PATCH, vision)), TactileLearner(sensor=PATCH, embedding=vision)
        for material in CYCLES:
            for i in range(3):
                readout.observe(material, touched(PATCH, material, i))
                learner.observe(material, touched(PATCH, material, i))
        evaluated = [touched(PATCH, material, i, 0.3) for material in CYCLES for i in range(10, 16)]
        predicted = [readout.name_of(stream) for stream in evaluated]
        assert predicted == [learner.predict(stream).material for stream in evaluated]
        assert len(set(predicted)) > 1

    def test_draws_leave_the_tested_fold_out_and_keep_a_video_together(self):
        touches = recorded(PATCH)
        videos = replace(touches, repetition=touches.repetition // 5, fold=touches.repetition // 5)
        drawn = draw_touches(videos, 1, seed=0, draw=0)
        assert {name: [len(group) for group in own] for name, own in drawn.items()} == {name: [5] for name in CYCLES}
        first, again, other = (draw_touches(touches, 2, 0, draw) for draw in (0, 0, 1))
        assert first == again != other
        assert all(touches.fold[i] != 2 for own in first.values() for group in own for i in group)
        assert [len(own) for own in first.values()] == [8, 8, 8]
        with pytest.raises(InputError, match="expected a fold of patch"):
            draw_touches(touches, 7, 0, 0)

    def test_each_count_adds_to_the_one_before(self):
        reported = []

        class Spy:
            def observe(self, material, stream):
                reported.append((material, stream.key))

            def name_of(self, stream):
                return "slow"

        touches = recorded(PATCH)
        found = few_touches(touches, 0, Spy, (0, 2, 1, 5, 50), 1, 0, silent)
        assert found == {
            "tested": 6,
            "right": {"0": [2], "1": [2], "2": [2], "5": [2]},
            "learned": {"0": 0, "1": 1, "2": 2, "5": 5},
        }
        assert len(reported) == len(set(reported)) == 15
        kept = {touches.streams[i].key for i in np.flatnonzero(touches.fold == 0)}
        assert not kept & {key for _, key in reported}


@pytest.fixture(scope="module")
def study(weights, tmp_path_factory):
    sets = (recorded(PATCH), recorded(STRIP))
    folder = tmp_path_factory.mktemp("run") / "here"
    return TaskTransfer(sets, weights, counts=(1, 4), draws=1, epochs=1, sources=("patch",), folder=folder)


@pytest.fixture(scope="module")
def results(study):
    return list(study.run())


class TestTasks:
    def test_every_embedding_is_tried_on_every_set(self, results, study):
        systems = ["kernels", "vision", TUNED + "patch"]
        assert {(cell.dataset, cell.system) for cell, _ in results} == {
            *((name, system) for name in ("patch", "strip") for system in systems),
            ("patch", TRAINING),
        }
        for cell, figures in results:
            assert figures["tested"] == 6
            if cell.system == TRAINING:
                assert (figures["learned"], figures["validation"]) == (21, 3)
                assert len(figures["losses"]) == study.epochs
        kernels = [row["points"]["4"]["mean"] for row in rows(results) if row["system"] == "kernels"]
        assert min(kernels) > 0.9
        tuned = next(row for row in rows(results) if (row["dataset"], row["tuned on"]) == ("strip", "patch"))
        plain = next(row for row in rows(results) if (row["dataset"], row["system"]) == ("strip", "vision"))
        gain = tuned["points"]["4"]["mean"] - plain["points"]["4"]["mean"]
        assert tuned["points"]["4"]["gain"] == pytest.approx(gain)
        assert plain["points"]["4"]["gain"] == 0

    def test_what_is_finished_is_not_done_again_and_what_is_lost_is_made_again(self, results, study):
        steps = []
        assert list(study.run(lambda *step: steps.append(step))) == results
        assert steps == []
        network, notes = study.folder / "tuned-on-patch-fold-0.safetensors", study.folder / "transfer-tasks.json"
        kept, held, again = network.read_bytes(), json.loads(notes.read_text()), f"strip, fold 0, {TUNED}patch"
        before = held["notes"].pop(again)
        notes.write_text(json.dumps(held))
        network.unlink()
        assert {cell.key: figures for cell, figures in replace(study).run()}[again]["right"] == before["right"]
        assert network.read_bytes() == kept
        flipped = kept[:-100] + bytes([kept[-100] ^ 1]) + kept[-99:]
        for harmed, said in ((kept[:1000], "damaged"), (flipped, "not the network that was fine-tuned on patch")):
            network.write_bytes(harmed)
            notes.write_text(json.dumps(held))
            with pytest.raises(WeightsError, match=said):
                list(replace(study).run())
        network.write_bytes(kept)
        with pytest.raises(InputError, match="another run"):
            list(replace(study, epochs=2).run())

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"sets": (recorded(PATCH, 5),)}, "two data sets or more"),
            ({"sets": (recorded(PATCH, 5), recorded(PATCH, 5))}, "of different names"),
            ({"counts": (0, 1)}, "counts of 1 touch or more"),
            ({"draws": 0}, "1 draw or more"),
            ({"folds": ()}, "one fold or more"),
            ({"seed": -1}, "a seed of 0 or more"),
            ({"rate": 0.0}, "a rate above 0"),
            ({"sources": ("patch", "felt")}, r"expected sources out of .*; came \['felt'\]"),
        ],
    )
    def test_what_cannot_be_is_refused(self, study, change, words):
        with pytest.raises(InputError, match=words):
            replace(study, **change)


def vectors(seed, each=12, shift=0.0, turn=None):
    """Features of three materials around means of their own, as (streams to features, materials)."""
    random = np.random.default_rng(seed)
    means = np.random.default_rng(9).normal(0, 3, (3, 8))
    found = np.concatenate([mean + random.normal(0, 0.5, (each, 8)) for mean in means])
    return (found if turn is None else found @ turn) + shift, [name for name in CYCLES for _ in range(each)]


class TestAligning:
    """On features that are made up: streams stand only for their places."""

    @pytest.fixture
    def streams(self):
        return [touched(PATCH, name, i) for name in CYCLES for i in range(12)]

    def share(self, candidate, streams, trained, names):
        for i in trained:
            candidate.observe(names[i], streams[i])
        evaluated = [i for i in range(len(streams)) if i not in trained]
        return np.mean([candidate.name_of(streams[i]) == names[i] for i in evaluated])

    def features(self, streams, found):
        return {stream.key: row for stream, row in zip(streams, found, strict=True)}

    def known(self, streams, **kind):
        found, names = vectors(1, **kind)
        return Known(found, names)

    def test_a_shifted_sensor_is_read_where_its_own_touches_standardise(self, streams):
        found, names = vectors(2, shift=40.0)
        made = self.features(streams, found)
        known = self.known(streams)

        def read(stream):
            return made[stream.key]

        assert self.share(OneReadout(read, known, unlabelled=found), streams, [], names) > 0.9
        assert self.share(OneReadout(read, known, as_it_is=True), streams, [], names) < 0.6
        assert self.share(OneReadout(read, known), streams, [0, 12, 24], names) > 0.9
        assert self.share(OneReadout(read, known, apart=True), streams, [0, 12, 24], names) > 0.9

    @pytest.mark.parametrize("turned", [True, False])
    def test_a_turned_sensor_is_read_through_a_map(self, streams, turned):
        turn = np.linalg.qr(np.random.default_rng(4).normal(size=(8, 8)))[0]
        found, names = vectors(2, turn=turn)
        made = self.features(streams, found)
        known = self.known(streams)
        mapped = MapsAcross(lambda stream: made[stream.key], known, turned=turned)
        assert self.share(mapped, streams, [0, 1, 12, 13, 24, 25], names) > 0.9
        assert self.share(OneReadout(lambda s: made[s.key], known, unlabelled=found), streams, [], names) < 0.9

    def test_before_anything_was_learned_it_is_an_error(self, streams):
        found, _ = vectors(2)
        made = self.features(streams, found)
        for candidate in (
            OneReadout(lambda s: made[s.key], None),
            MapsAcross(lambda s: made[s.key], self.known(streams), turned=False),
        ):
            with pytest.raises(InputError, match="Call observe first"):
                candidate.name_of(streams[0])


@pytest.fixture(scope="module")
def pair():
    return recorded(PATCH), recorded(STRIP, shift=0.2)


class TestSensors:
    def test_features_that_do_not_know_the_sensor(self, pair):
        shared = SharedFeatures((PATCH, STRIP))
        assert (shared.rate, shared.columns) == (50.0, 30)
        item, other = (shared.spectra(recordings.streams[0]) for recordings in pair)
        assert item.shape == other.shape
        assert np.isfinite([item, other]).all()
        moved = validate(pair[0].streams[0].readings[:, ::-1], PATCH)
        assert shared.spectra(moved) == pytest.approx(item)
        short = pair[1].streams[0].first(0.2)
        assert np.isfinite(shared.spectra(short)).all()
        assert shared.resampled(Kernels(dimension=64))(pair[1].streams[0]).shape == (64,)
        with pytest.raises(InputError, match="sensors with channels"):
            SharedFeatures((PATCH, HALF_SIZE))

    def test_materials_that_feel_alike_to_both_are_known_without_a_touch(self, pair, tmp_path):
        study = SensorTransfer(pair, draws=1, counts=(0, 1, 2), folder=tmp_path / "run")
        results = list(study.run())
        found = sensor_rows(results)
        assert {(row["direction"], row["way"]) for row in found} == {
            (direction, way) for direction in ("patch → strip", "strip → patch") for way in WAYS
        }
        shares = {(row["direction"], row["way"]): row["points"] for row in found}
        for direction in ("patch → strip", "strip → patch"):
            assert shares[direction, "standardised"]["0"]["mean"] > 0.6
            assert shares[direction, "together"]["2"]["mean"] > 0.6
            assert shares[direction, ALONE]["2"]["gain"] == 0
            assert [*shares[direction, "scatter"]] == ["1", "2"]
            assert shares[direction, "standardised"]["0"]["gain"] is None
        agreement = study.agreement()
        assert all(-1 <= item["correlation"] <= 1 and item["chance"] > 0 for item in agreement.values())
        steps = []
        assert list(study.run(lambda *step: steps.append(step))) == results
        assert steps == []

    def test_what_cannot_be_is_refused(self, pair):
        item, other = pair
        with pytest.raises(InputError, match="touched the same materials"):
            SensorTransfer((item, item))
        with pytest.raises(InputError, match="2 of them the same"):
            SensorTransfer((item, replace(other, materials=["new" if m == "fast" else m for m in other.materials])))
        for change in ({"ways": ("magic",)}, {"ways": ()}, {"counts": (-1,)}, {"draws": 0}, {"folds": ()}):
            with pytest.raises(InputError):
                SensorTransfer(pair, **change)
        with pytest.raises(InputError, match="expected a fold of patch"):
            list(SensorTransfer(pair, folds=(9,)).run())

"""The reader of fabrics under a Contactile array, and the table of what they are made of, on made-up folders."""

import logging

import numpy as np
import pytest

from examples.paper.fabric.compositions_table import read_compositions
from examples.paper.fabric.fabrics_set import load
from examples.paper.fabric.ratios import CONTACTILE_RATIOS, ratios
from scroll_tactile.errors import DatasetError, InputError
from scroll_tactile.sensors import BIOTAC, CONTACTILE
from scroll_tactile.signals.stream import validate

TABLE = "fabric,cotton,wool,polyester\nfelt,0,100,0\ndenim,98,0,2\n"


def readings(number=0, length=30):
    return np.random.default_rng(number).uniform(-5, 5, (length, 27)).astype(np.float32)


def folder_of(tmp_path, paths, table=TABLE):
    for number, path in enumerate(paths):
        file = tmp_path / path
        file.parent.mkdir(parents=True, exist_ok=True)
        np.save(file, readings(number))
    (tmp_path / "compositions.csv").write_text(table)
    return tmp_path


USUAL = [f"protocol{p}/{fabric}/{n:02d}.npy" for fabric in ("felt", "denim") for p in (1, 2) for n in range(6 // p)]


class TestTouches:
    def test_fabric_and_protocol_are_in_the_path(self, tmp_path):
        fabrics = load(folder_of(tmp_path, USUAL))
        assert (len(fabrics.recordings), fabrics.recordings.sensor) == (18, CONTACTILE)
        names = np.array(fabrics.recordings.materials)
        assert [np.count_nonzero((names == "felt") & (fabrics.protocol == p)) for p in (1, 2)] == [6, 3]
        assert fabrics.constituents == ("cotton", "wool", "polyester")
        assert fabrics.compositions["denim"] == {"cotton": 0.98, "wool": 0.0, "polyester": 0.02}
        first = fabrics.recordings.streams[names.tolist().index("denim")].readings
        assert np.array_equal(first, readings(USUAL.index("protocol1/denim/00.npy")))

    @pytest.mark.parametrize(
        "form",
        [
            "data/ROBOT/{fabric}/{n}.npy",
            "{fabric}/protocol_{p}/{n}.npy",
            "{fabric}_p{p}_{n}.npy",
            "deep/er/{fabric}/Protocol {p}/run_{n}.npy",
        ],
    )
    def test_paths_may_be_written_otherwise(self, tmp_path, form):
        paths = [form.format(fabric=fabric, p=p, n=n) for fabric in ("felt", "denim") for p in (1, 2) for n in (10, 9)]
        if "ROBOT" in form:
            paths = [path.replace("ROBOT", word) for path in set(paths) for word in ("robot", "Hand")]
        fabrics = load(folder_of(tmp_path, paths))
        assert fabrics.protocol.tolist() == [1, 1, 2, 2] * 2
        assert fabrics.recordings.materials == ["denim"] * 4 + ["felt"] * 4
        assert fabrics.recordings.repetition.tolist() == [0, 1] * 4

    def test_a_pattern_of_ones_own(self, tmp_path):
        paths = [f"x{p}-{name}-{n}.npy" for name in ("felt", "denim") for p in (1, 2) for n in (0, 1)]
        folder = folder_of(tmp_path, paths)
        with pytest.raises(DatasetError, match=r"say fabric and protocol, such as protocol1"):
            load(folder)
        assert len(load(folder, pattern=r"x(?P<protocol>\d)-(?P<fabric>\w+)-\d+").recordings) == 8
        for wrong in ("(", r"(?P<fabric>\w+)"):
            with pytest.raises(InputError, match=r"pattern|expression"):
                load(folder, pattern=wrong)
        with pytest.raises(DatasetError, match="protocol 1"):
            load(folder, pattern=r"x\d-(?P<fabric>\w+)-(?P<protocol>\w)")

    @pytest.mark.parametrize(
        "layout", ["time", "channels", "pillars", "csv", "csv of channels", "csv with names and time"]
    )
    def test_arrays_may_lie_in_several_ways(self, tmp_path, layout):
        folder = folder_of(tmp_path, ["p1/denim/0.npy", "p2/denim/0.npy", "p2/felt/0.npy"])
        wanted, place = readings(7).round(3), folder / "p1" / "felt"
        place.mkdir()
        if "csv" not in layout:
            shaped = {"time": wanted, "channels": wanted.T, "pillars": wanted.reshape(-1, 9, 3)}[layout]
            np.save(place / "0.npy", shaped)
        else:
            rows = wanted.T if "of channels" in layout else wanted
            lines = [",".join(f"{value:.3f}" for value in row) for row in rows]
            if "time" in layout:
                lines = [
                    "time," + ",".join(f"c{n}" for n in range(27)),
                    *(f"{n},{item}" for n, item in enumerate(lines)),
                ]
            (place / "0.csv").write_text("\n".join(lines) + "\n")
        streams = load(folder).recordings.streams
        assert np.allclose(streams[2].readings, wanted, atol=1e-6)

    def test_folds_are_dealt_within_fabric_and_protocol_and_seeded(self, tmp_path):
        folder = folder_of(tmp_path, [f"p1/{name}/{n}.npy" for name in ("felt", "denim") for n in range(10)])
        ours, again, others = (load(folder, seed).recordings.fold for seed in (1, 1, 2))
        assert np.array_equal(ours, again) and not np.array_equal(ours, others)
        assert np.bincount(ours[:10]).tolist() == [2] * 5

    @pytest.mark.parametrize(
        ("spoil", "message"),
        [
            (lambda file: np.save(file, np.zeros((599, 26))), r"shape \(T, 27\).*\(599, 26\)"),
            (lambda file: np.save(file, np.zeros((27, 27))), r"\(27, 27\)"),
            (lambda file: np.save(file, np.full((30, 27), np.nan)), "no sound readings"),
            (lambda file: np.save(file, np.zeros((1, 27))), "no sound readings"),
            (lambda file: np.save(file, np.array(["a"])), "shape"),
            (lambda file: file.write_bytes(file.read_bytes()[:50]), "may be damaged"),
            (lambda file: file.write_bytes(b""), "may be damaged"),
            (lambda file: file.with_suffix(".csv").write_text("1,2\n3\n"), "cannot be read|damaged|shape"),
            (lambda file: file.with_suffix(".csv").write_text("a,b\nc,d\n"), "cannot be read|damaged|shape"),
        ],
    )
    def test_a_spoilt_file_is_named(self, tmp_path, spoil, message):
        folder = folder_of(tmp_path, USUAL)
        spoil(folder / USUAL[3])
        with pytest.raises(DatasetError, match=message) as caught:
            load(folder)
        assert USUAL[3].removesuffix("npy") in str(caught.value).replace("\\", "/")

    def test_the_range_is_looked_at(self, tmp_path, caplog):
        folder = folder_of(tmp_path, USUAL)
        with pytest.raises(DatasetError, match=r"from -1 to 1 N.*reach from -[45].*Give the limits"):
            load(folder, limits=(-1, 1))
        with caplog.at_level(logging.WARNING):
            load(folder)
            assert not caplog.text
            assert load(folder, limits=(-1000, 1000)).recordings.sensor.high == 1000
        assert "give the true limits" in caplog.text
        for wrong in ((1, -1), (0.0, float("nan"))):
            with pytest.raises(InputError, match="limits"):
                load(folder, limits=wrong)

    def test_what_is_missing_is_named(self, tmp_path):
        with pytest.raises(DatasetError, match=r"there is none.*protocol1/FABRIC"):
            load(tmp_path / "nothing")
        folder = folder_of(tmp_path, [])
        with pytest.raises(DatasetError, match="expected touches"):
            load(folder)
        folder = folder_of(tmp_path, [*USUAL, "protocol1/silk/0.npy"])
        with pytest.raises(DatasetError, match=r"composition of every fabric.*silk"):
            load(folder)
        (folder / "compositions.csv").write_text(TABLE + "silk,0,0,100\nlace,100,0,0\n")
        with pytest.raises(DatasetError, match=r"touches of every fabric.*lace"):
            load(folder)
        (folder / "compositions.csv").unlink()
        with pytest.raises(DatasetError, match=r"compositions\.csv; there is no such file"):
            load(folder)
        with pytest.raises(InputError, match="seed"):
            load(folder, -1)


class TestCompositions:
    def read(self, tmp_path, text, constituents=None):
        file = tmp_path / "compositions.csv"
        file.write_text(text, encoding="utf-8")
        return read_compositions(file, constituents)

    def test_percent_and_parts_of_one_say_the_same(self, tmp_path):
        parts = self.read(tmp_path, "fabric,cotton,wool\nfelt,0.25,0.75\nsilk,0,1\n")
        assert parts == self.read(tmp_path, "\ufefffabric, cotton ,wool\nfelt,25 %,75\n\nsilk,0,100\n")
        assert parts["silk"] == {"cotton": 0.0, "wool": 1.0}

    def test_an_empty_cell_is_unknown_and_a_zero_is_not(self, tmp_path):
        read = self.read(tmp_path, "fabric,cotton,wool,silk\na,50,,0\nb,,,\nc,50,50\n")
        assert read == {
            "a": {"cotton": 0.5, "wool": None, "silk": 0.0},
            "b": {"cotton": None, "wool": None, "silk": None},
            "c": {"cotton": 0.5, "wool": 0.5, "silk": None},
        }

    def test_what_was_rounded_is_made_to_sum_to_one(self, tmp_path):
        read = self.read(tmp_path, "fabric,a,b,c\nx,33,33,33\ny,33.4,33.3,33.4\nz,60,41,\n")
        for shares in read.values():
            assert sum(share for share in shares.values() if share is not None) == pytest.approx(1, abs=1e-12)

    def test_columns_can_be_chosen(self, tmp_path):
        text = "fabric,maker,cotton,wool\nfelt,x,0,100\n"
        with pytest.raises(DatasetError, match=r"'maker' in line 2.*naming those that are"):
            self.read(tmp_path, text)
        assert self.read(tmp_path, text, ["wool", "cotton"]) == {"felt": {"cotton": 0.0, "wool": 1.0}}
        with pytest.raises(DatasetError, match=r"out of the columns.*silk"):
            self.read(tmp_path, text, ["silk"])

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("", "empty"),
            ("fabric\nfelt\n", "expected constituents"),
            ("fabric,a,a\nfelt,50,50\n", "different names"),
            ("fabric,a,\nfelt,50,50\n", "different names"),
            ("fabric,a,b\n", "a material or more"),
            ("fabric,a,b\nx,50,40\n", r"'x' in line 2 .* sum to 100; they sum to 90"),
            ("fabric,a,b\nx,0.5,0.4\n", "sum to 1; they sum to 0.9"),
            ("fabric,a,b\nx,0,0\n", "sum to 1; they sum to 0"),
            ("fabric,a,b,c\nx,70,40,\n", "sum to 100 at most; they sum to 110"),
            ("fabric,a,b\nx,-10,110\n", "a share of 'a' in line 2"),
            ("fabric,a,b\nx,nan,100\n", "a share of 'a'"),
            ("fabric,a,b\nx,yes,no\n", "came 'yes'"),
            ("fabric,a,b\nx,1,0\nx,0,1\n", "describes 'x' twice, in lines 2 and 3"),
            ("fabric,a,b\n,1,0\n", "a name in line 2"),
            ("fabric,a,b\nx,1,0,0\n", "at most 3 cells in line 2"),
        ],
    )
    def test_what_is_no_composition_is_named_with_its_line(self, tmp_path, text, message):
        with pytest.raises(DatasetError, match=message) as caught:
            self.read(tmp_path, text)
        assert str(tmp_path / "compositions.csv") in str(caught.value)


class TestRatios:
    def touch(self, force=1.0, angle=0.0):
        """A drag of friction 0.4 over a relief, each pillar a little later."""
        time, pillar = np.arange(300)[:, None] / 100, np.arange(9)
        load = force * (1 + 0.3 * np.sin(2 * np.pi * (6 * time - 0.1 * pillar)))
        forces = np.stack([-0.4 * load * np.cos(angle), -0.4 * load * np.sin(angle), load], axis=2)
        return validate(forces.reshape(300, 27), CONTACTILE)

    def test_force_and_way_leave_no_trace_and_friction_does(self):
        usual = ratios(self.touch())
        assert (usual.sensor, usual.readings.shape) == (CONTACTILE_RATIOS, (300, 27))
        for other in (self.touch(force=3.0), self.touch(angle=2.0), self.touch(force=0.5, angle=-1.0)):
            assert np.allclose(ratios(other).readings, usual.readings, atol=1e-4)
        pillars = usual.readings.reshape(300, 9, 3)
        assert np.allclose(pillars[..., 0], 0.4, atol=1e-4)
        assert np.allclose(pillars[..., 1], 0, atol=1e-4)
        assert pillars[100:200, :, 2].std() == pytest.approx(0.3 / np.sqrt(2), rel=0.1)

    def test_no_touch_has_ratios_too_and_another_sensor_has_none(self):
        assert np.isfinite(ratios(validate(np.zeros((50, 27)), CONTACTILE)).readings).all()
        with pytest.raises(InputError, match="27 channels"):
            ratios(validate(np.zeros((50, 19)), BIOTAC))

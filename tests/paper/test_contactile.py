"""The paper's third task on a few simulated fabrics: every row runs, from files to figures, and goes on when killed."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from commands import refused, run

from examples.paper.fabric.contactile_rows import EPOCHAL, OURS, PAPER, ROWS
from examples.paper.fabric.contactile_study import HAND, Contactile, rows, simulated
from examples.paper.fabric.simulated import FabricScene
from examples.paper.readers.labelled import Recordings
from examples.paper.systems.constituent_nets import presence_loss
from examples.paper.systems.constituent_squares import Heads, Shares
from scroll_tactile.errors import InputError
from scroll_tactile.sensors import BIOTAC
from scroll_tactile.simulation.scene import Scene

SMALL: dict[str, Any] = {"epochs": 1, "biotac_epochs": 1, "every": 24}


@pytest.fixture(scope="module")
def fabrics():
    return simulated(seed=0, count=5, robot=5, hand=1)


@pytest.fixture(scope="module")
def biotac():
    """Two materials under a BioTac, six touches each, short ones."""
    scene = Scene(BIOTAC)
    names = [name for name in ("felt", "denim") for _ in range(6)]
    number = np.tile(np.arange(6), 2)
    streams = [scene.touch(name, i, seconds=1) for name, i in zip(names, number.tolist(), strict=True)]
    return Recordings("BioTac-20", BIOTAC, streams, names, number, number % 3, ordered=True)


@pytest.fixture(scope="module")
def whole(fabrics, biotac, weights, tmp_path_factory):
    """All rows, tested on the hand, and the study that measured them."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    study = Contactile(fabrics, tuple(ROWS), weights, biotac, **SMALL, folder=folder)
    return study, list(study.run(["hand"]))


class TestRows:
    def test_every_row_has_its_figures(self, whole):
        study, results = whole
        assert [cell.system for cell, _ in results] == list(ROWS)
        for cell, figures in results:
            assert (cell.dataset, figures["learned"] + figures["validation"], figures["tested"]) == (HAND, 25, 5)
            assert set(figures["constituents"]) == set(study.scored)
            assert 0 <= figures["exact"] <= figures["score"] <= 1
            assert 0 <= figures["share_error"] <= 1 and 0 <= figures["calibration_error"] <= 1
            assert ("inferred" in figures) == (cell.system in OURS)
            assert ("accuracy on BioTac" in figures) == ("biotac" in cell.system)
            assert ("epochs" in figures) == (cell.system in EPOCHAL[1:])
        found = {row["key"]: row for row in rows(results)}
        assert found["resnet"]["paper"] == PAPER["resnet"] == 0.763
        here = found["resnet"]["parts"][HAND]["score"]
        assert found["resnet"]["difference"] == pytest.approx(here - 0.763)
        assert found["kernels"]["paper"] is found["kernels"]["difference"] is None

    def test_what_a_robot_touched_is_known_when_it_is_touched_again(self, fabrics):
        (_, figures), *_ = Contactile(fabrics, ("kernels",)).run(["held-out"])
        assert figures["tested"] == 5
        assert figures["score"] == figures["fabric"] == 1
        assert figures["share_error"] < 0.02

    def test_the_network_of_biotac_is_trained_once_and_a_spoilt_file_is_named(self, whole, fabrics, biotac, weights):
        study, results = whole
        assert study.folder is not None
        again = Contactile(fabrics, ("least-squares-biotac",), weights, biotac, **SMALL, folder=study.folder)
        reported = []
        notes = json.loads((study.folder / "contactile.json").read_text())
        first = notes["notes"].pop(results[1][0].key)
        (study.folder / "contactile.json").write_text(json.dumps(notes))
        (_, figures), *_ = again.run(["hand"], lambda what, done, of: reported.append(what))
        assert figures | {"seconds": 0} == first | {"seconds": 0}
        assert not any("training" in what for what in reported)
        (study.folder / "biotac.npz").write_bytes(b"half")
        notes["notes"].pop(results[1][0].key, None)
        (study.folder / "contactile.json").write_text(json.dumps(notes))
        with pytest.raises(InputError, match=r"biotac\.npz.*trained again"):
            list(Contactile(fabrics, again.rows, weights, biotac, **SMALL, folder=study.folder).run(["hand"]))


class TestWhatIsUnknown:
    def test_it_is_neither_learned_as_absent_nor_scored(self, fabrics):
        known = {name: dict(shares) for name, shares in fabrics.compositions.items()}
        known["fabric03"] = dict.fromkeys(known["fabric03"])
        some = replace(fabrics, compositions=known)
        study = Contactile(some, ("kernels",))
        assert {name for name, _ in study.split(HAND).test} == set(known) - {"fabric03"}
        assert "fabric03" in study.split(HAND).materials
        (_, figures), *_ = study.run(["held-out"])
        assert figures["tested"] == 4 and figures["score"] == 1

    def test_a_constituent_that_all_or_none_have_is_not_scored(self, fabrics):
        all_have = {
            name: {"cotton": 0.5, **{k: v / 2 for k, v in shares.items() if k != "cotton"}, "x": 0.0}
            for name, shares in fabrics.compositions.items()
        }
        study = Contactile(replace(fabrics, compositions=all_have), ("kernels",))
        assert not {"cotton", "x"} & set(study.scored) and study.scored
        same = {name: {"cotton": 1.0} for name in fabrics.compositions}
        with pytest.raises(InputError, match="some fabrics have and others have not"):
            Contactile(replace(fabrics, compositions=same), ("kernels",))

    def test_heads_are_of_the_touches_that_are_known(self):
        rng = np.random.default_rng(0)
        features = rng.standard_normal((60, 5))
        there = features[:, 0] > 0
        names = ["yes" if fraction else "no" for fraction in there]
        names[:20] = ["what"] * 20
        shares = Shares(("a", "b"), {"yes": {"a": 1, "b": 0}, "no": {"a": 0, "b": 1}, "what": {"a": None, "b": None}})
        reported = Heads(features[:50], features[50:], shares, names[:50], names[50:])(features)
        assert ((reported.presence[:, 0] > 0.5) == there)[20:].mean() > 0.9
        assert np.allclose(reported.share.sum(axis=1), 1)
        nothing = Shares(("a", "b"), {name: {"a": 1.0 * (name == "yes"), "b": None} for name in ("yes", "no", "what")})
        reported = Heads(features[:50], features[50:], nothing, names[:50], names[50:])(features)
        assert np.isnan(reported.presence[:, 1]).all() and np.isfinite(reported.presence[:, 0]).all()

    def test_the_loss_leaves_out_what_is_unknown(self):
        logits = torch.tensor([[2.0, -1.0], [0.5, 3.0]], requires_grad=True)
        targets = torch.tensor([[1.0, float("nan")], [0.0, float("nan")]])
        loss = presence_loss(logits, targets)
        wanted = torch.nn.functional.binary_cross_entropy_with_logits(logits[:, 0], targets[:, 0])
        assert torch.allclose(loss, wanted)
        loss.backward()
        assert logits.grad is not None and logits.grad[:, 1].abs().max() == 0 < logits.grad[:, 0].abs().min()
        assert float(presence_loss(logits.detach(), torch.full((2, 2), float("nan")))) == 0


class TestRefusals:
    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"rows": ("svm",)}, "expected rows"),
            ({"rows": ()}, "expected rows"),
            ({"rows": ("least-squares",)}, "need the weights"),
            ({"rows": ("resnet-biotac",), "weights": "resnet18"}, "need recordings of BioTac-20"),
            ({"every": 0}, "every and take"),
            ({"take": 0}, "every and take"),
            ({"epochs": 0}, "epochs"),
            ({"device": "abacus"}, "a device"),
        ],
    )
    def test_settings_that_cannot_be(self, fabrics, settings, message):
        with pytest.raises(InputError, match=message):
            Contactile(fabrics, **({"rows": ("kernels",)} | settings))
        with pytest.raises(InputError, match=r"protocols 1 and 2; came \[1\]"):
            Contactile(replace(fabrics, protocol=np.ones_like(fabrics.protocol)), ("kernels",))


class TestCommand:
    def test_it_reports_writes_and_resumes(self, tmp_path):
        words = ["fabric", "contactile", "--simulated", "--size", "5,6,2", "--rows", "resnet,kernels", "--epochs", "1"]
        words += ["--every", "24", "--run", tmp_path / "run", "--json", tmp_path / "out.json"]
        reported = run(*words)
        assert reported.exit_code == 0, reported.output
        assert "simulated fabrics, protocol 1 → 2" in reported.output and "76.3 %" in reported.output
        assert "of real fabrics" in reported.output and "1 epochs (the paper has 50)" in reported.output
        result = json.loads((tmp_path / "out.json").read_text())
        assert result["simulated"] is True and len(result["cells"]) == 4
        assert "--parts hand,held-out --simulated --size 5,6,2" in result["command"]
        again = run(*words)
        assert again.exit_code == 0
        assert json.loads((tmp_path / "out.json").read_text())["cells"] == result["cells"]
        assert "another run" in refused(*words, "--epochs", "2")

    def test_a_published_set_is_read_from_its_folder(self, tmp_path):
        FabricScene(count=4).write(tmp_path / "set", robot=5, hand=1)
        words = ["fabric", "contactile", "--data", tmp_path / "set", "--rows", "ratios", "--parts", "hand"]
        reported = run(*words, "--limits=-2,2")
        assert reported.exit_code == 0, reported.output
        assert "set, protocol 1 → 2" in reported.output and "of real fabrics" not in reported.output
        assert "Give the limits" in refused(*words, "--limits=-0.1,0.1")
        (tmp_path / "set" / "compositions.csv").write_text("fabric,cotton,linen\nfabric01,0,90\n")
        assert "sum to 100; they sum to 90" in refused(*words)

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            ([], "--simulated, and not both"),
            (["--simulated", "--data", "x"], "--simulated, and not both"),
            (["--simulated", "--rows", "svm"], "expected --rows out of"),
            (["--simulated", "--rows", "least-squares"], "need --weights"),
            (["--simulated", "--rows", "resnet-biotac", "--weights", "resnet18"], "need --biotac"),
            (["--simulated", "--rows", "kernels", "--size", "3,4"], "three whole numbers"),
            (["--data", "x", "--rows", "kernels", "--limits", "a,b"], "two numbers"),
            (["--data", "nowhere", "--rows", "kernels"], "there is none"),
        ],
    )
    def test_what_cannot_be_is_one_red_line(self, words, message):
        assert message in refused("fabric", "contactile", *words)

"""Systems and embeddings of one's own, by module:factory, in the protocol of all others."""

from pathlib import Path

import pytest
from paper_touches import recorded

from examples.paper.studies.table1 import Table1
from examples.paper.systems.catalogue import Catalogue
from examples.paper.systems.one_pass import OnePass
from examples.paper.systems.own import is_own, require_own
from examples.paper.systems.system_protocol import System
from scroll_tactile.errors import InputError


class Wrong:
    """What a factory of one's own may make by mistake."""

    def __init__(self, needed: int = 0) -> None:
        self.needed = needed


def needs(argument: int) -> Wrong:
    return Wrong(argument)


class TestOnesOwn:
    def test_a_system_and_an_embedding_are_made_by_name(self):
        catalogue = Catalogue()
        system = catalogue.make("examples.own_system:NearestMean")
        assert (system.name, isinstance(system, System)) == ("nearest mean", True)
        assert catalogue.make("examples.own_system:NearestMean") is not system  # each fold has a new one
        for readout in ("lda", "ridge"):
            assert isinstance(catalogue.make(f"examples.own_system:Strengths-{readout}"), OnePass)

    @pytest.mark.parametrize(
        ("key", "message"),
        [
            ("nowhere.at_all:make", "module nowhere.at_all cannot be imported from here: No module named 'nowhere'"),
            ("examples.own_system:Missing", "examples.own_system has no Missing"),
            ("examples.own_system:__doc__", "a class or a function to call; it is of type str"),
            (f"{__name__}:needs", "called without arguments"),
            (f"{__name__}:Wrong", "to make a system.*it makes of type Wrong"),
            ("examples.own_system:Strengths", "to make a system.*it makes of type Strengths"),
            ("examples.own_system:NearestMean-lda", "to make an embedding.*it makes of type NearestMean"),
        ],
    )
    def test_what_is_none_is_named(self, key: str, message: str):
        assert is_own(key)
        with pytest.raises(InputError, match=message):
            require_own(key)

    def test_a_run_is_not_resumed_with_another_file(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.syspath_prepend(tmp_path)
        file = tmp_path / "mine_alone.py"
        file.write_text("from examples.own_system import NearestMean\n")
        study = Table1([recorded()], ("mine_alone:NearestMean",), folder=tmp_path / "run")
        ((_, first),) = study.run({"RoboSkin-20": [0]})
        assert [figures for _, figures in study.run({"RoboSkin-20": [0]})] == [first]
        file.write_text("from examples.own_system import NearestMean  # changed\n")
        with pytest.raises(InputError, match="its file has changed"):
            list(study.run({"RoboSkin-20": [0]}))

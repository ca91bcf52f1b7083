"""README's tables of compositions say what the results say."""

import pytest

from examples.paper.tables.tables_composition import attributes, letters


def mean(value, **spread):
    return {"mean": value} | spread


def test_letters_known_and_never_touched():
    known = {"score": mean(0.94, sd=0.011), "accuracy": mean(0.8432, sd=0.02), "untold": mean(0.9, sd=0.0)}
    new = {"score": mean(0.771, sd=0.03), "accuracy": mean(0.0, sd=0.0)}
    told = letters({"fabric-letters": {"means": {"known": known, "never touched": new}}}.__getitem__).splitlines()
    assert told[0] == "| Braille letters, percent | known letters | letters never touched |"
    assert told[2] == "| mean score per dot | 94.0 ± 1.1 | 77.1 ± 3.0 |"
    assert told[4] == "| letter right, of 27 | 84.3 ± 2.0 | |"
    assert {line.count("|") for line in told} == {4}


def test_attributes_of_each_set():
    ways = {way: mean(at / 10, error=0.05) for at, way in enumerate(("ours", "untold", "trees", "always"), 4)}
    told = attributes({"fabric-attributes": {"sets": {"biotac-20": {"means": {"roughness": ways}}}}}.__getitem__)
    *_, row = told.splitlines()
    assert row == "| BioTac-20, roughness | 40.0 ± 5.0 | 50.0 ± 5.0 | 60.0 ± 5.0 | 70.0 ± 5.0 |"


def test_a_result_that_lacks_its_means_is_a_key_error():
    with pytest.raises(KeyError):
        letters(lambda name: {})

"""The compiled kernels count what numpy counts, and read and write nothing outside of what they are given."""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from images import image

from scroll_tactile import Kernels, native
from scroll_tactile.embeddings import convolution
from scroll_tactile.embeddings.convolution import (
    GROUP,
    LEVELS,
    MOST_CHANNELS,
    ROUND,
    Bank,
    CountRequest,
    bank,
    competing_groups,
    count_by_c,
    count_by_numpy,
)
from scroll_tactile.matching.kept_arrays import mean_distances
from scroll_tactile.matching.likelihood import CLEAN, Table
from scroll_tactile.signals.levels import MISSING

SOURCES = Path(native.__file__).parent
compiled = pytest.mark.skipif(not native.available, reason=f"the compiled kernels are not at work: {native.reason}")


def both(monkeypatch, give):
    """What `give` gives with the compiled kernels, and without."""
    with_c = give()
    with monkeypatch.context() as without:
        without.setattr(native, "available", False)
        return with_c, give()


def same(one, other):
    windows, competing = ({w: rows.tobytes() for w, rows in features.items()} for features, _ in (one, other))
    return windows == competing and one[1].tobytes() == other[1].tobytes()


@compiled
@settings(max_examples=80, deadline=None)
@given(data=st.data())
def test_any_bank_counts_as_by_numpy(data):
    channels, dilation = data.draw(st.integers(1, 120)), data.draw(st.sampled_from([1, 2, 4, 8, 16, 32, 64, 128]))
    places = data.draw(st.integers(1, 1500 - 8 * dilation))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    kernels = data.draw(st.integers(8, 2 * ROUND))
    summed = (rng.random((2 * ROUND, channels)) < rng.random((2 * ROUND, 1))).astype(np.float32)
    summed[:, 0], summed[:, MOST_CHANNELS:] = 1, 0
    thresholds = rng.integers(-3000, 3000, (3, kernels)).astype(np.float32) + np.float32(0.5)
    rows = np.concatenate([rng.permutation(ROUND), ROUND + rng.permutation(ROUND)])[:kernels]
    own = Bank(dilation, summed, rows, thresholds)
    firsts = data.draw(st.lists(st.integers(0, places - 1), min_size=1, max_size=20))
    windows = tuple((first, data.draw(st.integers(first + 1, places))) for first in firsts)
    groups = competing_groups(own, data.draw(st.integers(1, 2 * kernels // GROUP)))
    request = CountRequest(
        own, data.draw(st.integers(0, 3 * kernels)), windows, data.draw(st.sampled_from([None, groups]))
    )
    levels = rng.integers(-LEVELS, LEVELS + 1, (channels, places + 8 * dilation)).astype(np.float32)
    if data.draw(st.booleans()):
        levels = np.asfortranarray(levels)  # as those of a stretched image come
    (by_c,), (by_numpy,) = count_by_c(levels, [request]), count_by_numpy(levels, [request])
    np.testing.assert_array_equal(by_c.features, by_numpy.features)
    np.testing.assert_array_equal(by_c.competing, by_numpy.competing)


@compiled
def test_levels_out_of_range_are_counted_by_numpy():
    """An image beyond ±1 has levels that int16 may not hold."""
    loud = 40 * image(3, 60)
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert same(*both(monkeypatch, lambda: Kernels(dimension=64).embed_competing(loud, {30: [0]}, 60)))


@compiled
def test_a_module_that_counts_wrong_is_not_used(monkeypatch):
    right = native.count

    def wrong(*arguments):
        right(*arguments)
        arguments[-2].reshape(-1)[-1] += 1

    expected = Kernels(dimension=64).embed(image(3, 60))
    monkeypatch.setattr(native, "count", wrong)
    convolution._agrees.cache_clear()
    try:
        assert Kernels(dimension=64).embed(image(3, 60)).tobytes() == expected.tobytes()
        assert not convolution._agrees()
    finally:
        convolution._agrees.cache_clear()


def arguments():
    """Those of a sound call, by name, for an image of 3 channels and 40 readings."""
    own = bank(1, 3, 2)
    groups = competing_groups(own, 2)
    heavy, begins, channels, thresholds = convolution.compiled_bank(own)
    return {
        "readings": 40, "dilation": 2, "features": 20,
        "levels": np.zeros((3, 40), np.int16), "heavy": heavy, "begins": begins, "channels": channels,
        "thresholds": thresholds, "edges": np.int32([0, 5, 24]), "spans": np.int32([[0, 2], [1, 2]]),
        "members": groups.members, "weights": groups.weights,
        "counted": np.zeros((2, 20), np.int32), "contests": np.zeros((2, 2, 8), np.int32),
    }  # fmt: skip


def changed(array, place, value):
    other = array.copy()
    other.reshape(-1)[place] = value
    return other


BAD = {
    "readings that no kernel fits": ("readings", lambda _: 16),
    "no dilation": ("dilation", lambda _: 0),
    "a dilation that overflows": ("dilation", lambda _: 2**30),
    "more features than thresholds": ("features", lambda _: 24 * 168 + 1),
    "fewer than no features": ("features", lambda _: -1),
    "levels of another width": ("levels", lambda levels: levels[:, :39].copy()),
    "no levels": ("levels", lambda _: b""),
    "levels out of range": ("levels", lambda levels: changed(levels, -1, LEVELS + 1)),
    "half an item": ("levels", lambda _: b"abc"),
    "a tap behind the last": ("heavy", lambda heavy: changed(heavy, -1, 9)),
    "kernels without channels": ("begins", lambda begins: changed(begins, 1, 0)),
    "begins that go back": ("begins", lambda begins: changed(begins, 3, 60000)),
    "a channel that is not there": ("channels", lambda channels: changed(channels, 7, 3)),
    "fewer channels than said": ("channels", lambda channels: channels[:-1].copy()),
    "edges that go back": ("edges", lambda edges: changed(edges, 1, 25)),
    "an edge behind the places": ("edges", lambda edges: changed(edges, 2, 25)),
    "an edge before the first": ("edges", lambda edges: changed(edges, 0, -1)),
    "no edges": ("edges", lambda _: b""),
    "a span behind the segments": ("spans", lambda spans: changed(spans, 1, 3)),
    "a span that goes back": ("spans", lambda spans: changed(spans, 0, 3)),
    "a span before the first": ("spans", lambda spans: changed(spans, 0, -1)),
    "a member that is no kernel": ("members", lambda members: changed(members, 9, 168)),
    "a weight that overflows": ("weights", lambda weights: changed(weights, 0, 65)),
    "fewer weights than members": ("weights", lambda weights: weights[:1].copy()),
    "no room for counts": ("counted", lambda counted: counted[:1].copy()),
    "no room for contests": ("contests", lambda contests: contests[:1].copy()),
}


@compiled
@pytest.mark.parametrize("case", BAD)
def test_arrays_that_do_not_fit_are_refused(case):
    name, make = BAD[case]
    given = arguments()
    native.count(*given.values())
    with pytest.raises(ValueError, match="expected "):
        native.count(*(given | {name: make(given[name])}).values())


@compiled
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_touches_are_compared_as_by_numpy(data):
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    others, width = data.draw(st.integers(0, 140)), data.draw(st.integers(1, 700))
    rows = rng.choice([0, 1, 100, 254, MISSING], (others, width)).astype(np.uint8)
    guesses = rng.integers(-1024, 2041, (data.draw(st.integers(1, 5)), width)).astype(np.int16)
    known, own = rng.random(width) < 0.8, rng.integers(0, 256, width).astype(np.uint8)
    logs = rng.integers(-(2**15), 2**15, 256 * 256).astype(np.int16)
    table = Table(CLEAN, logs, 0.0, 1.0, np.zeros(255), np.zeros(255), 1.0)
    with pytest.MonkeyPatch.context() as monkeypatch:
        by_c, by_numpy = both(
            monkeypatch, lambda: (mean_distances(rows, guesses, known), table.log_likelihoods(own, rows))
        )
    assert [array.tobytes() for array in by_c] == [array.tobytes() for array in by_numpy]


ROW, LOGS = np.zeros((2, 5), np.uint8), np.zeros(65536, np.int16)
UNFIT = {
    "a table cut short": ("sum_logs", ROW[0], ROW, LOGS[:-1].copy(), np.zeros(2, np.int64)),
    "more sums than touches": ("sum_logs", ROW[0], ROW, LOGS, np.zeros(3, np.int64)),
    "touches of other values": ("sum_logs", ROW[0, :4].copy(), ROW, LOGS, np.zeros(2, np.int64)),
    "half a sum": ("sum_logs", ROW[0], ROW, LOGS, np.zeros(12, np.uint8)),
    "guesses of another width": (
        "distances", ROW, np.zeros((1, 4), np.int16), np.ones(5, bool), np.zeros(2, np.int64), np.zeros(2, np.int64),
    ),
    "a guess that overflows": (
        "distances", ROW, np.int16([[2049] * 5]), np.ones(5, bool), np.zeros(2, np.int64), np.zeros(2, np.int64),
    ),
    "more rows than there are": (
        "distances", ROW, np.zeros((1, 5), np.int16), np.ones(5, bool), np.zeros(3, np.int64), np.zeros(3, np.int64),
    ),
    "sums that are not each row's": (
        "distances", ROW, np.zeros((1, 5), np.int16), np.ones(5, bool), np.zeros(3, np.int64), np.zeros(2, np.int64),
    ),
}  # fmt: skip


@compiled
@pytest.mark.parametrize("case", UNFIT)
def test_touches_that_do_not_fit_are_refused(case):
    name, *given = UNFIT[case]
    with pytest.raises(ValueError, match="expected "):
        getattr(native, name)(*given)


SCRIPT = """
import importlib.util, sys, numpy as np
spec = importlib.util.spec_from_file_location("scroll_tactile.native._kernels", sys.argv[1])
module = importlib.util.module_from_spec(spec); spec.loader.exec_module(module)
from scroll_tactile import Kernels, native
from scroll_tactile.embeddings import convolution
native.available, native.count = True, module.count
native.sum_logs, native.distances = module.sum_logs, module.distances
rows, known = np.full((3, 300), 254, np.uint8), np.ones(300, np.bool_)
sums, seen = np.empty((3, 2), np.int64), np.empty(3, np.int64)
native.distances(rows, np.full((2, 300), -2048, np.int16), known, sums, seen)
assert (sums == 300 * (4 * 254 + 2048) ** 2).all() and (seen == 300).all()
native.sum_logs(rows[0], rows, np.full(65536, -32768, np.int16), seen)
assert (seen == -32768 * 300).all()
rng, embedding = np.random.default_rng(3), Kernels(dimension=333)
for channels, readings in ((1, 12), (3, 17), (5, 64), (40, 301), (70, 90), (2, 1100)):
    whole = rng.uniform(-1, 1, (channels, readings)).astype(np.float32)
    windows = {readings: [0], 12: [0, readings - 12], readings // 2 + 1: [readings // 3]}
    embedding.embed_competing(whole, windows, readings + 5)
assert convolution._agrees()
"""


def test_sanitizers_find_nothing(tmp_path):
    gcc = shutil.which("gcc")
    if gcc is None or sys.platform != "linux":
        pytest.skip("needs gcc on Linux")
    flags = ["-std=c99", "-O1", "-g", "-fPIC", "-shared", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    built = tmp_path / "_kernels.so"
    headers = sysconfig.get_paths()["include"]
    if not (Path(headers) / "Python.h").exists():
        pytest.skip("needs Python's headers")
    sources = [str(source) for source in sorted(SOURCES.glob("*.c"))]
    subprocess.run([gcc, *flags, "-Werror", "-Wall", "-Wextra", f"-I{headers}", *sources, "-o", str(built)], check=True)
    asan, ubsan = (
        subprocess.run(
            [gcc, f"-print-file-name=lib{kind}.so"], check=True, capture_output=True, text=True
        ).stdout.strip()
        for kind in ("asan", "ubsan")
    )
    environment = os.environ | {"LD_PRELOAD": f"{asan} {ubsan}", "ASAN_OPTIONS": "detect_leaks=0"}
    ran = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(built)], env=environment, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr[-2000:]


def test_it_can_be_turned_off():
    asked = "from scroll_tactile import native; print(native.available, native.reason)"
    environment = os.environ | {"SCROLL_TACTILE_NUMPY": "1"}
    ran = subprocess.run([sys.executable, "-c", asked], env=environment, capture_output=True, text=True, check=True)
    assert ran.stdout == "False turned off by SCROLL_TACTILE_NUMPY\n"

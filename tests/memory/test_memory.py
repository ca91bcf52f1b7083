"""A memory: what a journal row holds, and what comes back from a store."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from scroll_tactile.errors import CapacityError
from scroll_tactile.memory.rows import pack_codes, unpack_codes
from scroll_tactile.memory.state import OBSERVE, Memory
from scroll_tactile.signals.windows import Scale, WindowPlan, extent
from scroll_tactile.statistics.moments import MOST_ROWS, SecondMoment
from store import Store

DIMENSION, SCALES = 4, (6, 20)
READING = WindowPlan(SCALES)
NARROW = Scale("window", 6)

codes_of_scale = arrays_of.arrays(
    np.int32, st.tuples(st.integers(1, 9), st.integers(1, 5)), elements=st.integers(-(2**20), 2**20)
)


@settings(deadline=None)
@given(
    st.dictionaries(st.sampled_from([NARROW, Scale("window", 20), Scale("window", 400)]), codes_of_scale, min_size=1)
)
def test_packed_codes_unpack_to_the_same(codes):
    again = unpack_codes(pack_codes(codes))
    assert sorted(again) == sorted(codes)
    for scale, rows in codes.items():
        assert again[scale].dtype == np.int32
        assert again[scale].shape == rows.shape
        assert again[scale].tobytes() == np.ascontiguousarray(rows).tobytes()
        assert again[scale].flags.c_contiguous


@pytest.mark.parametrize("values", [1, 2**8, 2**8 + 1, 2**16, 2**16 + 1])
def test_any_number_of_distinct_values(values):
    codes = {NARROW: np.arange(values, dtype=np.int32).reshape(1, -1) * 15}
    assert unpack_codes(pack_codes(codes))[NARROW].tobytes() == codes[NARROW].tobytes()


def test_few_distinct_values_take_a_byte_each():
    packed = pack_codes({NARROW: np.arange(4000, dtype=np.int32).reshape(40, 100) % 200})
    assert packed["places-6"].dtype == np.uint8


def touch(seed):
    rng = np.random.default_rng(seed)
    columns = int(rng.integers(3, 60))
    codes = {
        Scale("window", scale): rng.integers(0, 2**20, size=(len(begin), DIMENSION), dtype=np.int32)
        for scale, begin in extent(columns, SCALES).items()
    }
    return "abcd"[seed % 4], rng.bytes(32), columns, codes


def filled(seeds):
    memory = Memory(DIMENSION, READING)
    for i, seed in enumerate(seeds, start=1):
        memory.add(*touch(seed), i)
    return memory


def content(memory):
    pool = [(m, k, t.sums.tobytes(), t.pairs.tobytes()) for m, k, t in memory.sample]
    return memory.statistics.digest(), pool, memory.sequence


def append(store, seed):
    material, key, columns, codes = touch(seed)
    return store.append(OBSERVE, material, key, attributes={"columns": columns}, arrays=pack_codes(codes))


@given(st.lists(st.integers(0, 30), unique=True), st.randoms(use_true_random=False))
@settings(max_examples=30, deadline=None)
def test_any_order_gives_the_same_memory(seeds, random):
    shuffled = seeds.copy()
    random.shuffle(shuffled)
    assert content(filled(seeds)) == content(filled(shuffled))


@pytest.mark.parametrize("upto", [None, 0, 1, 7, 12])
def test_a_store_gives_back_the_memory_wherever_its_generation_ends(tmp_path, upto):
    with Store.open(tmp_path / "s", identity={}) as store:
        for seed in range(12):
            append(store, seed)
        if upto is not None:
            arrays, attributes = filled(range(upto)).to_arrays()
            store.commit(arrays, upto=upto, attributes=attributes)
    with Store.open(tmp_path / "s") as store:
        memory = Memory.load(store, DIMENSION, READING)
        assert content(memory) == content(filled(range(12)))
        # And it goes on from there, with arrays of its own.
        for seed in range(12, 16):
            record = append(store, seed)
            memory.replay(store.record(record.sequence), store)
        assert content(memory) == content(filled(range(16)))
        store.commit(memory.to_arrays()[0], upto=16, attributes=memory.to_arrays()[1])
        assert content(Memory.load(store, DIMENSION, READING)) == content(memory)


def test_a_full_memory_refuses_and_stays_as_it_was():
    memory = filled(range(5))
    held = memory.statistics.second(NARROW, 0).rows
    memory.statistics._seconds[NARROW][0] = SecondMoment.of(
        memory.statistics.second(NARROW, 0).packed(), MOST_ROWS, DIMENSION
    )
    before = content(memory)
    with pytest.raises(CapacityError):
        memory.add(*touch(9), 6)
    assert content(memory) == before
    memory.statistics._seconds[NARROW][0].rows = held
    assert content(memory) == content(filled(range(5)))


def test_the_same_touch_twice_counts_twice_and_is_pooled_once():
    memory = filled([1, 1])
    assert memory.statistics.materials == {"b": 2}
    assert len(memory.sample) == 1

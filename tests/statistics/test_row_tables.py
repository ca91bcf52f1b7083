"""Rows of codes as a store keeps them."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from scroll_tactile.statistics.grid import BITS
from scroll_tactile.statistics.tables import rows_of, table_of

CODES = st.integers(-(2**BITS), 2**BITS)
FEW = st.sampled_from([-(2**BITS), -1, 0, 3, 2**BITS])


@settings(deadline=None)
@given(arrays(np.int32, array_shapes(min_dims=2, max_dims=2, min_side=0, max_side=9), elements=CODES | FEW))
def test_the_rows_come_back_and_each_value_is_there_once(rows):
    values, places = table_of(rows)
    assert values.tolist() == sorted(set(rows.ravel().tolist()))
    assert (values.dtype, places.dtype, places.shape) == (np.int32, np.int32, rows.shape[::-1])
    again = rows_of(values, places)
    assert (again.tobytes(), again.shape, again.dtype) == (rows.tobytes(), rows.shape, np.int32)
    assert again.flags.c_contiguous

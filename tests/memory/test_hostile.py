"""Rows and identities that hypothesis makes up, with right checksums; `tests/faults/hostile.py` does more of it."""

import contextlib

import numpy as np
import pytest
from forging import get_identity, log_of, observation, pack, put_row, set_identity, unpack
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from touches import OBSERVED, filled

from scroll_tactile import TactileLearner
from scroll_tactile.errors import ScrollTactileError
from scroll_tactile.memory.gate import check_memory
from store import StoreError, VersionError
from store.encoding import decode_payload, encode_payload

OURS = (ScrollTactileError, StoreError)
numbers = st.integers(-(2**70), 2**70) | st.floats() | st.booleans() | st.none()
json_values = st.recursive(
    numbers | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)
cheap = settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A memory of a few rows, and the bytes of its log and of what names it."""
    path = tmp_path_factory.mktemp("sound") / "m"
    learner, _ = filled(path, OBSERVED[:4])
    learner._ledger._saved = learner.memory.sequence  # no checkpoint
    learner.close()
    return path, {file: file.read_bytes() for file in (path / "CURRENT", log_of(path))}


def restored(sound):
    """The folder of the memory, as it was."""
    path, files = sound
    for file, data in files.items():
        file.write_bytes(data)
    return path


def received(path):
    """Read it and check it: our errors, or none; what was read."""
    with contextlib.suppress(*OURS):
        check_memory(path)
    with contextlib.suppress(*OURS), TactileLearner.open(path, mode="read") as learner:
        learner.digest()
        return learner.observations(), learner.descriptions
    return None


@cheap
@given(
    kind=st.sampled_from(["observe", "retract", "describe", "merge", "member", "x"]),
    label=st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=8),
    key=st.binary(max_size=40),
    fields=st.dictionaries(st.sampled_from(["columns", "nbytes", "sequences", "constituents", "x"]), json_values),
)
def test_rows_that_are_made_up_are_refused_by_name(sound, kind, label, key, fields):
    path = restored(sound)
    attributes, payload = observation(path)
    put_row(path, kind=kind, label=label, key=key, attributes=attributes | fields, payload=payload)
    received(path)


@cheap
@given(
    place=st.sampled_from(["sensor", "embedding", "grid", "reading", "exemplars", "recall", "views", ""]),
    data=st.data(),
)
def test_identities_that_are_made_up_are_refused_by_name(sound, place, data):
    path = restored(sound)
    identity = get_identity(path)
    part = identity.get(place)
    if isinstance(part, dict):
        part[data.draw(st.sampled_from(sorted(part)))] = data.draw(json_values)
    else:
        identity[place] = data.draw(json_values)
    set_identity(path, identity)
    received(path)


@settings(max_examples=1000, deadline=None)
@given(payload=st.binary(max_size=200), magic=st.booleans())
def test_bytes_that_are_made_up_are_no_payload(payload, magic):
    with contextlib.suppress(ValueError, VersionError):
        decode_payload(b"ARPL" + payload if magic else payload)


@settings(max_examples=1000, deadline=None)
@given(data=st.data())
def test_a_frame_of_other_bytes_is_decoded_or_refused(data):
    version, (array,) = unpack(encode_payload({"x": np.arange(2000, dtype=np.int32)}))
    frame = bytearray(array.buffer)
    for _ in range(data.draw(st.integers(1, 4))):
        frame[data.draw(st.integers(0, len(frame) - 1))] = data.draw(st.integers(0, 255))
    changed = pack([type(array)(**{**vars(array), "buffer": bytes(frame)})], version)
    with contextlib.suppress(ValueError):
        assert decode_payload(changed)["x"].shape == (2000,)

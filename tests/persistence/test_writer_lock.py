"""A writer that cannot say who it is must not keep others out."""

import os
from pathlib import Path

import pytest
from scroll_tactile_store import LockedError, Store, StoreError


def test_a_lock_whose_holder_could_not_be_noted_is_let_go(tmp_path, monkeypatch):
    Store.open(tmp_path / "memory", identity={}).close()
    folders = sorted((tmp_path / "memory").iterdir())
    real = os.open

    def full(path, *arguments, **settings):
        if Path(path).name.startswith("holder"):
            raise OSError(28, "No space left on device")
        return real(path, *arguments, **settings)

    monkeypatch.setattr(os, "open", full)
    with pytest.raises(StoreError, match="noting who holds the lock") as caught:
        Store.open(tmp_path / "memory")
    monkeypatch.undo()
    assert not isinstance(caught.value, LockedError)
    # In this same process, while the failed store's error is still held: nobody else would free the lock.
    with Store.open(tmp_path / "memory") as store, pytest.raises(LockedError, match="process"):
        store.append("observe", "wool", b"key")
        Store.open(tmp_path / "memory")
    assert sorted((tmp_path / "memory").iterdir()) == folders

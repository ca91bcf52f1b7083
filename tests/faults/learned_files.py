"""Touches as files, which a fleet learns into a memory."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from touches import stream

from faults.learners import KIT
from faults.model import Pairs, State
from scroll_tactile.clients.learning.fleet import learn
from scroll_tactile.clients.learning.sources import SourceOptions


class Here(Executor):
    """Runs each job at once, in this process."""

    def submit(self, what: Callable[..., Any], /, *words: Any, **named: Any) -> Future[Any]:
        """As `Executor.submit`."""
        future: Future[Any] = Future()
        future.set_result(what(*words, **named))
        return future


def learn_files(path: Path, state: State, touches: Pairs) -> int:
    """Have a fleet learn these touches into a memory, which nobody has open; how many came in."""
    with TemporaryDirectory() as home:
        files = []
        for number, (material, touch) in enumerate(touches):
            files.append(Path(home, f"{number:03d}", material, "touch.npy"))
            files[-1].parent.mkdir(parents=True)
            np.save(files[-1], stream(touch).astype(np.float32))
        destination = Path(home, "m")
        path.rename(destination)  # with what the run keeps beside it
        made = {"embedding": KIT.embeddings[state.embedding], "client": Here(), "add": True}
        done = learn(destination, files, SourceOptions(by="folder"), **made)
        assert not done.refused, done.refused
        destination.rename(path)
        return done.observations

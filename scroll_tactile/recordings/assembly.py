"""Blocks as readings with times: which clock to believe, the episodes, and the report of gaps and lost readings."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.errors import InputError
from scroll_tactile.recordings.blocks import Block, Source
from scroll_tactile.recordings.recording import Episode, Gap, Report, longest_step

__all__ = ["assemble", "choose", "lost"]

_Times = npt.NDArray[np.float64]


def choose(clocks: dict[str, _Times], requested: str | None) -> str | None:
    """The name of the clock to use: the one requested, or the first that runs; None where there is none.

    Raises InputError for a clock that the recording does not have.
    """
    if requested is not None:
        if requested not in clocks:
            raise InputError(
                f"expected a clock of this recording, {', '.join(clocks) or 'it has none'}; came {requested!r}"
            )
        return requested
    for name, times in clocks.items():
        if name not in {"device", "header"}:
            return name
        if len(times) and np.isfinite(times).all() and _is_running(name, times):
            return name
    return None


def _is_running(name: str, times: _Times) -> bool:
    if len(times) == 1 or name == "header":
        return bool((times != 0).all())  # a header that nobody filled in is zero
    return bool(np.ptp(times) > 0)  # a device's clock may begin at zero


def assemble(
    block: Block, clock: str | None, source: Source
) -> tuple[npt.NDArray[Any], npt.NDArray[np.float64], tuple[Episode, ...], Report]:
    """Readings, times by this clock, episodes and the report, from one block."""
    order = _order(block)
    readings = block.readings if order is None else block.readings[order]
    clocks = {name: times if order is None else times[order] for name, times in block.clocks.items()}
    counters = {name: counts if order is None else counts[order] for name, counts in block.counters.items()}
    numbers = block.episodes if order is None or block.episodes is None else block.episodes[order]
    episodes = _spans(clocks["log"], source.marks) if source.marks else _numbered(numbers, source.names)
    begins = [] if source.marks or source.continuous else [episode.begin for episode in episodes if episode.begin]
    borders = np.array(begins, np.int64)
    times = np.full(len(readings), np.nan) if clock is None else clocks[clock]
    unset = int(np.count_nonzero(clocks["header"] == 0)) if "header" in clocks else 0
    return readings, times, episodes, _report(times, clock, counters, borders, unset)


def _order(block: Block) -> npt.NDArray[np.int64] | None:
    """How to sort readings by the time they were logged, as all players do; None where they are."""
    logged = block.clocks.get("log")
    if logged is None or not (np.diff(logged) < 0).any():
        return None
    return np.argsort(logged, kind="stable")


def _numbered(numbers: npt.NDArray[np.int64] | None, names: dict[int, str]) -> tuple[Episode, ...]:
    if numbers is None or not len(numbers):
        return ()
    borders = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
    return tuple(Episode(begin, end, names.get(int(numbers[begin]))) for begin, end in itertools.pairwise(borders))


def _spans(logged: npt.NDArray[np.float64], marks: list[tuple[float, str]]) -> tuple[Episode, ...]:
    """A label holds from its message to the next; an empty one ends it, and the same again goes on with it."""
    kept: list[tuple[float, str]] = []
    for seconds, text in sorted(marks, key=lambda mark: mark[0]):
        if not kept or kept[-1][1] != text.strip():
            kept.append((seconds, text.strip()))
    begins = np.searchsorted(logged, [seconds for seconds, _ in kept])
    ends = [*begins[1:].tolist(), len(logged)]
    spans = zip(begins.tolist(), ends, kept, strict=True)
    return tuple(Episode(begin, end, text) for begin, end, (_, text) in spans if text and end > begin)


def _report(
    times: npt.NDArray[np.float64],
    clock: str | None,
    counters: dict[str, npt.NDArray[np.int64]],
    borders: npt.NDArray[np.int64],
    unset: int,
) -> Report:
    inside = np.ones(max(len(times) - 1, 0), bool)
    inside[borders[borders > 0] - 1] = False
    found = _lost(counters, borders)
    report = Report(len(times), clock, lost=None if found is None else found[0], unset=unset)
    repeated = 0 if found is None else found[1]
    steps = np.diff(times)
    if not (np.isfinite(steps) & inside).any():
        return replace(report, repeated=repeated)
    steps[~inside] = np.nan
    forward = steps[steps > 0]
    middle = float(np.median(forward)) if len(forward) else 0.0
    longest = longest_step(middle)
    regular = forward[forward <= min(longest, 2 * middle)]
    return replace(
        report,
        rate=1 / middle if middle > 0 else None,
        jitter=float(regular.std()) if len(regular) else None,
        gaps=tuple(Gap(int(i) + 1, float(steps[i])) for i in np.flatnonzero(steps > longest)),
        repeated=repeated or int(np.count_nonzero(steps == 0)),
        backward=int(np.count_nonzero(steps < 0)),
    )


def _lost(counters: dict[str, npt.NDArray[np.int64]], borders: npt.NDArray[np.int64]) -> tuple[int, int] | None:
    """Lost and repeated readings by the device's counter, or else by the recorder's, if it counts each topic alone."""
    single = {name: int(np.count_nonzero(np.diff(counts) == 1)) for name, counts in counters.items()}
    for name in ("message", "sequence"):
        if name not in counters or len(counters[name]) < 2 or 2 * single[name] < len(counters[name]) - 1:
            continue  # what seldom goes on by one is no counter
        if name == "sequence" and single["all"] > single[name]:
            continue  # it counts all topics, so that nobody knows whose messages are lost
        found = [lost(part) for part in np.split(counters[name], borders)]
        return sum(missing for missing, _ in found), sum(repeated for _, repeated in found)
    return None


def lost(counts: npt.NDArray[np.int64]) -> tuple[int, int]:
    """How many readings a counter says were lost, and how many came again.

    A counter of 8, 16 or 32 bits wraps; one that goes back anywhere else has begun anew.
    """
    steps = np.diff(counts)
    for bits in (8, 16, 32):
        wraps = (
            (steps < 0)
            & (counts[:-1] >= 2**bits - 2**bits // 8)
            & (counts[:-1] < 2**bits)
            & (counts[1:] < 2**bits // 8)
        )
        steps[wraps] += 2**bits
    return int((steps[steps > 1] - 1).sum()), int(np.count_nonzero(steps == 0))

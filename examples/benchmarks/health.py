"""`python -m examples.benchmarks health`: how soon a changed sensor is noticed, and what alarms though nothing changed.

Every set of touches is dealt into seeded orders; half of a set, in its order, comes from the sensor that learned, the
rest from one that changed. Rest readings, where a case has them, are simulated: the level that 2 % of a channel's
readings lie below, a zero that differs by 0.2 % of the range each time, and the channel's own noise.
"""

from __future__ import annotations

import json as text
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import process_time
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from examples.benchmarks.health_peers import Order, lacking, oracle_difference, peer_records
from examples.paper.readers import biotac_slide, fabric_slide
from examples.paper.readers.labelled import Recordings
from examples.paper.runs.options import Json, Seed
from examples.paper.runs.results import show, write
from scroll_tactile import sensors
from scroll_tactile.blas import one_thread
from scroll_tactile.clients.cli.terminal import progress_bar
from scroll_tactile.health.channel_numbers import channel_numbers
from scroll_tactile.health.watch import Watch
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream, validate
from scroll_tactile.simulation.scene import Scene

__all__ = ["Measured", "health", "run_health"]

Record = dict[str, Any]
Floats = npt.NDArray[np.float64]

BOUND = 0.01
NONE = ("none", "one material", "new materials", "half as long", "firm", "light", "short", "long")
ONE = ("gain −5 %", "offset +2 %", "dead", "noise doubled")
MANY = ("gains spread by 3 %", "gains −10 %", "zero +2 %")
AT_REST = ("none, at rest", "gains −10 %, at rest", "zero +2 %, at rest")
NAMED = dict(zip(ONE, ("gain", "offset", "dead", "noisier"), strict=True))
LATE = 0.3  # of the touches: the firm ones, the short ones …
ACTIVE = 0.005  # of the range: a channel below it in the mean is not chosen
RESTING, WANDER = 50, 0.002  # readings at rest before a touch; the zero's standard deviation, of the range


@dataclass(frozen=True)
class Touches:
    """A set with what a change needs to know of its sensor. noise: of a channel's readings; rest: its level at rest."""

    name: str
    sensor: Sensor
    streams: list[Stream]
    materials: npt.NDArray[np.str_]
    noise: Floats
    rest: Floats
    active: npt.NDArray[np.int64]

    @classmethod
    def of(cls, name: str, sensor: Sensor, streams: list[Stream], materials: list[str]) -> Touches:
        """Measure noise and rest from the touches themselves."""
        span = float(np.max(sensor.high)) - float(np.min(sensor.low))
        bent = [np.median(np.abs(np.diff(stream.readings, 2, axis=0)), axis=0) for stream in streams]
        noise = np.maximum(np.median(bent, axis=0) / 0.6745 / np.sqrt(6), span * 1e-3)
        every = np.concatenate([stream.readings for stream in streams])
        active = np.flatnonzero(every.mean(axis=0) - np.min(sensor.low) > ACTIVE * span)
        return cls(name, sensor, streams, np.array(materials), noise, np.quantile(every, 0.02, axis=0), active)


def read_sets(data: Path | None, seed: int) -> Iterator[Touches]:
    """The simulated set, and with `data` the recorded ones."""
    scene = Scene(sensor=sensors.BIOTAC, seed=seed)
    made = [(name, scene.touch(name, i)) for name in scene.materials for i in range(50)]
    yield Touches.of("simulated", sensors.BIOTAC, [stream for _, stream in made], [name for name, _ in made])
    if data is None:
        return
    recorded: list[Recordings] = [fabric_slide.load(data).recordings, biotac_slide.load(data, "biotac", seed)]
    for found in (*recorded, biotac_slide.load(data, "roboskin", seed, unmixed=True)):
        yield Touches.of(f"{found.name} {found.sensor.name}", found.sensor, found.streams, found.materials)


class Change:
    """A case on one order. channel: that changes, where one does."""

    def __init__(self, touches: Touches, case: str, random: np.random.Generator) -> None:
        self.touches, self.case, self.random = touches, case.removesuffix(", at rest"), random
        self.channel = int(random.choice(touches.active))
        self.gains = 1 + random.normal(0, 0.03, touches.sensor.channels)
        self.low, high = (float(np.max(limit)) for limit in touches.sensor.limits)
        self.span = high - self.low

    def applied(self, readings: Floats) -> Stream:
        """Readings as the changed sensor gives them."""
        x, at = readings.copy(), self.channel
        if self.case == "gain −5 %":
            x[:, at] *= 0.95
        elif self.case == "offset +2 %":
            x[:, at] += 0.02 * self.span
        elif self.case == "dead":
            x[:, at] = self.low
        elif self.case == "noise doubled":
            x[:, at] += self.random.normal(0, self.touches.noise[at] * np.sqrt(3), len(x))
        elif self.case == "gains spread by 3 %":
            x *= self.gains
        elif self.case == "gains −10 %":
            x *= 0.9
        elif self.case == "zero +2 %":
            x += 0.02 * self.span
        elif self.case == "half as long":
            x = x[: len(x) // 2]
        return self.sound(x)

    def sound(self, readings: Floats) -> Stream:
        """Readings within the range, as a stream."""
        return validate(np.clip(readings, self.low, self.low + self.span).astype(np.float32), self.touches.sensor)

    def resting(self) -> Floats:
        """Readings of the sound sensor at rest."""
        shape = (RESTING, len(self.touches.rest))
        zero = self.touches.rest + self.random.normal(0, WANDER * self.span, shape[1])
        return zero + self.random.normal(0, self.touches.noise, shape)

    def order(self) -> tuple[npt.NDArray[np.int64], int]:
        """The order of the touches, and how many come before the change."""
        touches, case = self.touches, self.case
        order = self.random.permutation(len(touches.streams))
        names, half = touches.materials[order], len(order) // 2
        if case == "one material":
            own = names == self.random.choice(np.unique(names))
            known = own & (np.cumsum(own) <= own.sum() // 3)
            first, last = np.where(known | ~own)[0], np.where(own & ~known)[0]
        elif case == "new materials":
            new = np.isin(names, self.random.permutation(np.unique(names))[: len(np.unique(names)) // 2])
            first, last = np.where(~new)[0], np.where(new)[0]
        elif case in ("firm", "light", "short", "long"):
            of = [len(one) if case in ("short", "long") else one.readings.mean() for one in touches.streams]
            value = np.array(of, float)[order] * (1 if case in ("light", "short") else -1)
            of_case = np.where(value <= np.quantile(value, LATE))[0]
            last = of_case[len(of_case) // 3 :]  # a third of them is known from before
            first = np.setdiff1d(np.arange(len(order)), last)
        else:
            return order, half
        return order[np.concatenate([first, last])], len(first)


Touched = tuple[int, str, int, Any]
"""The place of a touch in an order, its material, its readings, and its numbers."""


def touched(change: Change, sound: list[Any], order: npt.NDArray[np.int64], half: int) -> Iterator[Touched]:
    """The touches of an order, from `half` on by the changed sensor."""
    touches = change.touches
    unchanged = change.case in NONE and change.case != "half as long"
    for place, i in enumerate(order.tolist()):
        stream, numbers = touches.streams[i], sound[i]
        if place >= half and not unchanged:
            stream = change.applied(stream.readings.astype(np.float64))
            numbers = channel_numbers(stream)
        yield place, str(touches.materials[i]), len(stream), numbers


def run_order(touches: Touches, sound: list[Any], case: str, seed: int) -> Record:
    """One order: the touches up to the alarm behind the change; before it, and where nothing changed, it is false."""
    change = Change(touches, case, np.random.default_rng([seed, 35]))
    order, half = change.order()
    watch, resting, began = Watch(touches.sensor.channels, BOUND), case.endswith("at rest"), process_time()
    at = len(order)
    for place, *touch in touched(change, sound, order, half):
        watch.take(2 * place + 1, *touch)
        if resting:
            read = change.resting()
            rest = change.sound(read) if place < half else change.applied(read)
            measured = channel_numbers(rest)
            assert measured is not None
            watch.take(2 * place + 2, "", len(rest), measured)
        if watch.alarmed is not None:
            at = place
            break
    spent = (process_time() - began) / (at + 1)
    found, told = watch.alarmed is not None, watch.change
    false = found and (change.case in NONE or at < half)
    delay = at - half + 1 if found and not false else None
    one = told is not None and told.channels == (change.channel,)
    kind = None if told is None else told.kind
    return {"false": false, "delay": delay, "named": one, "kind": kind, "milliseconds": 1e3 * spent}


def summed(name: str, case: str, orders: list[Record]) -> Record:
    """A row of the table."""
    delays = [order["delay"] for order in orders if order["delay"] is not None]
    found = {"set": name, "case": case, "orders": len(orders), "false": sum(order["false"] for order in orders)}
    found |= {"milliseconds": float(np.median([order["milliseconds"] for order in orders]))}
    if case in NONE or case.startswith("none"):
        return found
    found |= {"found": len(delays)}
    if delays:
        found |= {"median": float(np.median(delays)), "most": float(np.quantile(delays, 0.95))}
    if case in ONE:
        found |= {"named": sum(order["named"] for order in orders if order["delay"] is not None)}
        found |= {"kind": sum(order["kind"] == NAMED[case] for order in orders if order["delay"] is not None)}
    return found


def beside_peers(touches: Touches, sound: list[Any], orders: int, seed: int) -> tuple[list[Record], Record]:
    """Delays of others' detectors on one channel's p-values, and how far others' martingales are from ours on all."""
    cases = dict[str, list[Order]]()
    for case in ("none", *ONE):
        cases[case] = []
        for number in range(seed, seed + orders):
            change = Change(touches, case, np.random.default_rng([number, 35]))
            order, half = change.order()
            rows = touched(change, sound, order, half)
            cases[case].append(Order.of(rows, touches.sensor.channels, change.channel, half, BOUND))
    return peer_records(touches.name, cases), {"set": touches.name} | oracle_difference(cases["none"][0])


class Measured:
    """What was measured before, by its key. cache: a file with a line for each, which what is measured is added to."""

    def __init__(self, cache: Path | None) -> None:
        self._cache = cache
        self._done: dict[tuple[Any, ...], Record] = {}
        if cache is not None and cache.is_file():
            written = cache.read_bytes()
            whole = written[: written.rfind(b"\n") + 1]
            if whole != written:  # a run was killed as it wrote the last line
                cache.write_bytes(whole)
            self._done = {tuple(key): value for key, value in map(text.loads, whole.splitlines())}

    def get(self, key: tuple[Any, ...], measure: Callable[[], Record]) -> Record:
        """What was measured, now or before."""
        if key not in self._done:
            self._done[key] = measure()
            if self._cache is not None:
                with self._cache.open("a", encoding="utf-8") as file:
                    file.write(text.dumps([key, self._done[key]]) + "\n")
        return self._done[key]


def run_health(
    data: Path | None,
    *,
    only: str = "",
    orders: int,
    peers: int,
    seed: int,
    cache: Path | None,
    note: Callable[[str], None],
) -> Record:
    """A record for each set and case. cache: a file of what was measured already, one line an order. only: the set."""
    measured = Measured(cache)
    records, compared, oracles = list[Record](), list[Record](), list[Record]()
    with one_thread():
        for touches in read_sets(data, seed):
            if not touches.name.startswith(only):
                continue
            sound = [channel_numbers(stream) for stream in touches.streams]
            if peers:
                note(f"{touches.name}: others' detectors")
                others, oracle = beside_peers(touches, sound, peers, seed)
                compared, oracles = compared + others, [*oracles, oracle]
            for case in (*NONE, *ONE, *MANY, *AT_REST) if orders else ():
                note(f"{touches.name}: {case}")
                own = [
                    measured.get((touches.name, case, order), partial(run_order, touches, sound, case, order))
                    for order in range(seed, seed + orders)
                ]
                records.append(summed(touches.name, case, own))
    found = {"bench": "health", "bound": BOUND, "records": records, "peers": compared, "oracles": oracles}
    return found | ({"skipped": lacking()} if peers else {})


def health(
    context: typer.Context,
    data: Annotated[Path | None, typer.Option(help="Folder of FabricSlide and biotac_slide_20_50.")] = None,
    orders: Annotated[int, typer.Option(min=0, help="Of the touches of each set, for each case.")] = 100,
    only: Annotated[str, typer.Option(help="Only the set whose name begins so.")] = "",
    peers: Annotated[int, typer.Option(min=0, help="Orders for which others' detectors run beside it.")] = 0,
    cache: Annotated[Path | None, typer.Option(help="A file to go on from after an interruption.")] = None,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Change the sensor behind recorded touches: how soon that is noticed, and named."""
    with progress_bar() as progress:
        how: dict[str, Any] = {"only": only, "orders": orders, "peers": peers, "seed": seed, "cache": cache}
        result = run_health(data, **how, note=lambda what: progress(what, 0, 1))
    columns = {"set": "{./set}", "case": "{./case}", "orders": "{./orders}", "false": "{./false}"}
    columns |= {"found": "{?./found}", "median": "{?./median|.0f}", "95 %": "{?./most|.0f}"}
    columns |= {"named": "{?./named}", "kind": "{?./kind}", "ms": "{./milliseconds|.2f}"}
    if orders:
        show("touches until a change is noticed", columns, result["records"])
    if peers:
        beside = {"set": "{./set}", "case": "{./case}", "by": "{./peer}", "orders": "{?./orders}"}
        beside |= {"false": "{?./false}", "found": "{?./found}", "median": "{?./median|.0f}"}
        show("the same, by others' detectors on the changed channel's p-values", beside, result["peers"])
    write(context, result)

"""Others' detectors of change, and others' martingales, on the p-values that `health` bets on.

Each score has a detector of its own, and the first that alarms counts. The most sensitive setting is taken that has no
more false alarms than `health`, over the same orders; `health` has no such choice. KSWIN takes 1 ms a value: it gets
the five scores of the channel that changes alone, and so is told which one to look at.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.health import watch
from scroll_tactile.health.watch import JUMP, SCORES, STAKES, Bets, Watch

__all__ = ["PEERS", "Order", "lacking", "oracle_difference", "peer_records"]

Record = dict[str, Any]
Floats = npt.NDArray[np.float64]
NEVER = 1e-300  # a bound that no evidence reaches


class _Noted(Bets):
    """Bets that note the p-values (5 n,) of each touch; of the first one in a cell there are none."""

    def __init__(self, count: int) -> None:
        super().__init__(count)
        self.values: list[Floats] = []

    def take(self, ranks: Floats, first: int) -> None:
        """Note the p-values of a touch, and bet on them."""
        super().take(ranks, first)
        self.values.append(ranks)


@dataclass(frozen=True)
class Order:
    """The p-values (k, 5) of one channel in an order of touches, and the place of each. half: where the change begins.

    own: the place at which `health` alarmed, None where it did not; all: every score's p-values, (k, 5 n).
    """

    values: Floats
    places: list[int]
    half: int
    own: int | None
    all: Floats

    @classmethod
    def of(cls, rows: Iterator[tuple[Any, ...]], channels: int, channel: int, half: int, bound: float) -> Order:
        """Watch rows (place, material, steps, numbers), and note what was bet on."""
        watch = Watch(channels, NEVER)
        watch.bets = noted = _Noted(len(watch.least))
        places, own = list[int](), None
        for place, *row in rows:
            before = len(noted.values)
            watch.take(place + 1, *row)
            places += [place] * (len(noted.values) - before)
            if own is None and watch.evidence >= -np.log(bound):
                own = place
        every = np.array(noted.values)
        return cls(every[:, channel::channels][:, :SCORES], places, half, own, every)

    def delay(self, at: int) -> int:
        """Touches from the change to an alarm."""
        return at - self.half + 1


@dataclass(frozen=True)
class Peer:
    """A detector. settings: from the most sensitive. make: it, from its library's module, with a setting.

    sides: 2 where it sees growing values alone. orders: as many at most, of one that takes long. alone: whether it gets
    the channel that changes alone.
    """

    name: str
    module: str
    settings: tuple[float, ...]
    make: Callable[[Any, float], Any]
    sides: int = 1
    orders: int = 1000
    alone: bool = False

    def streams(self, order: Order) -> Floats:
        """The p-values that it gets, (k, streams)."""
        return order.values if self.alone else order.all


SMALL = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8, 1e-10)
GREAT = (2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0)


PEERS = (
    Peer("ADWIN", "river", SMALL, lambda river, delta: river.ADWIN(delta=delta, clock=1)),
    Peer("KSWIN", "river", SMALL[2::2], lambda river, alpha: river.KSWIN(alpha=alpha, seed=0), orders=2, alone=True),
    Peer(
        "Page-Hinkley",
        "river",
        GREAT,
        lambda river, most: river.PageHinkley(min_instances=5, threshold=most),
    ),
    Peer("ADWIN", "capymoa", SMALL, lambda moa, delta: moa.ADWIN(delta=delta), sides=2),
    Peer("CUSUM", "capymoa", GREAT, lambda moa, most: moa.CUSUM(5, 0.1, most), sides=2),
    Peer("HDDM-A", "capymoa", SMALL, lambda moa, confidence: moa.HDDMAverage(confidence), sides=2),
    Peer("HDDM-W", "capymoa", SMALL, lambda moa, confidence: moa.HDDMWeighted(confidence), sides=2),
)
MODULES = {"river": "river.drift", "capymoa": "capymoa.drift.detectors"}


def lacking() -> dict[str, str]:
    """Why detectors are not run."""
    return {module: f"{module} is not installed" for module in MODULES if find_spec(module) is None}


def _first_alarm(order: Order, peer: Peer, setting: float) -> int | None:
    """The place at which the detector of one of its scores alarms."""
    module, streams = import_module(MODULES[peer.module]), peer.streams(order)
    made = [peer.make(module, setting) for _ in range(streams.shape[1] * peer.sides)]
    for place, values in zip(order.places, streams.tolist(), strict=True):
        both = [*values, *(1 - value for value in values)] if peer.sides == 2 else values
        for detector, value in zip(made, both, strict=True):
            if hasattr(detector, "update"):
                detector.update(value)
                alarmed = detector.drift_detected
            else:
                detector.add_element(value)
                alarmed = detector.detected_change()
            if alarmed:
                return place
    return None


def _measured(peer: Peer, setting: float, cases: dict[str, list[Order]], most: int) -> dict[str, Record] | None:
    """What a setting does; None where it has more false alarms than there may be."""
    found, false = dict[str, Record](), 0
    for case, orders in cases.items():  # those without a change come first
        delays = []
        for order in orders[: peer.orders]:
            at = _first_alarm(order, peer, setting)
            wrong = at is not None and (case == "none" or at < order.half)
            false += wrong
            if false > most:
                return None
            if at is not None and not wrong:
                delays.append(order.delay(at))
        found[case] = {"orders": len(orders[: peer.orders]), "found": len(delays)}
        found[case] |= {"median": float(np.median(delays))} if delays else {}
    return found | {"false": {"false": false}}


def peer_records(name: str, cases: dict[str, list[Order]]) -> list[Record]:
    """Delays of `health` and of each peer, on a set's orders by case; "none" first."""
    own, most = list[Record](), 0
    for case, orders in cases.items():
        alarms = [(order.own, order) for order in orders if order.own is not None]
        late = [order.delay(at) for at, order in alarms if case != "none" and at >= order.half]
        most += len(alarms) - len(late)
        record = {"set": name, "case": case, "peer": "health", "orders": len(orders), "found": len(late)}
        own.append(record | ({"median": float(np.median(late))} if late else {}))
    records = [record | {"false": most} for record in own if record["case"] != "none"]
    for peer in PEERS:
        if find_spec(peer.module) is None:
            continue
        tried = ((setting, _measured(peer, setting, cases, most)) for setting in peer.settings)
        setting, found = next(((setting, found) for setting, found in tried if found is not None), (None, None))
        for case in cases:
            if case != "none":
                about = {"set": name, "case": case, "peer": f"{peer.name}, {peer.module}", "setting": setting}
                records.append(about | ({} if found is None else found[case] | found["false"]))
    return records


def oracle_difference(order: Order) -> Record:
    """By how much the logarithms of crepes' and MAPIE's martingales differ from ours on the same p-values, at most."""
    found: Record = {}
    if find_spec("crepes") is not None:
        from crepes.martingales import EpsilonBettingFunction, SimpleJumper

        jumper = SimpleJumper(J=JUMP, bf=EpsilonBettingFunction(STAKES[:, 0].tolist()))
        theirs = np.array([jumper.apply(column)[-1] for column in order.all.T])
        found["crepes"] = float(np.abs(np.log(theirs) - _ours(order.all, STAKES)).max())
    if find_spec("mapie") is not None:
        from mapie.exchangeability_testing import OnlineMartingaleTest

        ends = []
        for column in order.all.T:
            test = OnlineMartingaleTest(task="regression", jump_size=JUMP)
            ends.append([test.update_simple_jumper_martingale(value) for value in column.tolist()][-1])
        stakes = np.array([-1.0, 0.0, 1.0])[:, None]  # MAPIE's, which are its own
        found["mapie"] = float(np.abs(np.log(ends) - _ours(order.all, stakes)).max())
    return found


def _ours(values: Floats, stakes: Floats) -> Floats:
    before, watch.STAKES = watch.STAKES, stakes
    try:
        bets = Bets(values.shape[1])
        for row in values:
            bets.take(row, 0)
    finally:
        watch.STAKES = before
    return bets.log

"""What is odd about a recording or a touch, said by every way in: one table says from which size on, how, and the cure.

A reader measures and judges nothing; whoever takes readings asks `judged`, which looks in `RULES`. A fact below its
first size is silent, from it on it is said once, and from the second on the recording is refused, or cut.
"""

from __future__ import annotations

import math
import re
import unicodedata
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from scroll_tactile.errors import FactWarning, RangeWarning, RecordingError
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.stream import Stream

__all__ = [
    "CURE",
    "OF_TOUCHES",
    "RULES",
    "Fact",
    "Rule",
    "all_clipped",
    "channels_named",
    "fact_warnings",
    "judged",
    "merged",
    "name_fact",
    "touch_facts",
    "warn_of",
]

CURE = "make a new memory with a Sensor whose low and high are the least and the most that it sends, in its unit"
_CUT = (
    "it is cut at such of more than ten readings, and each part of 0.3 s or more is a touch of its own; rate='keep' "
    "takes it in one"
)
_NAMED = 5  # channels in a sentence


class Rule(NamedTuple):
    """When a kind of fact is worth a word, and when more.

    said: the size from which on it is said. more: from which on it is "refused" or "cut", as `then` says.
    text: what is said, with words in braces. cure: what to do. argument: the one that cures it, where there is one.
    """

    said: float
    text: str
    cure: str = ""
    more: float = math.inf
    then: Literal["said", "refused", "cut"] = "said"
    argument: str | None = None


RULES = {
    # Of a recording beside its sensor. The size is a share, or how many of the sensor's readings a time holds.
    "rate": Rule(
        0.05,
        "by its times it has {rate:.4g} readings a second, and sensor {sensor!r} has {own:g}",
        "take the numbers as they are, rate='keep', or a reading each {step:.3g} s on the line between them, "
        "rate='resample'",
        0.2,
        "refused",
        "rate",
    ),
    "gap": Rule(
        5,
        "{count} in its times, the longest {seconds:.4g} s before reading {index}",
        _CUT,
        10,
        "cut",
        "rate",
    ),
    "back": Rule(
        0,
        "time goes back {count}, by {seconds:.4g} s before reading {index}",
        _CUT,
        10,
        "cut",
        "rate",
    ),
    "repeated": Rule(0.01, "{share:.3g} % of its readings have the time or the number of the one before"),
    "lost": Rule(0.001, "{count} readings were lost, as its counter says, {share:.3g} % of all"),
    "unset": Rule(0.01, "{count} headers have no stamp, so that another clock counts", "have the driver fill them in"),
    "cut off": Rule(1, "the file ends before its end; what was whole is read"),
    "note": Rule(1, "{text}"),
    "columns": Rule(
        1,
        "its columns are in another order than those of {first}: they are taken by their names",
        "columns={columns!r} takes them by their places",
        argument="columns",
    ),
    "names": Rule(
        1,
        "it has no columns {lacking}, as {first} has; it has {own}",
        "rename them, or take them by their places: columns={columns!r}",
        1,
        "refused",
        "columns",
    ),
    # Of a touch. The size of "range" is the share of all its values, or half that of a channel's.
    "range": Rule(0.26, "{share:.0f} % of the values{where} lie outside {range} and were clipped to its ends", CURE),
    "corner": Rule(250, "all readings lie in {share:.2g} % of {range} and can hardly be told apart", CURE),
    "constant": Rule(2, "nothing moves: all {count} readings are the same", "is the sensor connected and touched?"),
    "frozen": Rule(100, "{count} readings in a row, {seconds:.3g} s, are the same", "does the driver repeat itself?"),
    "top": Rule(1, "{where} never leaves the top of its range", "mend it, or leave its column out"),
    "still": Rule(1, "{where} never moves while all others do", "mend it, or leave its column out"),
    "long": Rule(
        10,
        "it lasts {seconds:.4g} s, and a touch of sensor {sensor!r} usually {usual:g} s",
        "if it holds several touches, `scroll-tactile learn --cut contact` finds them; if not, the sensor's duration "
        "is too short",
    ),
    "near": Rule(1, "{name!r} is a new material, beside {other!r}", "if both are one, relabel its touches"),
    "known": Rule(1, "these very readings are learned as {other!r}, too", "relabel or retract one of them"),
}
"""Kind of fact → its rule."""

OF_TOUCHES = frozenset(("range", "corner", "constant", "frozen", "top", "still", "long", "near", "known"))
"""Kinds that `TactileLearner.observe` sees; the others are of recordings."""


@dataclass(frozen=True)
class Fact:
    """Something odd, and what to do about it.

    kind: of `RULES`. size: how much of it. source: of what; "" of readings without a name. text: a sentence, and the
    cure to it, "" for none. then: whether it is only "said", or the recording is "refused" or "cut". argument: as of
    the error it makes. count: of how many sources it was said, of which `source` is the first. about: tells facts of a
    kind apart.
    """

    kind: str
    size: float
    source: str
    text: str
    cure: str = ""
    then: Literal["said", "refused", "cut"] = "said"
    argument: str | None = None
    count: int = 1
    about: str = ""

    def __str__(self) -> str:
        others = f" and {self.count - 1} more" if self.count > 1 else ""
        return f"{self.source}{others}: {self.sentence}" if self.source else self.sentence

    @property
    def sentence(self) -> str:
        """The text with the cure."""
        return f"{self.text}: {self.cure}" if self.cure else self.text

    def to_json(self) -> dict[str, Any]:
        """It in JSON's types."""
        found = {name: getattr(self, name) for name in ("kind", "size", "source", "count")}
        return found | {"text": self.sentence}

    def error(self) -> RecordingError:
        """The error of a recording that it refuses."""
        return RecordingError(str(self), argument=self.argument)


def judged(kind: str, size: float, source: str, *, about: str = "", **words: Any) -> list[Fact]:
    """The fact of this kind and size, in a list; an empty one where its rule is silent. words: those in its text."""
    rule = RULES[kind]
    if not (size >= rule.said and size > 0):
        return []
    text, cure = rule.text.format(**words), rule.cure.format(**words)
    then = rule.then if size >= rule.more else "said"
    return [Fact(kind, float(size), source, text, cure, then, rule.argument, about=about)]


def merged(facts: Iterable[Fact]) -> list[Fact]:
    """Each kind once, by the first that had it, with the count of all and the largest size."""
    found: dict[tuple[str, str], Fact] = {}
    for fact in facts:
        before = found.get((fact.kind, fact.about))
        found[fact.kind, fact.about] = (
            fact
            if before is None
            else replace(before, count=before.count + fact.count, size=max(before.size, fact.size))
        )
    return list(found.values())


def warn_of(fact: Fact, stacklevel: int = 2) -> None:
    """Warn of a fact, by a FactWarning; by a RangeWarning of one of the sensor's range."""
    category = RangeWarning if fact.kind in ("range", "corner") else FactWarning
    warnings.warn(category(str(fact), argument=fact.argument), stacklevel=stacklevel + 1)


@contextmanager
def fact_warnings() -> Iterator[list[str]]:
    """Gather what is warned of facts in the block, as sentences, in place of showing it."""
    found: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FactWarning)
        try:
            yield found
        finally:
            found += [str(each.message) for each in caught if issubclass(each.category, FactWarning)]


def touch_facts(touch: Stream, source: str = "") -> list[Fact]:
    """What is odd about a touch: its range, what does not move, and its length.

    >>> from scroll_tactile.signals.stream import validate
    >>> skin = Sensor(name="skin", channels=2, rate=50, low=0, high=255, unit="counts", duration=1)
    >>> print(*touch_facts(validate([[0.1, 0.2], [0.9, 0.3]], skin)))
    all readings lie in 0.31 % of the range of sensor 'skin' (0 to 255 counts) and can hardly be told apart: make a \
new memory with a Sensor whose low and high are the least and the most that it sends, in its unit
    """
    sensor, readings = touch.sensor, touch.readings
    low, high = sensor.limits
    least, most = readings.min(axis=0), readings.max(axis=0)
    limits = f"{low:g} to {high:g} {sensor.unit}" if low.ndim == high.ndim == 0 else "each channel by its own"
    range_ = f"the range of sensor {sensor.name!r} ({limits})"
    facts = _outside(touch, range_, source)
    flat = least == most
    span = float(np.max((most - low) / (high - low)) - np.min((least - low) / (high - low)))
    if not facts and span > 0:
        facts += judged("corner", 1 / span, source, share=100 * span, range=range_)
    if flat.all():
        count = len(readings) * (len(readings) > 1 and not facts)  # the range tells why, where all were clipped
        facts += judged("constant", count, source, count=count)
    elif not sensor.camera:
        facts += _unmoved(touch, flat, source)
    facts += judged(
        "long",
        touch.seconds / sensor.duration,
        source,
        seconds=touch.seconds,
        usual=sensor.duration,
        sensor=sensor.name,
    )
    return facts


def _outside(touch: Stream, range_: str, source: str) -> list[Fact]:
    """Of the values outside the sensor's range: of all, or of the channels that have most."""
    if not touch.clipped:
        return []
    size, where = touch.clipped / touch.readings.size, ""
    share = size
    if touch.outside is not None:
        shares = touch.outside / len(touch)
        bad = np.flatnonzero(shares >= 2 * RULES["range"].said)
        if 0 < len(bad) < len(shares):
            share, where = float(shares.max()), f" of {channels_named(touch.sensor, bad.tolist())}"
            size = max(size, share / 2)
    return judged("range", size, source, share=100 * share, where=where, range=range_)


def _unmoved(touch: Stream, flat: np.ndarray, source: str) -> list[Fact]:
    """Of channels that never move, and of readings that come again and again.

    A channel that rests is usual where many do, as on a skin that is touched in one place; at the top of its range, or
    alone among many that move, none rests.
    """
    readings, facts = touch.readings, list[Fact]()
    if touch.mask is not None:
        flat = flat & ~touch.mask.all(axis=0)
    if touch.outside is not None:
        flat = flat & (touch.outside < len(touch))  # of which the range is spoken of
    top = flat & (readings[0] >= touch.sensor.limits[1])
    for kind, stuck in (("top", top), ("still", flat & ~top)):
        if kind == "top" or np.count_nonzero(flat) <= max(1, flat.size // 10):
            named = channels_named(touch.sensor, np.flatnonzero(stuck).tolist())
            facts += judged(kind, int(np.count_nonzero(stuck)), source, where=named)
    if len(readings) >= RULES["frozen"].said:
        moved = np.flatnonzero((readings[1:] != readings[:-1]).any(axis=1))
        longest = int(np.diff(moved, prepend=-1, append=len(readings) - 1).max())
        facts += judged("frozen", longest, source, count=longest, seconds=longest / touch.sensor.rate)
    return facts


def channels_named(sensor: Sensor, channels: Sequence[int]) -> str:
    """Some channels as a sentence has them: by number from 0, with their columns' names, the first five."""
    names = [f"{i} ({sensor.columns[i]})" if sensor.columns else str(i) for i in channels[:_NAMED]]
    more = f" and {len(channels) - _NAMED} more" if len(channels) > _NAMED else ""
    return f"channel{'s' * (len(channels) > 1)} {', '.join(names)}{more}"


def name_fact(material: str, materials: Iterable[str]) -> list[Fact]:
    """Of a new material whose name differs from that of another by case, blanks and hyphens alone.

    >>> print(*name_fact("Felt", ["felt", "oak"]))
    'Felt' is a new material, beside 'felt': if both are one, relabel its touches
    """
    own, others = _folded(material), dict.fromkeys(materials)
    near = [] if material in others or not own else [name for name in others if _folded(name) == own]
    about = f"{material}\n{near[0]}" if near else ""
    return judged("near", len(near), "", about=about, name=material, other=near[0]) if near else []


def _folded(name: str) -> str:
    return re.sub(r"[\s_-]", "", unicodedata.normalize("NFKC", name).casefold())


def all_clipped(touch: Stream) -> bool:
    """Whether all values lay outside the range: streams that differed may be the same now."""
    return touch.clipped >= touch.readings.size - touch.missing

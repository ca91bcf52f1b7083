"""Whether each channel of a sensor measures, by a memory's touches and health or by one recording; and pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from scroll_tactile.clients.report.drawing import as_counted, brief, clipped_name, evidence, png, shown
from scroll_tactile.clients.report.page import Card, State, figure, name_of, note, table
from scroll_tactile.health.diagnosis import advice, in_words
from scroll_tactile.matching.kept_arrays import KeptTouch
from scroll_tactile.memory.exemplars import Exemplar
from scroll_tactile.results import Health
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.image import scaled_down
from scroll_tactile.signals.levels import LEVELS, MISSING, LevelArray

FloatArray = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]

DEAD = 0.8  # of the touches, in which a channel never changes
SATURATED = 0.05  # of the readings, at an end of the range
DRIFTING = 0.05  # of the range, from the first part of a recording to the last …
CERTAIN = 4.0  # … and as many standard errors
LATELY = 20  # parts: a channel that died is seen in these
STEADY = 0.5  # of a channel that lives, in as many parts at most it may be still
MOST_ROWS = 128  # channels, of which all have a row in a table
MOST_PICTURES = 60
LONGEST = 160  # columns of a picture
HIGHEST = 64  # rows
FRAME = (60, 80)  # of a camera's picture
COLUMNS = 400  # touches beside each other in the picture of all
CHANGED = {
    **{kind: kind for kind in ("dead", "noisier", "slower")},
    **dict.fromkeys(("gain", "gains", "all gains"), "another gain"),
    **dict.fromkeys(("offset", "all offsets"), "another offset"),
}


@dataclass(frozen=True)
class ChannelSummary:
    """One channel, its levels as shares of its range.

    number: from 0. middle: the median; low, high: where 5 and 95 % of the readings lie. still: share of the touches in
    which it never changes. bottom, top: share of its readings at either end of the range. drift: of a recording, from
    its first part to its last, and its standard error; None where it cannot be measured. faults: in words.
    """

    number: int
    middle: float
    low: float
    high: float
    still: float
    bottom: float
    top: float
    drift: tuple[float, float] | None
    faults: list[str]


def channels_of(
    touches: Sequence[LevelArray],
    signed: npt.NDArray[np.bool_],
    *,
    ordered: bool,
    changed: Mapping[int, str] = MappingProxyType({}),
) -> list[ChannelSummary]:
    """The channels of some touches, or of the parts of one recording, levels (C, T) each.

    signed: whether zero lies inside the range of each, (C,), so that its bottom is an end, too. ordered: whether they
    follow each other, as parts do. changed: channel → what the memory's health says became of it.
    """
    count, found = len(touches[0]), []
    still = np.array([_still(levels) for levels in touches])
    counts = np.zeros((count, 256), np.int64)
    for levels in touches:
        placed = np.arange(count)[:, None] * 256 + levels
        counts += np.bincount(placed.ravel(), minlength=counts.size).reshape(counts.shape)
    drifts = drift(np.array([_mean(levels) for levels in touches]) / (LEVELS - 1)) if ordered else [None] * count
    always, lately = still.mean(axis=0), (still[-LATELY:] if ordered else still).mean(axis=0)
    for i, own in enumerate(counts):
        read = max(int(own[:MISSING].sum()), 1)
        reached = np.cumsum(own[:MISSING]) / read
        places = [float(np.searchsorted(reached, share)) / (LEVELS - 1) for share in (0.5, 0.05, 0.95)]
        bottom, top = float(own[0]) / read, float(own[LEVELS - 1]) / read
        fault, moved = changed.get(i, ""), drifts[i]
        if not fault and always[i] >= DEAD:
            fault = "dead"
        elif not fault and lately[i] >= DEAD and lately[i] - always[i] > STEADY / 2:
            fault = "died lately"
        elif not fault and max(top, bottom if signed[i] else 0.0) >= SATURATED:
            fault = "saturated"
        elif not fault and moved is not None and abs(moved[0]) >= max(DRIFTING, CERTAIN * moved[1]):
            fault = "drifting"
        missing = "missing readings" if own[MISSING] >= SATURATED * max(own.sum(), 1) else ""
        faults = [each for each in (fault, missing) if each]
        found.append(
            ChannelSummary(
                number=i,
                middle=places[0],
                low=places[1],
                high=places[2],
                still=float(always[i]),
                bottom=bottom,
                top=top,
                drift=moved,
                faults=faults,
            )
        )
    return found


def _still(levels: LevelArray) -> npt.NDArray[np.bool_]:
    """Which channels never change in a touch, (C,)."""
    read = np.ma.masked_equal(levels, MISSING)
    return np.asarray((read.max(axis=1) <= read.min(axis=1)).filled(True))


def _mean(levels: LevelArray) -> FloatArray:
    """The mean level of each channel, (C,); NaN where nothing was read."""
    return np.asarray(np.ma.masked_equal(levels, MISSING).mean(axis=1).filled(np.nan))


def drift(means: FloatArray) -> Sequence[tuple[float, float] | None]:
    """How far each channel's level moves from the first part of a recording to the last, and its standard error.

    means: (parts, C), in order: the slope over the place in that order. None where a part was not read, or of few.
    """
    if (count := len(means)) < LATELY:
        return [None] * means.shape[1]
    place = np.linspace(-0.5, 0.5, count)[:, None]
    rest, spread = means - means.mean(axis=0), float((place**2).sum())
    slopes = (place * rest).sum(axis=0) / spread
    errors = np.sqrt(((rest - slopes * place) ** 2).sum(axis=0) / (count - 2) / spread)
    both = zip(slopes.tolist(), errors.tolist(), strict=True)
    return [(slope, error) if math.isfinite(slope) else None for slope, error in both]


def health_cards(found: Health | None) -> list[Card]:
    """What is to be seen first of the sensor's health; nothing where it was not told."""
    if found is None or not found.grew:
        return []
    if found.since is None:
        return [("good", "Its sensor is", "the one that learned", f"{found.touches} touches and rest readings fit it.")]
    own = "the one that learned: a material changed"
    what = own if found.kind == "material" else f"another since observation {found.since}"
    return [("bad" if found.kind == "dead" else "look", "Its sensor is", what, in_words(found))]


def health_section(found: Health) -> str:
    """Whether the sensor is still the one that learned, and how the evidence grew."""
    if not found.grew:
        return note("No two touches of a material are alike enough in length and level to be compared.")
    alarm = -math.log10(found.bound)
    told = note(f"{in_words(found)}. {advice(found)}") if found.since is not None else ""
    return told + figure(
        evidence(found.grew, alarm),
        f"Evidence that touches of the same material read otherwise than before, as a power of ten. At {alarm:g} it is "
        f"an alarm: where nothing changes it gets there in {found.bound:.0%} of memories, however long they go on.",
    )


def channel_card(sensor: Sensor, kept: Sequence[KeptTouch], health: Health | None) -> Card:
    """What is to be seen first of the channels. health: of the memory; None where it has none."""
    if sensor.camera:
        return "none", "Channels", "a camera", "Its pixels are not looked at one by one."
    if not kept:
        return "none", "Channels", "not known", "No readings are kept that could show it."
    compared = f" and the health of {health.touches} touches and rest readings" if health and health.grew else ""
    return card_of(_channels(sensor, kept, health), f"{len(kept)} kept touches{compared}")


def card_of(found: Sequence[ChannelSummary], by: str) -> Card:
    """How channels stand, of these readings."""
    wrong: dict[str, list[str]] = {}
    for channel in found:
        for fault in channel.faults:
            wrong.setdefault(fault, []).append(str(channel.number))
    if not wrong:
        return "good", "Channels", f"all {len(found)} alive", f"None is dead, saturated or changed, by {by}."
    state: State = "bad" if any(fault.startswith(("dead", "died")) for fault in wrong) else "look"
    answer = "; ".join(f"{len(own)} {fault}" for fault, own in sorted(wrong.items()))
    more = ". ".join(
        f"{fault.capitalize()}: {', '.join(own[:8])}{f' and {len(own) - 8} more' if len(own) > 8 else ''}"
        for fault, own in sorted(wrong.items())
    )
    return state, "Channels", answer, f"{more} (of {len(found)}, by {by})."


def _channels(sensor: Sensor, kept: Sequence[KeptTouch], health: Health | None) -> list[ChannelSummary]:
    """The channels by kept touches, and what the memory's health says became of them."""
    low, high = (np.broadcast_to(limit, (sensor.channels,)) for limit in sensor.limits)
    changed: dict[int, str] = {}
    if health is not None and health.kind in CHANGED:
        changed = dict.fromkeys(health.channels, f"{CHANGED[health.kind]} since observation {health.since}")
    return channels_of([touch.levels for touch in kept], (low < 0) & (high > 0), ordered=False, changed=changed)


def channel_section(sensor: Sensor, kept: Sequence[KeptTouch], health: Health | None, *, ordered: bool) -> str:
    """All channels, and their levels over the touches. ordered: whether these come as they were observed."""
    if sensor.camera:
        return note("Not shown: a camera has no channels that could be dead one by one; look at its frames below.")
    if not kept:
        return note(
            "Not shown: no readings of touches are kept. A memory has some once it observed touches, unless it was "
            "made with kept_touches=0."
        )
    found = _channels(sensor, kept, health)
    head = level_picture(
        np.nan_to_num(np.stack([_mean(touch.levels) for touch in kept], axis=1)),
        f"mean level of each channel in each of {len(kept)} touches",
        f"Each row is a channel, 0 at the top; each column a touch, "
        f"{'in the order of observation' if ordered else 'by material'}. Dark is the least mean level that "
        "the channel had, yellow the most. A dead channel is a stripe of one colour.",
    )
    words = (
        f"Dead: never changes in {DEAD:.0%} of the touches (or no touch ever reached it). Saturated: {SATURATED:.0%} "
        "of its readings lie at the end of its range. Since an observation: what the memory's health says changed."
    )
    unit = sensor.unit if isinstance(sensor.unit, str) else "its unit"
    low, high = (np.broadcast_to(limit, (sensor.channels,)).astype(np.float64) for limit in sensor.limits)
    return head + note(words) + state_rows(found, low, high, unit)


def state_rows(
    found: Sequence[ChannelSummary], low: npt.NDArray[np.float64], high: npt.NDArray[np.float64], unit: str
) -> str:
    """The table of channels, whose range is from low to high, (C,) each; those with a fault come first."""
    drifts = any(channel.drift for channel in found)
    rows, listed = [], [channel for channel in found if channel.faults or len(found) <= MOST_ROWS]
    for channel in sorted(listed, key=lambda channel: not channel.faults)[:MOST_ROWS]:
        bottom, top = float(low[channel.number]), float(high[channel.number])
        median, least, most = (
            brief(bottom * (1 - share) + top * share) for share in (channel.middle, channel.low, channel.high)
        )
        moved = None if channel.drift is None else f"{100 * channel.drift[0]:+.1f} ± {100 * channel.drift[1]:.1f}%"
        state, ends = ", ".join(channel.faults) or "fine", (f"{channel.bottom:.1%}", f"{channel.top:.1%}")
        row = [channel.number, state, median, f"{least} to {most}", f"{channel.still:.0%}", *ends, moved]
        rows.append(row if drifts else row[:-1])
    median = f"median ({unit})" if unit else "median"
    header = ["channel", "state", median, "90% lie in", "never changes", "at bottom", "at top", "drift"]
    left = len(found) - len(rows)
    more = note(f"{left} more channels have no row, those without a fault first.") if left else ""
    return table(header if drifts else header[:-1], rows, "channels") + more


def _averaged(levels: npt.NDArray[np.number], columns: int) -> npt.NDArray[np.float64]:
    """Levels (C, T) with their columns averaged down to at most so many."""
    if levels.shape[1] <= columns:
        return levels.astype(np.float64)
    edges = np.linspace(0, levels.shape[1], columns + 1).astype(np.intp)
    return np.asarray(np.add.reduceat(levels, edges[:-1], axis=1, dtype=np.float64) / np.diff(edges))


def _thinned(levels: npt.NDArray[np.floating], columns: int) -> Pixels:
    """Levels (C, T) as a picture, the columns averaged down to so many."""
    levels = _averaged(_averaged(levels, columns).T, 4 * HIGHEST).T
    return np.rint(np.clip(levels, 0, LEVELS - 1) * (255 / (LEVELS - 1))).astype(np.uint8)


def level_picture(levels: npt.NDArray[np.number], alternative: str, caption: str) -> str:
    """A picture of levels (C, T), each channel from its least to its most but for the outermost hundredths.

    alternative: for who cannot see it.
    """
    few = _averaged(levels, COLUMNS)
    low, high = (np.quantile(few, share, axis=1, keepdims=True) for share in (0.01, 0.99))
    pixels = _thinned((few - low) / np.maximum(high - low, 1.0) * (LEVELS - 1), COLUMNS)
    size = f"height:{max(60, min(260, 9 * len(pixels)))}px"
    drawn = f'<img src="{png(pixels)}" alt="{shown(alternative)}" style="{size}">'
    return f'<figure class="wide">{drawn}<figcaption>{shown(caption)}</figcaption></figure>'


def exemplar_pictures(sensor: Sensor, kept: Sequence[KeptTouch], exemplars: Mapping[str, Sequence[Exemplar]]) -> str:
    """A small picture of one touch of each material, of as many as there is room for."""
    found: dict[str, str] = {}
    if sensor.camera:
        for name, ranked in exemplars.items():
            if ranked and len(found) < MOST_PICTURES:
                frames, (low, high) = ranked[0].readings, sensor.limits
                small = scaled_down(frames[len(frames) // 2][None], *FRAME)[0]
                found[name] = png(np.rint(np.clip((small - low) / (high - low), 0, 1) * 255).astype(np.uint8))
    else:
        for touch in kept:
            if touch.material not in found and len(found) < MOST_PICTURES:
                found[touch.material] = png(_thinned(_touch(touch.levels), LONGEST))
    if not found:
        return note("Not shown: no readings are kept, neither as exemplars nor to match with.")
    what = "One touch of each material: rows are channels, from least (dark) to most each; time runs to the right."
    if sensor.camera:
        what = "The middle frame of one touch of each material."
    left = len({*exemplars, *(touch.material for touch in kept)}) - len(found)
    more = f" {left} more are not shown." if left else ""
    items = "".join(
        f'<figure><img src="{data}" alt="a touch of {shown(name)}">'
        f"<figcaption>{name_of(clipped_name(name, 260))}</figcaption></figure>"
        for name, data in sorted(found.items(), key=lambda pair: as_counted(pair[0]))
    )
    return note(what + more) + f'<div class="pictures{" frames" if sensor.camera else ""}">{items}</div>'


def _touch(levels: LevelArray) -> npt.NDArray[np.float64]:
    """A touch's levels, each channel from its own least to its own most, so that what moves is seen."""
    read = levels != MISSING
    low = np.where(read, levels, LEVELS).min(axis=1, keepdims=True)
    high = np.where(read, levels, 0).max(axis=1, keepdims=True)
    return np.asarray((np.where(read, levels, low) - low) / np.maximum(high - low, 1) * (LEVELS - 1), dtype=np.float64)

"""What a page shows of a sensor: the state of its channels, and pictures of touches."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from scroll_tactile.clients.report.channels import DEAD, SATURATED, ChannelSummary, changed_in, channels_of
from scroll_tactile.clients.report.charts import evidence
from scroll_tactile.clients.report.drawing import as_counted, brief, clipped_name, png, shown
from scroll_tactile.clients.report.page import Card, figure, name_of, note, table
from scroll_tactile.health.advice import advice, in_words
from scroll_tactile.matching.likelihood import LEVELS, MISSING, LevelArray
from scroll_tactile.matching.match import KeptTouch
from scroll_tactile.memory.exemplars import Exemplar
from scroll_tactile.results import Health
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.image import scaled_down

__all__ = [
    "channel_card",
    "channel_section",
    "exemplar_pictures",
    "health_cards",
    "health_section",
    "level_picture",
    "listed",
    "state_rows",
]

MOST_ROWS = 128  # channels, of which all have a row in a table
MOST_PICTURES = 60
LONGEST = 160  # columns of a picture
HIGHEST = 64  # rows
FRAME = (60, 80)  # of a camera's picture
COLUMNS = 400  # touches beside each other in the picture of all

Pixels = npt.NDArray[np.uint8]


def listed(channels: Sequence[ChannelSummary], most: int = 8) -> str:
    """Their numbers in words."""
    numbers = [str(channel.number) for channel in channels]
    return ", ".join(numbers[:most]) + (f" and {len(numbers) - most} more" if len(numbers) > most else "")


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
    caption = (
        f"Evidence that touches of the same material read otherwise than before, as a power of ten. At {alarm:g} it is "
        f"an alarm: where nothing changes it gets there in {found.bound:.0%} of memories, however long they go on."
    )
    told = note(f"{in_words(found)}. {advice(found)}") if found.since is not None else ""
    return told + figure(evidence(found.grew, alarm), caption)


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
    wrong: dict[str, list[ChannelSummary]] = {}
    for channel in found:
        for fault in channel.faults:
            wrong.setdefault(fault, []).append(channel)
    if not wrong:
        return "good", "Channels", f"all {len(found)} alive", f"None is dead, saturated or changed, by {by}."
    worst = any(fault.startswith(("dead", "died")) for fault in wrong)
    answer = "; ".join(f"{len(own)} {fault}" for fault, own in sorted(wrong.items()))
    more = ". ".join(f"{fault.capitalize()}: {listed(own)}" for fault, own in sorted(wrong.items()))
    return "bad" if worst else "look", "Channels", answer, f"{more} (of {len(found)}, by {by})."


def _channels(sensor: Sensor, kept: Sequence[KeptTouch], health: Health | None) -> list[ChannelSummary]:
    low, high = (np.broadcast_to(limit, (sensor.channels,)) for limit in sensor.limits)
    return changed_in(channels_of([touch.levels for touch in kept], (low < 0) & (high > 0), ordered=False), health)


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
    means = np.stack([_levels_mean(touch.levels) for touch in kept], axis=1)
    order = "in the order of observation" if ordered else "by material"
    caption = (
        f"Each row is a channel, 0 at the top; each column a touch, {order}. Dark is the least mean level that "
        "the channel had, yellow the most. A dead channel is a stripe of one colour."
    )
    words = (
        f"Dead: never changes in {DEAD:.0%} of the touches (or no touch ever reached it). Saturated: {SATURATED:.0%} "
        "of its readings lie at the end of its range. Since an observation: what the memory's health says changed."
    )
    unit = sensor.unit if isinstance(sensor.unit, str) else "its unit"
    low, high = (np.broadcast_to(limit, (sensor.channels,)).astype(np.float64) for limit in sensor.limits)
    head = level_picture(means, f"mean level of each channel in each of {len(kept)} touches", caption)
    return head + note(words) + state_rows(found, low, high, unit)


def state_rows(
    found: Sequence[ChannelSummary], low: npt.NDArray[np.float64], high: npt.NDArray[np.float64], unit: str
) -> str:
    """The table of channels, whose range is from low to high, (C,) each; those with a fault come first."""
    faulty = [channel for channel in found if channel.faults]
    others = [channel for channel in found if not channel.faults] if len(found) <= MOST_ROWS else []
    rows, drifts = [], any(channel.drift for channel in found)
    for channel in [*faulty, *others][:MOST_ROWS]:
        bottom, top = float(low[channel.number]), float(high[channel.number])
        median, least, most = (
            brief(bottom * (1 - share) + top * share) for share in (channel.middle, channel.low, channel.high)
        )
        moved = None if channel.drift is None else f"{100 * channel.drift[0]:+.1f} ± {100 * channel.drift[1]:.1f}%"
        rows.append(
            [
                channel.number,
                ", ".join(channel.faults) or "fine",
                median,
                f"{least} to {most}",
                f"{channel.still:.0%}",
                f"{channel.bottom:.1%}",
                f"{channel.top:.1%}",
                *([moved] if drifts else []),
            ]
        )
    header = [
        "channel",
        "state",
        f"median ({unit})" if unit else "median",
        "90% lie in",
        "never changes",
        "at bottom",
        "at top",
        *(["drift"] if drifts else []),
    ]
    left = len(found) - len(rows)
    return table(header, rows, "channels") + (
        note(f"{left} more channels have no row, those without a fault first.") if left else ""
    )


def _levels_mean(levels: LevelArray) -> npt.NDArray[np.float64]:
    read = levels != MISSING
    return np.asarray(np.where(read, levels, 0).sum(axis=1) / np.maximum(read.sum(axis=1), 1))


def _averaged(levels: npt.NDArray[np.number], columns: int) -> npt.NDArray[np.float64]:
    """Levels (C, T) with their columns averaged down to at most so many."""
    if levels.shape[1] <= columns:
        return levels.astype(np.float64)
    edges = np.linspace(0, levels.shape[1], columns + 1).astype(np.intp)
    return np.asarray(np.add.reduceat(levels, edges[:-1], axis=1, dtype=np.float64) / np.diff(edges))


def _spread_out(means: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Mean levels (C, touches), each channel from its least to its most but for the outermost hundredths."""
    low, high = (np.quantile(means, share, axis=1, keepdims=True) for share in (0.01, 0.99))
    return np.asarray((means - low) / np.maximum(high - low, 1.0) * (LEVELS - 1))


def _thinned(levels: npt.NDArray[np.floating], columns: int) -> Pixels:
    """Levels (C, T) as a picture, the columns averaged down to so many."""
    levels = _averaged(_averaged(levels, columns).T, 4 * HIGHEST).T
    return np.rint(np.clip(levels, 0, LEVELS - 1) * (255 / (LEVELS - 1))).astype(np.uint8)


def level_picture(levels: npt.NDArray[np.number], alternative: str, caption: str) -> str:
    """A picture of levels (C, T), each channel from its least to its most; `alternative` is for who cannot see it."""
    few = _averaged(levels, COLUMNS)
    pixels = _thinned(_spread_out(few), COLUMNS)
    height = max(60, min(260, 9 * len(pixels)))
    drawn = f'<img src="{png(pixels)}" alt="{shown(alternative)}" style="height:{height}px">'
    return f'<figure class="wide">{drawn}<figcaption>{shown(caption)}</figcaption></figure>'


def exemplar_pictures(sensor: Sensor, kept: Sequence[KeptTouch], exemplars: Mapping[str, Sequence[Exemplar]]) -> str:
    """A small picture of one touch of each material, of as many as there is room for."""
    found: dict[str, str] = {}
    if sensor.camera:
        for name, ranked in exemplars.items():
            if ranked and len(found) < MOST_PICTURES:
                found[name] = png(_frame(sensor, ranked[0].readings))
    else:
        for touch in kept:
            if touch.material not in found and len(found) < MOST_PICTURES:
                found[touch.material] = png(_thinned(_touch(touch.levels), LONGEST))
    if not found:
        return note("Not shown: no readings are kept, neither as exemplars nor to match with.")
    names = {*exemplars, *(touch.material for touch in kept)}
    what = (
        "The middle frame of one touch of each material."
        if sensor.camera
        else "One touch of each material: rows are channels, from least (dark) to most each; time runs to the right."
    )
    more = f" {len(names) - len(found)} more are not shown." if len(names) > len(found) else ""
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


def _frame(sensor: Sensor, readings: npt.NDArray[np.float32]) -> Pixels:
    low, high = sensor.limits
    small = scaled_down(readings[len(readings) // 2][None], *FRAME)[0]
    return np.asarray(np.rint(np.clip((small - low) / (high - low), 0, 1) * 255), dtype=np.uint8)

"""What the health of a sensor says, in words, and what to do about it."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime

from scroll_tactile.results import Health

__all__ = ["advice", "in_words"]

_SEEN = {
    "gain": "reads stronger or weaker by a factor",
    "offset": "reads higher or lower by a constant",
    "dead": "says nothing any more",
    "noisier": "is noisier",
    "slower": "is duller or slower",
    "gains": "changed, each in its own way",
    "all gains": "changed by one factor",
    "all offsets": "changed by one constant",
}
_FEW = "look at its contact, its wire and its amplifier"
_ALL = "look whether the skin, the unit, its supply or its temperature is another"


def in_words(health: Health, name: Callable[[str], str] = str) -> str:
    """One sentence: what changed, and since when. name: how the name of a material is written."""
    if not health.grew:
        return "nothing can be told yet: no touch has an earlier one of its material, length and level"
    if health.since is None:
        return f"no change of the sensor is seen in {health.touches} touches and rest readings"
    when = "" if health.time is None else f", {datetime.fromtimestamp(health.time, UTC):%Y-%m-%d %H:%M} UTC"
    since = f"since observation {health.since}{when}"
    if health.kind == "material":
        return f"{since} {', '.join(map(name, health.materials))} feels otherwise, and no other material does"
    many = "channel" if len(health.channels) == 1 else "channels"
    return f"{since} {many} {', '.join(map(str, health.channels))}: {_SEEN[health.kind]}"


def advice(health: Health) -> str:
    """What to do about it; "" where nothing is wrong."""
    if health.since is None:
        return ""
    if health.kind == "material":
        return (
            "it wore off, or another thing has its name: `scroll-tactile memory relabel` puts a wrong name right, and "
            f"--after {health.alarmed} asks about later touches alone"
        )
    look = _FEW if health.kind in ("gain", "offset", "dead", "noisier", "slower") else _ALL
    return (
        f"{look}; answers to touches since then may be wrong. Mended, --after {health.alarmed} asks about later "
        "touches alone; if it cannot be mended, about five touches of known materials take it over: `scroll-tactile "
        f"memory adapt`, with --until {health.since - 1}"
    )

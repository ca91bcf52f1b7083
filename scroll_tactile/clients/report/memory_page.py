"""The page of a memory: what it knows, what it mixes up, whether to trust it, and whether its sensor is well."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from datetime import UTC, datetime

import numpy as np

from scroll_tactile import __version__
from scroll_tactile.clients.report.charts import dated, histogram, timeline
from scroll_tactile.clients.report.drawing import shown
from scroll_tactile.clients.report.facts import MemoryFacts
from scroll_tactile.clients.report.judgement import ROWS, alike, calibration_plots, estimated, growing_answers, mixed_up
from scroll_tactile.clients.report.page import Card, State, cards, figure, page, side_by_side, table
from scroll_tactile.clients.report.sensing import (
    channel_card,
    channel_section,
    exemplar_pictures,
    health_cards,
    health_section,
)
from scroll_tactile.learner import TactileLearner

__all__ = ["memory_page"]

FEW = 30  # touches left out: with fewer, no figure of them is certain
FEW_TOUCHES = 3  # of a material
RIGHT, POOR = 0.95, 0.8  # shares: what is fine, and what is bad
BARS = 60
STEPS = 3


def memory_page(
    learner: TactileLearner,
    *,
    risk: float = 0.05,
    name: str | None = None,
    progress: Callable[[str, int, int], object] | None = None,
) -> str:
    """One HTML page that shows what a memory knows; it needs no network and no script.

    risk: the share of wrong answers among those that are decided, as of `TactileLearner.live`. name: what stands above
    it; the folder's unless given. progress: called with (what is being done, steps done, steps in all). Nothing should
    be observed meanwhile: of a learner that goes on, give a `copy.deepcopy`, which is a snapshot.

    Where something is not there, such as readings in a compacted memory, the page says so, and why.

    Raises InputError for a risk that is no share; CapacityError; and StoreError where a memory on disk cannot be read.
    """
    facts = MemoryFacts(learner, risk)
    title = name or ("A memory without a path" if learner.path is None else learner.path.name)
    show = progress or (lambda what, done, of: None)
    show("touches left out", 0, STEPS)
    near, order = alike(facts)
    known, mixed, calibrated = _known(facts), mixed_up(facts, order), calibration_plots(facts)
    show("beginnings of touches", 1, STEPS)
    grown = growing_answers(facts)
    show("channels", 2, STEPS)
    sensor = learner.sensor
    found = learner.health() if learner.has_health else None
    # What tells most comes first; when it was taught is of use to few.
    exemplars = facts.exemplars if sensor.camera else {}
    strips = exemplar_pictures(sensor, facts.kept, exemplars)
    sections = [
        ("known", "What it knows", side_by_side(f"<div>{strips}</div>", f"<div>{known}</div>")),
        ("mixed", "What it mixes up", mixed),
        ("alike", "Who is near whom", near),
        ("trust", "Whether to trust it", calibrated),
        ("growing", "How answers grow", grown),
        *([("estimated", "What it measures", estimated(facts))] if facts.estimator is not None else []),
        *([("health", "Whether its sensor is the one that learned", health_section(found))] if found else []),
        ("channels", "Channels", channel_section(sensor, facts.kept, found, ordered=facts.ordered)),
        ("when", "When it was taught", _over_time(facts)),
    ]
    for i, axis in enumerate(learner.axes):
        by = facts.by(axis)
        sections.append((f"axis-{i}", f"By {axis}", mixed_up(by, alike(by)[1]) + calibration_plots(by)))
    channels = channel_card(sensor, facts.kept, found)
    summary = cards([_knows(facts), _mixes(facts), _trusts(facts), _soon(facts), channels, *health_cards(found)])
    if facts.missing:
        reasons = "".join(f"<li>{shown(why)}</li>" for why in dict.fromkeys(facts.missing))
        sections.append(("missing", "What is missing, and why", f"<ul>{reasons}</ul>"))
    show("written", STEPS, STEPS)
    return page(title, _under(learner), summary, sections, _foot(learner))


def _under(learner: TactileLearner) -> str:
    sensor, embedding = learner.sensor, learner.embedding
    row = max(learner.memory.corrections, default=None)
    through = "" if row is None else f" Its skin changed: touches are read through the adaptation in row {row}."
    return (
        f"A tactile memory of sensor <b>{shown(sensor.name)}</b>, {sensor.channels} channels at {sensor.rate:g} Hz; "
        f"embedding {shown(embedding.name)}, {embedding.dimension} features.{through}"
    )


def _foot(learner: TactileLearner) -> str:
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    return (
        f"Made {now} by scroll-tactile {shown(__version__)}. Digest of the memory <code>{learner.digest()}</code>, "
        f"fingerprint of the embedding <code>{shown(learner.embedding.fingerprint[:16])}</code>. A touch that is left "
        "out is judged by statistics and kept touches without it, and by the calibration of all."
    )


def _knows(facts: MemoryFacts) -> Card:
    count = sum(facts.counts.values())
    if not count:
        return "none", "It knows", "nothing yet", "Teach a touch: scroll-tactile observe."
    least = min(facts.counts, key=lambda name: facts.counts[name])
    last = max((row.time for row in facts.journal if row.state != "retracted"), default=None)
    few = f"Fewest touches: {facts.counts[least]}, of {least}." if len(facts.counts) > 1 else ""
    when = "" if last is None else f" Last touch {dated(last)} UTC."
    answer = f"{len(facts.counts)} material{'s' * (len(facts.counts) > 1)}, {count} touch{'es' * (count > 1)}"
    return "look" if facts.counts[least] < FEW_TOUCHES else "good", "It knows", answer, few + when


def _mixes(facts: MemoryFacts) -> Card:
    trust, heading = facts.trust, "It mixes up"
    if trust is None:
        return "none", heading, "not known", _sentence(facts.nothing_left_out)
    wrong = round((1 - trust.right) * trust.count)
    if not wrong:
        return "good", heading, "nothing", f"All {trust.count} touches left out got their own name."
    worst = facts.mistakes[0]
    more = f"Left out one by one. Most often {worst.material}, called {worst.answer}: {worst.count} of {worst.tested}."
    return _state(trust.right), heading, f"{wrong} of {trust.count} touches", more


def _trusts(facts: MemoryFacts) -> Card:
    trust, heading = facts.trust, "Touches held out"
    if trust is None:
        return "none", heading, "not known", _sentence(facts.nothing_left_out)
    more = (
        f"Mean probability {trust.confidence:.1%}, ECE {trust.error:.3f}, {trust.unknown:.0%} called unknown. Others "
        "of their sittings were learned: tomorrow's touches are harder."
    )
    tested = len({touch.material for touch in facts.held_out})
    more += f" Measured among {tested} of {len(facts.counts)} materials." if tested < len(facts.counts) else ""
    if trust.count < FEW:
        return "look", heading, f"{trust.right:.0%} right, by only {trust.count} touches", more
    if trust.miscalibrated:
        words = "overconfident" if trust.confidence > trust.right else "underconfident"
        return "bad", heading, f"{trust.right:.1%} right, {words}", more
    return _state(trust.right), heading, f"{trust.right:.1%} right, calibrated", more


def _soon(facts: MemoryFacts) -> Card:
    measured, heading = facts.soon, "It decides"
    if measured is None:
        return "none", heading, "not known", "Too few touches are kept to measure it."
    wrong = measured.wrong[-1] / measured.decided[-1] if measured.decided[-1] else 0.0
    more = f"{measured.decided[-1]:.0%} are decided within {measured.seconds[-1]:.3g} s, {wrong:.0%} of these wrongly."
    if measured.median is None:
        return "look", heading, "not before the end", more
    return "good" if wrong <= 2 * facts.risk else "look", heading, f"half of touches in {measured.median:.2g} s", more


def _state(right: float) -> State:
    return "good" if right >= RIGHT else "look" if right >= POOR else "bad"


def _sentence(why: str) -> str:
    return why[:1].upper() + why[1:]


def _known(facts: MemoryFacts) -> str:
    """The materials."""
    if not facts.counts:
        return facts.lacks("What it knows", "no touch was observed yet.")
    names, separation = facts.near
    nearest: dict[str, tuple[str, float]] = {}
    if len(names) > 1:
        far = separation + np.diag(np.full(len(names), np.inf))
        nearest = {name: (names[int(row.argmin())], float(row.min())) for name, row in zip(names, far, strict=True)}
    first: dict[str, float] = {}
    for row in facts.journal:
        if row.state != "retracted":
            first.setdefault(row.material, row.time)
    tested = Counter(touch.material for touch in facts.held_out)
    right = Counter(touch.material for touch in facts.held_out if touch.answer == touch.material)
    rows = [
        [
            name,
            count,
            f"{right[name]} of {tested[name]}" if tested[name] else None,
            *nearest.get(name, (None, None)),
            dated(first[name]) if name in first else None,
        ]
        for name, count in facts.counts.items()
    ]
    header = ["material", "touches", "right, left out", "nearest", "separation", "first observed (UTC)"]
    return table(header, rows, "materials")


def _over_time(facts: MemoryFacts) -> str:
    if not facts.journal:
        alone = facts.learner.path is None
        why = "this memory has no path, so that nobody noted when." if alone else "its journal names no touches."
        return facts.lacks("Touches over time", why)
    times = [row.time for row in facts.journal if math.isfinite(row.time)] or [0.0]
    begin, end = min(times), max(times)
    retracted = sum(row.state == "retracted" for row in facts.journal)
    also = f" {retracted} of them were retracted: dashed." if retracted else ""
    if len(facts.counts) <= ROWS:
        rows: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in facts.counts}
        for row in facts.journal:
            if math.isfinite(row.time):
                rows.setdefault(row.material, ([], []))[row.state == "retracted"].append(row.time)
        drawn = timeline([(name, *both) for name, both in rows.items()][: 2 * ROWS], begin, end)
        caption = f"Each upright line is a touch, or several at nearly one time; {len(times)} in all.{also}"
        return figure(drawn, caption)
    counts, _ = np.histogram(times, bins=BARS, range=(begin, end if end > begin else begin + 1))
    drawn = histogram(counts.tolist(), 0, max(end - begin, 1.0), f"seconds since {dated(begin)} UTC", "touches")
    return figure(drawn, f"How many touches were observed when; {len(times)} in all, the last {dated(end)} UTC.")

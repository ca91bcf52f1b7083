"""The page of a memory: what it knows, what it mixes up, whether to trust it, and whether its sensor is well."""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Callable, Sequence
from datetime import UTC, datetime

import numpy as np

from scroll_tactile import __version__
from scroll_tactile.clients.report import drawing
from scroll_tactile.clients.report.channels import (
    channel_card,
    channel_section,
    exemplar_pictures,
    health_cards,
    health_section,
)
from scroll_tactile.clients.report.drawing import dated, shown
from scroll_tactile.clients.report.memory_facts import MOST_NEAR, Growing, MemoryFacts, bins_of, mistakes, unknown_by
from scroll_tactile.clients.report.page import Card, State, cards, figure, lines, note, page, side_by_side, table
from scroll_tactile.errors import printable
from scroll_tactile.learner import TactileLearner
from scroll_tactile.readouts.estimation import Heads
from scroll_tactile.readouts.regression import RegressionHead

__all__ = ["memory_page"]

ROWS = 40  # materials, of which each has a row in a figure; of more there are tables
SQUARE = 30  # materials, of which all pairs have a cell in a figure
MOST_MISTAKES = 60
PAIRS = 20
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
    facts, sensor = MemoryFacts(learner, risk), learner.sensor
    show = progress or (lambda what, done, of: None)
    show("touches left out", 0, STEPS)
    near, order = _alike(facts)
    known, mixed, calibrated = _known(facts), _mixed_up(facts, order), _calibration(facts)
    show("beginnings of touches", 1, STEPS)
    grown = _growing_answers(facts)
    show("channels", 2, STEPS)
    found = learner.health() if learner.has_health else None
    # What tells most comes first; when it was taught is of use to few.
    strips = exemplar_pictures(sensor, facts.kept, facts.exemplars if sensor.camera else {})
    sections = [
        ("known", "What it knows", side_by_side(f"<div>{strips}</div>", f"<div>{known}</div>")),
        ("mixed", "What it mixes up", mixed),
        ("alike", "Who is near whom", near),
        ("trust", "Whether to trust it", calibrated),
        ("growing", "How answers grow", grown),
        *([("estimated", "What it measures", _estimated(facts))] if learner.memory.quantities else []),
        *([("health", "Whether its sensor is the one that learned", health_section(found))] if found else []),
        ("channels", "Channels", channel_section(sensor, facts.kept, found, ordered=bool(facts.journal))),
        ("when", "When it was taught", _when(facts)),
    ]
    for i, axis in enumerate(learner.axes):
        by = MemoryFacts(learner, risk, axis, facts.missing)
        sections.append((f"axis-{i}", f"By {axis}", _mixed_up(by, _alike(by)[1]) + _calibration(by)))
    first = [_knows(facts), _mixes(facts), _trusts(facts), _decides(facts), channel_card(sensor, facts.kept, found)]
    if facts.missing:
        reasons = "".join(f"<li>{shown(why)}</li>" for why in dict.fromkeys(facts.missing))
        sections.append(("missing", "What is missing, and why", f"<ul>{reasons}</ul>"))
    show("written", STEPS, STEPS)
    title = name or ("A memory without a path" if learner.path is None else learner.path.name)
    return page(title, _under(learner), cards([*first, *health_cards(found)]), sections, _foot(learner))


def _under(learner: TactileLearner) -> str:
    sensor, embedding = learner.sensor, learner.embedding
    rows = learner.memory.corrections
    through = f" Its skin changed: touches are read through the adaptation in row {max(rows)}." if rows else ""
    return (
        f"A tactile memory of sensor <b>{shown(sensor.name)}</b>, {sensor.channels} channels at {sensor.rate:g} Hz; "
        f"embedding {shown(embedding.name)}, {embedding.dimension} features.{through}"
    )


def _foot(learner: TactileLearner) -> str:
    return (
        f"Made {datetime.now(UTC):%Y-%m-%d %H:%M UTC} by scroll-tactile {shown(__version__)}. Digest of the memory "
        f"<code>{learner.digest()}</code>, fingerprint of the embedding "
        f"<code>{shown(learner.embedding.fingerprint[:16])}</code>. A touch that is left "
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
        return _not_known(facts, heading)
    wrong = round((1 - trust.right) * trust.count)
    if not wrong:
        return "good", heading, "nothing", f"All {trust.count} touches left out got their own name."
    worst = mistakes(facts.held_out)[0]
    more = f"Left out one by one. Most often {worst.material}, called {worst.answer}: {worst.count} of {worst.tested}."
    return _state(trust.right), heading, f"{wrong} of {trust.count} touches", more


def _trusts(facts: MemoryFacts) -> Card:
    trust, heading = facts.trust, "Touches held out"
    if trust is None:
        return _not_known(facts, heading)
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


def _decides(facts: MemoryFacts) -> Card:
    measured, heading = facts.soon, "It decides"
    if measured is None:
        return "none", heading, "not known", "Too few touches are kept to measure it."
    wrong = measured.wrong[-1] / measured.decided[-1] if measured.decided[-1] else 0.0
    more = f"{measured.decided[-1]:.0%} are decided within {measured.seconds[-1]:.3g} s, {wrong:.0%} of these wrongly."
    if measured.median is None:
        return "look", heading, "not before the end", more
    return "good" if wrong <= 2 * facts.risk else "look", heading, f"half of touches in {measured.median:.2g} s", more


def _not_known(facts: MemoryFacts, heading: str) -> Card:
    why = facts.nothing_left_out
    return "none", heading, "not known", why[:1].upper() + why[1:]


def _state(right: float) -> State:
    return "good" if right >= RIGHT else "look" if right >= POOR else "bad"


def _known(facts: MemoryFacts) -> str:
    """The materials."""
    if not facts.counts:
        return facts.lacks("What it knows", "no touch was observed yet.")
    nearest: dict[str, tuple[str, float]] = {}
    for first, second, apart in reversed(_pairs(facts)):
        nearest[first], nearest[second] = (second, apart), (first, apart)
    began = {row.material: row.time for row in reversed(facts.journal) if row.state != "retracted"}
    tested = Counter(touch.material for touch in facts.held_out)
    right = Counter(touch.material for touch in facts.held_out if touch.said.material == touch.material)
    rows = [
        [
            name,
            count,
            f"{right[name]} of {tested[name]}" if tested[name] else None,
            *nearest.get(name, (None, None)),
            dated(began[name]) if name in began else None,
        ]
        for name, count in facts.counts.items()
    ]
    return table(
        ["material", "touches", "right, left out", "nearest", "separation", "first observed (UTC)"], rows, "materials"
    )


def _pairs(facts: MemoryFacts) -> list[tuple[str, str, float]]:
    """Each two materials and their separation, the nearest first."""
    names, separation = facts.near
    first, second = np.triu_indices(len(names), 1)
    order = np.argsort(separation[first, second], kind="stable")
    return [
        (names[i], names[j], float(separation[i, j]))
        for i, j in zip(first[order].tolist(), second[order].tolist(), strict=True)
    ]


def _when(facts: MemoryFacts) -> str:
    if not facts.journal:
        return facts.lacks("Touches over time", "its journal names no touches.")
    timed = [row for row in facts.journal if math.isfinite(row.time)]
    times = [row.time for row in timed] or [0.0]
    begin, end = min(times), max(times)
    if len(facts.counts) > ROWS:
        counts, _ = np.histogram(times, bins=BARS, range=(begin, end if end > begin else begin + 1))
        label = f"seconds since {dated(begin)} UTC"
        drawn = drawing.histogram(counts.tolist(), max(end - begin, 1.0), label, "touches")
        return figure(drawn, f"How many touches were observed when; {len(times)} in all, the last {dated(end)} UTC.")
    rows: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in facts.counts}
    for row in timed:
        rows.setdefault(row.material, ([], []))[row.state == "retracted"].append(row.time)
    drawn = drawing.timeline([(name, *both) for name, both in rows.items()][: 2 * ROWS], begin, end)
    retracted = sum(row.state == "retracted" for row in facts.journal)
    also = f" {retracted} of them were retracted: dashed." if retracted else ""
    return figure(drawn, f"Each upright line is a touch, or several at nearly one time; {len(times)} in all.{also}")


def _alike(facts: MemoryFacts) -> tuple[str, list[str]]:
    """Who is near whom, and the order of materials that brings near ones together; empty where there are many."""
    names, separation = facts.near
    if len(names) < 2:
        why = "it takes two materials, touched long enough."
        if len(facts.counts) > MOST_NEAR:
            why = f"there are more than {MOST_NEAR} materials."
        return facts.lacks("Who is near whom", why), []
    pairs = table(["material", "feels like", "separation"], _pairs(facts)[:PAIRS], "nearest pairs")
    found = f"<div><h3>Nearest pairs</h3>{pairs}</div>"
    words = (
        "Separation is the log-odds that a typical touch of one has over the other. Of touches that scatter as a bell "
        "curve, at 3 one in nine is taken for the other, at 10 one in eighty, at 20 one in a thousand."
    )
    if len(names) > ROWS:
        return note(words) + found, []
    from scipy.cluster.hierarchy import linkage
    from scipy.spatial.distance import squareform

    drawn, order = drawing.tree(names, np.asarray(linkage(squareform(separation, checks=False), "average")))
    words = f"Materials that join further to the left feel more alike (average linkage). {words}"
    return side_by_side(figure(drawn, words), found), order


def _mixed_up(facts: MemoryFacts, order: list[str]) -> str:
    """Confusions of touches left out. order: of the materials in the figure."""
    trust = facts.trust
    if trust is None:
        return facts.lacks("What it mixes up", facts.nothing_left_out)
    tested = {touch.material for touch in facts.held_out}
    words = (
        f"{trust.count} touches of {len(tested)} {facts.names} were left out one by one: {trust.right:.1%} right "
        f"(95% interval {trust.low:.1%} to {trust.high:.1%})."
    )
    if len(tested) < len(facts.counts):
        words += (
            f" Of {len(facts.counts) - len(tested)} others no touch could be left out, or none is among those sampled;"
            " nothing is called by their names here."
        )
    wrong = mistakes(facts.held_out)
    rows = [[m.material, m.answer, m.count, m.tested, f"{m.confidence:.0%}"] for m in wrong[:MOST_MISTAKES]]
    rest = len(wrong) - len(rows)
    found = note("None was called by another name.")
    if rows:
        listed = table(["touched", "called", "times", "of", "mean probability"], rows, "confusions")
        more = note(f"{rest} more confusions, none more frequent, are left out.") if rest else ""
        found = f"<div><h3>Worst confusions</h3>{listed}{more}{_one_by_one(facts)}</div>"
    if len(tested) > SQUARE:
        return note(words) + found
    names = [name for name in order or facts.counts if name in tested]
    names += sorted(tested - set(names))
    counts = Counter((touch.material, str(touch.said.material)) for touch in facts.held_out)
    drawn = figure(
        drawing.confusions(names, counts),
        "Rows: what was touched; columns, by number: what it was called. Right answers lie on the diagonal, and "
        f"{facts.names} that feel alike stand side by side.",
    )
    return note(words) + side_by_side(drawn, found)


def _one_by_one(facts: MemoryFacts) -> str:
    """The touches that were called something else, the surest first, and the lines that name them so; nothing of a
    memory whose observations nobody noted. Those that are compacted stay what they are."""
    noted = {
        (row.material if facts.of is None else row.labels.get(facts.of), row.key): row
        for row in facts.journal
        if row.state != "retracted"
    }
    wrong = [
        (touch, row)
        for touch in sorted(facts.held_out, key=lambda touch: (-touch.said.probability, touch.key))
        if touch.said.material != touch.material and (row := noted.get((touch.material, touch.key))) is not None
    ][:MOST_MISTAKES]
    if not wrong:
        return ""
    rows = [[row.sequence, row.source, t.material, t.said.material, f"{t.said.probability:.0%}"] for t, row in wrong]
    listed = table(["observation", "touch", "of", "called", "probability"], rows, "wrong touches")
    words = [
        ["scroll-tactile", "memory", "relabel", str(facts.learner.path), str(row.sequence), str(touch.said.material)]
        for touch, row in wrong
        if row.state == "kept" and facts.of is None and facts.learner.path is not None
    ]
    commands = [shlex.join(line) for line in words if all(printable(word) == word for word in line)]
    put_right = note("Where the name was wrong, and not the answer, this puts it right, exactly:") + lines(commands)
    return f"<h3>Touches it got wrong, the surest first</h3>{listed}{put_right if commands else ''}"


def _calibration(facts: MemoryFacts) -> str:
    """Calibration, and what would be called unknown."""
    trust, alarms = facts.trust, facts.learner.settings.false_alarms
    if trust is None:
        return facts.lacks("Whether to trust it", facts.nothing_left_out)
    verdict = "more than chance explains" if trust.miscalibrated else "no more than matters"
    drawn = figure(
        drawing.reliability(bins_of(facts.held_out), [touch.said.probability for touch in facts.held_out]),
        "On the dashed line a probability is what it says; dots below it are overconfident answers. Expected "
        f"calibration error (ECE) {trust.error:.3f}, {verdict}: {trust.chance:.3f} is the mean of perfect answers. "
        "Upright lines are 95% intervals.",
    )
    unknown_touches = unknown_by(facts.held_out)
    words = (
        f"Of its own touches, left out, {trust.unknown:.1%} would be called unknown; {alarms:.0%} are meant to be. A "
        "material far above that varies more than it was shown to: teach more of it."
    )
    if len(unknown_touches) <= ROWS:
        bars = [(name, unknown / count, f"{unknown} of {count} touches") for name, unknown, count in unknown_touches]
        beside = figure(drawing.shares(bars, alarms, "called unknown, left out"), words)
    else:
        rows = [[name, unknown, count] for name, unknown, count in unknown_touches if unknown]
        listed = table(["material", "called unknown", "of"], rows, "touches called unknown") if rows else ""
        beside = f"<div>{note(words)}{listed}</div>"
    return note(
        "Each touch was held out alone: others of the same sitting, sensor and hand stayed learned. Touches of "
        "another day are harder: expect more wrong ones, and more called unknown. To measure these: scroll-tactile "
        "evaluate."
    ) + side_by_side(drawn, beside)


def _growing_answers(facts: MemoryFacts) -> str:
    """How soon answers come, and how those to a few touches grow while they are felt."""
    found, why = facts.growing
    if not found:
        return facts.lacks("How answers grow", why)
    return note(
        "The probability of each material while a touch goes on, as if it had never been observed. Solid: its own "
        "material; dashed: the strongest other at any moment; upright: when it is decided, at a risk of "
        f"{facts.risk:.0%}. The first two are the hardest touches there are."
    ) + side_by_side(_soon(facts), *(_grown(touch) for touch in found))


def _soon(facts: MemoryFacts) -> str:
    measured = facts.soon
    if measured is None:
        return facts.lacks("How soon answers come", "too few touches are kept to measure it.")
    curves = {"right": measured.right, "decided": measured.decided, "decided and wrong": measured.wrong}
    return figure(
        drawing.over_time(measured.seconds, curves),
        f"Of {measured.count} touches left out, after each time: the share whose likeliest material is the true one, "
        "the share that is decided by then, and the share that was decided and is wrong (another material, or "
        "unknown).",
    )


def _grown(touch: Growing) -> str:
    names = {touch.material, *(name for at in touch.predictions for name, _ in at.ranking[:3])}
    chances = [dict(prediction.ranking) for prediction in touch.predictions]
    curves = {name: [of[name] for of in chances] for name in sorted(names)}
    end, decided = touch.predictions[-1], None
    verdict = "right" if end.material == touch.material else f"wrong, {end.material}"
    unknown = ", and called unknown" if end.known is False else ""
    if touch.decided is not None:
        at = touch.predictions[touch.decided]
        how = "unknown" if at.known is False else "right" if at.material == touch.material else "wrong"
        decided = at.seconds, f"decided after {at.seconds:.2g} s: {how}"
    drawn = drawing.answers([at.seconds for at in touch.predictions], curves, touch.material, decided)
    return figure(drawn, f"A touch of {touch.material}. At its end: {verdict}{unknown}.")


def _estimated(facts: MemoryFacts) -> str:
    """Quantities of complete touches: what was said of them held out, and how many lie in their intervals."""
    estimator, parts = facts.learner._by(facts.of).estimator(), []
    for name, heads in sorted(estimator.heads(estimator.last).items()):
        parts.append(f"<h3>{shown(name)}</h3>")
        if isinstance(heads, str):
            parts.append(facts.lacks(f"How {name} is estimated", f"{heads}."))
            continue
        unit = estimator.quantities[name].unit
        for head, of in (
            (heads.known, "each touch held out"),
            (heads.new, "each material held out, as if it were new"),
        ):
            parts.append(_against_truth(head, heads, facts.risk, unit, of))
    return "".join(parts)


def _against_truth(head: RegressionHead, heads: Heads, risk: float, unit: str, of: str) -> str:
    half, off = float(head.half_width(risk)), np.abs(head.residuals)
    rows: list[tuple[str, float, str]] = []
    for name in sorted(set(heads.materials)):
        held: Sequence[bool] = (off[np.array(heads.materials) == name] <= half).tolist()
        rows.append((name, sum(held) / len(held), f"{sum(held)} of {len(held)} touches"))
    width = "unbounded: there are too few touches" if math.isinf(half) else f"{2 * half:.3g} {unit} wide"
    said = (heads.targets - head.residuals).tolist()
    drawn = figure(
        drawing.against_truth(heads.targets.tolist(), said, half, heads.materials, unit),
        f"{len(off)} sampled touches, {of}: off by {off.mean():.3g} {unit} on average. Intervals that "
        f"are to hold {1 - risk:.0%} are {width}.",
    )
    covered = drawing.shares(rows[:ROWS], 1 - risk, "held by their interval")
    return side_by_side(drawn, figure(covered, "By material. A material far below is unlike the others."))

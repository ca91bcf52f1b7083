"""The parts of a memory's page that say how it judges: what is near, mixed up, calibrated, and how answers grow."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from scroll_tactile.clients.report.charts import (
    against_truth,
    answers,
    confusions,
    over_time,
    reliability,
    shares,
    tree,
)
from scroll_tactile.clients.report.drawing import shown
from scroll_tactile.clients.report.facts import MemoryFacts
from scroll_tactile.clients.report.growing import Growing
from scroll_tactile.clients.report.knowledge import MOST_NEAR, bins_of, unknown_by
from scroll_tactile.clients.report.page import figure, lines, note, side_by_side, table
from scroll_tactile.errors import printable
from scroll_tactile.prediction.judging import HeldOutTouch
from scroll_tactile.readouts.estimation import Heads
from scroll_tactile.readouts.regression import RegressionHead
from scroll_tactile.results import Observation

__all__ = ["ROWS", "alike", "calibration_plots", "estimated", "growing_answers", "mixed_up"]

ROWS = 40  # materials, of which each has a row in a figure; of more there are tables
SQUARE = 30  # materials, of which all pairs have a cell in a figure
MOST_MISTAKES = 60
PAIRS = 20


def alike(facts: MemoryFacts) -> tuple[str, list[str]]:
    """Who is near whom, and the order of materials that brings near ones together; empty where there are many."""
    names, separation = facts.near
    if len(names) < 2:
        many = len(facts.counts) > MOST_NEAR
        why = f"there are more than {MOST_NEAR} materials." if many else "it takes two materials, touched long enough."
        return facts.lacks("Who is near whom", why), []
    pairs = table(["material", "feels like", "separation"], _nearest(names, separation), "nearest pairs")
    found = f"<div><h3>Nearest pairs</h3>{pairs}</div>"
    words = (
        "Separation is the log-odds that a typical touch of one has over the other. Of touches that scatter as a bell "
        "curve, at 3 one in nine is taken for the other, at 10 one in eighty, at 20 one in a thousand."
    )
    if len(names) > ROWS:
        return note(words) + found, []
    drawn, order = tree(names, _joins(separation))
    caption = f"Materials that join further to the left feel more alike (average linkage). {words}"
    return side_by_side(figure(drawn, caption), found), order


def _joins(separation: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    from scipy.cluster.hierarchy import linkage
    from scipy.spatial.distance import squareform

    return np.asarray(linkage(squareform(separation, checks=False), "average"))


def _nearest(names: list[str], separation: npt.NDArray[np.float64]) -> list[list[object]]:
    first, second = np.triu_indices(len(names), 1)
    order = np.argsort(separation[first, second], kind="stable")[:PAIRS]
    return [[names[i], names[j], float(separation[i, j])] for i, j in zip(first[order], second[order], strict=True)]


def mixed_up(facts: MemoryFacts, order: list[str]) -> str:
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
    rows = [[m.material, m.answer, m.count, m.tested, f"{m.confidence:.0%}"] for m in facts.mistakes[:MOST_MISTAKES]]
    rest = len(facts.mistakes) - len(rows)
    listed = table(["touched", "called", "times", "of", "mean probability"], rows, "confusions")
    more = note(f"{rest} more confusions, none more frequent, are left out.") if rest else ""
    found = f"<div><h3>Worst confusions</h3>{listed}{more}{_one_by_one(facts)}</div>"
    found = found if rows else note("None was called by another name.")
    if len(tested) > SQUARE:
        return note(words) + found
    names = [name for name in order or facts.counts if name in tested]
    names += sorted(tested - set(names))
    place = {name: i for i, name in enumerate(names)}
    counts = np.zeros((len(names), len(names)), np.int64)
    for touch in facts.held_out:
        if touch.answer in place:
            counts[place[touch.material], place[touch.answer]] += 1
    caption = (
        "Rows: what was touched; columns, by number: what it was called. Right answers lie on the diagonal, and "
        f"{facts.names} that feel alike stand side by side."
    )
    return note(words) + side_by_side(figure(confusions(names, counts), caption), found)


def _one_by_one(facts: MemoryFacts) -> str:
    """The touches that were called something else, the surest first, and the lines that name them so; nothing of a
    memory whose observations nobody noted."""
    noted = {
        (row.material if facts.of is None else row.labels.get(facts.of), row.key): row
        for row in facts.journal
        if row.state != "retracted"
    }
    wrong = [
        (touch, row)
        for touch in sorted(facts.held_out, key=lambda touch: (-touch.confidence, touch.key))
        if touch.answer != touch.material and (row := noted.get((touch.material, touch.key))) is not None
    ][:MOST_MISTAKES]
    if not wrong:
        return ""
    rows = [[row.sequence, row.source, t.material, t.answer, f"{t.confidence:.0%}"] for t, row in wrong]
    listed = table(["observation", "touch", "of", "called", "probability"], rows, "wrong touches")
    return "<h3>Touches it got wrong, the surest first</h3>" + listed + _renaming(facts, wrong)


def _renaming(facts: MemoryFacts, wrong: Sequence[tuple[HeldOutTouch, Observation]]) -> str:
    """The lines that put right touches whose name was wrong; those that are compacted stay what they are."""
    path = facts.learner.path
    if path is None or facts.of is not None:
        return ""
    words = [["scroll-tactile", "memory", "relabel", str(path), str(row.sequence), t.answer] for t, row in wrong]
    commands = [
        shlex.join(line)
        for line, (_, row) in zip(words, wrong, strict=True)
        if row.state == "kept" and all(printable(word) == word for word in line)
    ]
    if not commands:
        return ""
    return note("Where the name was wrong, and not the answer, this puts it right, exactly:") + lines(commands)


def calibration_plots(facts: MemoryFacts) -> str:
    """Calibration, and what would be called unknown."""
    trust, alarms = facts.trust, facts.learner.settings.false_alarms
    if trust is None:
        return facts.lacks("Whether to trust it", facts.nothing_left_out)
    verdict = "more than chance explains" if trust.miscalibrated else "no more than matters"
    of = (
        "Each touch was held out alone: others of the same sitting, sensor and hand stayed learned. Touches of "
        "another day are harder: expect more wrong ones, and more called unknown. To measure these: scroll-tactile "
        "evaluate."
    )
    caption = (
        "On the dashed line a probability is what it says; dots below it are overconfident answers. Expected "
        f"calibration error (ECE) {trust.error:.3f}, {verdict}: {trust.chance:.3f} is the mean of perfect answers. "
        "Upright lines are 95% intervals."
    )
    drawn = reliability(bins_of(facts.held_out), [touch.confidence for touch in facts.held_out])
    unknown_touches = unknown_by(facts.held_out)
    words = (
        f"Of its own touches, left out, {trust.unknown:.1%} would be called unknown; {alarms:.0%} are meant to be. A "
        "material far above that varies more than it was shown to: teach more of it."
    )
    if len(unknown_touches) <= ROWS:
        bars = [(name, unknown / count, f"{unknown} of {count} touches") for name, unknown, count in unknown_touches]
        return note(of) + side_by_side(
            figure(drawn, caption), figure(shares(bars, alarms, "called unknown, left out"), words)
        )
    rows = [[name, unknown, count] for name, unknown, count in unknown_touches if unknown]
    listed = table(["material", "called unknown", "of"], rows, "touches called unknown")
    return note(of) + side_by_side(figure(drawn, caption), f"<div>{note(words)}{listed if rows else ''}</div>")


def growing_answers(facts: MemoryFacts) -> str:
    """How soon answers come, and how those to a few touches grow while they are felt."""
    found, why = facts.growing
    if not found:
        return facts.lacks("How answers grow", why)
    words = (
        "The probability of each material while a touch goes on, as if it had never been observed. Solid: its own "
        "material; dashed: the strongest other at any moment; upright: when it is decided, at a risk of "
        f"{facts.risk:.0%}. The first two are the hardest touches there are."
    )
    return note(words) + side_by_side(_soon(facts), *(_grown(touch) for touch in found))


def estimated(facts: MemoryFacts) -> str:
    """Quantities of complete touches: what was said of them held out, and how many lie in their intervals."""
    estimator = facts.estimator
    assert estimator is not None
    parts = []
    for name, heads in sorted(estimator.heads(estimator.last).items()):
        unit = estimator.quantities[name].unit
        parts.append(f"<h3>{shown(name)}</h3>")
        if isinstance(heads, str):
            parts.append(facts.lacks(f"How {name} is estimated", f"{heads}."))
            continue
        for head, of in (
            (heads.known, "each touch held out"),
            (heads.new, "each material held out, as if it were new"),
        ):
            parts.append(_against_truth(head, heads, facts.risk, unit, of))
    return "".join(parts)


def _against_truth(head: RegressionHead, heads: Heads, risk: float, unit: str, of: str) -> str:
    half, off = head.half_width(risk), np.abs(head.residuals)
    rows = [
        (name, float((off[mine] <= half).mean()), f"{int((off[mine] <= half).sum())} of {mine.sum()} touches")
        for name in sorted(set(heads.materials))
        if (mine := np.array(heads.materials) == name).any()
    ]
    width = "unbounded: there are too few touches" if np.isinf(half) else f"{2 * half:.3g} {unit} wide"
    caption = (
        f"{len(off)} sampled touches, {of}: off by {off.mean():.3g} {unit} on average. Intervals that "
        f"are to hold {1 - risk:.0%} are {width}."
    )
    said = heads.targets - head.residuals
    drawn = against_truth(heads.targets.tolist(), said.tolist(), float(half), heads.materials, unit)
    covered = shares(rows[:ROWS], 1 - risk, "held by their interval")
    return side_by_side(
        figure(drawn, caption), figure(covered, "By material. A material far below is unlike the others.")
    )


def _soon(facts: MemoryFacts) -> str:
    measured = facts.soon
    if measured is None:
        return facts.lacks("How soon answers come", "too few touches are kept to measure it.")
    lines = {"right": measured.right, "decided": measured.decided, "decided and wrong": measured.wrong}
    caption = (
        f"Of {measured.count} touches left out, after each time: the share whose likeliest material is the true one, "
        "the share that is decided by then, and the share that was decided and is wrong (another material, or unknown)."
    )
    return figure(over_time(measured.seconds, lines), caption)


def _grown(touch: Growing) -> str:
    names = sorted({touch.material, *(name for at in touch.predictions for name, _ in at.ranking[:3])})
    chances = [dict(prediction.ranking) for prediction in touch.predictions]
    lines = {name: [of[name] for of in chances] for name in names}
    end = touch.predictions[-1]
    verdict = "right" if end.material == touch.material else f"wrong, {end.material}"
    unknown = ", and called unknown" if end.known is False else ""
    caption = f"A touch of {touch.material}. At its end: {verdict}{unknown}."
    return figure(answers(touch.seconds, lines, touch.material, _moment(touch)), caption)


def _moment(touch: Growing) -> tuple[float, str] | None:
    if touch.decided is None:
        return None
    prediction, seconds = touch.predictions[touch.decided], touch.seconds[touch.decided]
    how = "unknown" if prediction.known is False else "right" if prediction.material == touch.material else "wrong"
    return seconds, f"decided after {seconds:.2g} s: {how}"

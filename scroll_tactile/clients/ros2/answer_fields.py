"""Answers of a live session by name, as JSON has them; see `Bridge`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scroll_tactile.live.answers import LiveState, LiveTouch
from scroll_tactile.results import Estimate, Prediction

__all__ = ["Answer", "answer_of", "ended", "under_way"]

Answer = Mapping[str, Any]
"""What JSON can hold; see `Bridge`."""

RANKED = 5  # materials of an answer's ranking


def under_way(event: str, now: LiveState, stamp: float, by: Mapping[str, Any]) -> Answer:
    """The answer to a touch that goes on. by: what is in each answer of a session by an axis."""
    answer = {} if now.prediction is None else answer_of(now.prediction, now.estimates)
    here = {"contact": now.contact, "seconds": now.seconds, "decided": now.decided}
    return {"event": event, "stamp": stamp, **by, **here, **answer}


def ended(touch: LiveTouch, stamp: float, by: Mapping[str, Any]) -> Answer:
    """The answer to a touch that ended."""
    over = {"contact": False, "seconds": touch.stream.seconds, "decided": touch.decided, "end": touch.end}
    over |= {"touches": 1 + len(touch.earlier)}
    return {"event": "ended", "stamp": stamp, **by, **over, **answer_of(touch.prediction, touch.estimates)}


def answer_of(prediction: Prediction, estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    """What a prediction says, and estimates by quantity."""
    measured = {"estimates": {name: own.as_json() for name, own in estimates.items()}} if estimates else {}
    more = {
        "unusual": prediction.unusual,
        "candidates": prediction.candidates(),
        "ranking": prediction.ranking_as_json(RANKED),
    }
    return prediction.as_json() | measured | more

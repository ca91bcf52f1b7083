"""The README's sections that stand beside the paper's: its Table I, its networks, efficiency and robustness."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from examples.paper.systems.catalogue import SYSTEMS
from examples.paper.tables.markdown import Read, table

__all__ = ["efficiency", "networks", "robust", "robustness", "tableone"]

SETS = ("biotac-20", "roboskin-20")
NAMES = ("BioTac-20", "RoboSkin-20")
PERTURBED = (
    ("clean", "speed", 1.0),
    ("the first 0.3 s", "length", 0.3),
    ("half the speed", "speed", 0.5),
    ("twice the speed", "speed", 2.0),
    ("a fifth of the channels dead", "dead", 0.2),
    ("uniform noise of ± half the range", "noise", 0.5),
    ("zero and gain drifting by 5 %", "drift", 0.05),
    ("another sitting: ten successive touches of fifty left out", "sitting", 0.0),
)
EPOCHS = (1, 2, 5, 10, 20)
STREAMS = (1, 2, 5, 10, 20, 40)


def tableone(read: Read) -> str:
    """The systems that are trained in minutes, in all folds."""
    rows = []
    for row in read("table1")["rows"]:
        cells = []
        for name in ("BioTac-20", "BioTac-20 blocked", "RoboSkin-20"):
            one = row["sets"][name]
            cells += [_here(one)] if "blocked" in name else [_paper(one), _here(one)]
        rows.append([row["system"], *cells])
    head = ["percent", "BioTac-20, paper", "here", "here, blocked folds", "RoboSkin-20, paper", "here"]
    return table(head, rows)


def networks(read: Read) -> str:
    """The systems that are trained over epochs, in as many folds as there was time for."""
    result = read("table1-networks")
    rows = []
    for row in result["rows"]:
        cells = [row["system"]]
        for name in NAMES:
            one = row["sets"].get(name)
            cells += (
                ["", "", ""] if one is None else [_paper(one), _here(one), f"{one['seconds'] / one['folds'] / 60:.0f}"]
            )
        rows.append(cells)
    head = [f"percent, {result['epochs']} epochs"]
    for name in NAMES:
        head += [f"{name}, paper", "here", "minutes a fold"]
    return table(head, rows)


def efficiency(read: Read) -> str:
    """Accuracy after so many epochs of the networks, and after so many touches of each material of ours."""
    curves = read("efficiency")["curves"]
    rows = []
    for by, places in (("epochs", EPOCHS), ("streams", STREAMS)):
        of = "epoch" if by == "epochs" else "touch"
        rows.append([f"**after so many {of}{'s' if of == 'epoch' else 'es'}**", *(f"**{at}**" for at in places)])
        for curve in (one for one in curves if one["by"] == by):
            shares = {int(at): mean for at, mean, _ in curve["points"]}
            shown = (f"{100 * shares[at]:.1f}" if at in shares else "" for at in places)
            rows.append([f"{curve['dataset']}: {curve['system']}", *shown])
    wide = max(len(EPOCHS), len(STREAMS))
    return table(["percent", *[""] * wide], ([*row, *[""] * (wide + 1 - len(row))] for row in rows))


def robustness(read: Read) -> str:
    """The default learner and the robust one, on touches perturbed in each way."""
    results = [read(f"robustness-{name}") for name in SETS]
    rows = []
    for words, study, strength in PERTURBED:
        cells = []
        for result in results:
            mine = _means(result, study, strength)
            cells += [_shown(mine.get(("ours", augmented))) for augmented in (False, True)]
        rows.append([words, *cells])
    head = [f"{name}, {words}" for name in NAMES for words in ("default", "`Robust`")]
    return table(["percent", *head], rows)


def robust(read: Read) -> str:
    """The paper's systems with their augmentation, and in brackets without, beside the robust learner."""
    peers = {name: read(f"robustness-peers-{name}") for name in SETS}
    systems = list(dict.fromkeys(row["system"] for result in peers.values() for row in result["means"]))
    rows = []
    for (name, result), label in zip(peers.items(), NAMES, strict=True):
        ours = read(f"robustness-{name}")
        for words, study, strength in PERTURBED:
            theirs = _means(result, study, strength)
            if not theirs:
                continue
            pairs = (_pair(theirs.get((one, True)), theirs.get((one, False))) for one in systems)
            rows.append([f"{label}: {words}", _shown(_means(ours, study, strength).get(("ours", True))), *pairs])
    return table(["percent", "ours, `Robust`", *(SYSTEMS[one] for one in systems)], rows)


def _pair(augmented: Mapping[str, Any] | None, plain: Mapping[str, Any] | None) -> str:
    return "" if augmented is None else f"{_shown(augmented)} ({_shown(plain)})"


def _means(result: Mapping[str, Any], study: str, strength: float) -> dict[tuple[str, bool], Mapping[str, float]]:
    found = [row for row in result["means"] if (row["study"], row["strength"]) == (study, strength)]
    return {(row["system"], row["augmented"]): row for row in found}


def _paper(one: Mapping[str, Any]) -> str:
    return "" if one["paper"] is None else f"{100 * one['paper']:.1f}"


def _here(one: Mapping[str, Any]) -> str:
    return _shown(one) + (" (1 fold)" if one["folds"] == 1 else "")


def _shown(one: Mapping[str, Any] | None) -> str:
    """A mean, and the standard deviation where there is more than a fold; nothing where nothing was measured."""
    if one is None:
        return ""
    share = f"{100 * one['mean']:.1f}"
    return share if one["folds"] == 1 else f"{share} ± {100 * one['sd']:.1f}"

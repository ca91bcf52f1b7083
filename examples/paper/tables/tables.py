"""The README's tables, made from the files of results, so that the two cannot come apart.

A table stands between `<!-- name -->` and `<!-- /name -->`, and is made by the function of that name in `SECTIONS` from
`<folder>/*.json`, whatever stands there now.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from examples.paper.tables.markdown import Read, Result, spread, table
from examples.paper.tables.tables_cameras import cameras
from examples.paper.tables.tables_composition import attributes, letters
from examples.paper.tables.tables_contactile import contactile
from examples.paper.tables.tables_faults import faults
from examples.paper.tables.tables_paper import efficiency, networks, robust, robustness, tableone
from examples.paper.tables.tables_transfer import sensors, tasks
from scroll_tactile.errors import InputError

__all__ = ["SECTIONS", "made_from_results"]

SETS = ("biotac-20", "roboskin-20")
BOTH = ["", "BioTac-20", "RoboSkin-20"]
# Zandonati et al. 2023, Table I and the continual experiment's floor.
PUBLISHED = {
    "ridge on the frozen vision model": ("93.8 ± 1.2", "84.8 ± 1.3"),
    "ResNet fine-tuned offline": ("98.9 ± 0.2", "96.0 ± 0.5"),
}
SIZES = ("20", "50", "100", "200", "400", "all")


def made_from_results(text: str, folder: Path) -> str:
    """The text with every section that it has made anew from the results in a folder.

    Raises InputError for a file of results that is missing or not as it was written, and for a section that is begun
    and not ended or that nothing makes.
    """

    def read(name: str) -> Result:
        path = folder / f"{name}.json"
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"expected a result in {path}: {error}") from error
        return dict(found)

    names = re.findall(r"<!-- ([a-z]+) -->", text)
    for name in names:
        if name not in SECTIONS:
            raise InputError(f"nothing makes a section {name!r}; there are {sorted(SECTIONS)}")
        begin, end = f"<!-- {name} -->\n", f"<!-- /{name} -->"
        if end not in text:
            raise InputError(f"the section {name!r} has no end: expected {end}")
        before, rest = text.split(begin, 1)
        try:
            made = SECTIONS[name](read)
        except (KeyError, StopIteration, TypeError) as error:
            raise InputError(f"the results for the section {name!r} lack {error}: make them again") from error
        text = before + begin + made + "\n" + end + rest.split(end, 1)[1]
    return text


def _results(read: Read) -> str:
    means = [read(name)["means"] for name in SETS]
    rows = [
        [
            "ridge on the frozen vision model (the paper's continual floor)",
            *PUBLISHED["ridge on the frozen vision model"],
        ],
        ["pre-trained ResNet fine-tuned offline on everything", *PUBLISHED["ResNet fine-tuned offline"]],
    ]
    shares = {
        "accuracy": "**scroll-tactile, after the last material**",
        "first": "… from the first 0.3 s of touch",
        "half": "… from half of the touch",
        "twice": "… learned from half touches, asked about whole ones",
    }
    rows += [[words, *(spread(mean[name]) for mean in means)] for name, words in shares.items()]
    parts = {
        "calibration_error": "… expected calibration error (15 bins)",
        "novelty_auroc": "… novelty AUROC, 4 of 20 materials never felt, five rotations",
    }
    rows += [[words, *(spread(mean[name], 1.0, 3) for mean in means)] for name, words in parts.items()]
    return table(BOTH, rows)


def _speed(read: Read) -> str:
    rows = [
        [
            one["case"],
            f"{one['milliseconds']:.2f}",
            one["against"],
            f"{one['against_milliseconds']:.2f}",
            f"{one['ratio']:.2f}",
            one["error"],
        ]
        for one in read("speed")["records"]
    ]
    return table(["", "ms", "beside", "ms", "ratio", "error"], rows)


def _frontier(read: Read) -> str:
    result = read("speed")
    rows = []
    for width in dict.fromkeys(one["width"] for one in result["frontier"]):
        mine = {
            (one["dataset"], one["readout"], one["length"]): one for one in result["frontier"] if one["width"] == width
        }
        cells = [f"{100 * mine[name, 'lda', length]['wrong']:.1f}" for name in BOTH[1:] for length in ("all", "0.3 s")]
        cells += [f"{100 * mine[name, 'ridge', 'all']['wrong']:.1f}" for name in BOTH[1:]]
        whole = mine["BioTac-20", "lda", "all"]
        cells += [f"{whole[name]:.1f}" for name in ("observe_ms", "predict_ms")]
        bold = "**" if width == result["knee"]["default"] else ""
        rows.append([f"{bold}{width}{bold}", *cells])
    head = ["features", *(f"{name}, {words}" for name in BOTH[1:] for words in ("wrong, %", "at 0.3 s"))]
    head += [f"{name}, ridge" for name in BOTH[1:]] + ["ms observe", "ms predict"]
    return table(head, rows)


def _peers(read: Read) -> str:
    peers = read("speed")["peers"]
    rows = []
    for name in dict.fromkeys(one["learner"] for one in peers):
        mine = {one["dataset"]: one for one in peers if one["learner"] == name}
        first = mine[BOTH[1]]
        if not first["measured"]:
            rows.append([name, f"not measured: {first['why']}", "", "", ""])
            continue
        wrong = [f"{100 * mine[dataset]['wrong']:.1f}" for dataset in BOTH[1:]]
        rows.append([name, *wrong, f"{first['observe_ms']:.2f}", f"{first['fresh_ms']:.2f}"])
    features = peers[0]["features"]
    head = [f"the same {features} features, fold 0", "BioTac-20, wrong, %", "RoboSkin-20, wrong, %"]
    return table([*head, "ms observe", "ms predict after it"], rows)


def _interleaved(read: Read) -> str:
    result = read("interleaved")
    rows = [
        [one["learner"], f"{one['milliseconds']:.1f}", f"{one['times_ours']:.1f}", f"{100 * one['wrong']:.1f}"]
        for one in result["records"]
        if one["measured"]
    ]
    head = f"{result['materials']} materials, {result['features']} features, after {result['streams']} streams"
    drift = result["drift"]
    said = (
        f"After {drift['interleavings']} pairs the weights are those solved anew to "
        f'{drift["largest_relative_difference"]:.0e}; by the paper\'s recursion (`solver="recursive"`) to '
        f"{drift['of_the_recursion']:.0e}."
    )
    return table([head, "ms a pair", "times ours", "wrong, %"], rows) + f"\n\n{said}"


def _row(result: Result, method: str, size: str | None) -> Mapping[str, Any]:
    return next(one for one in result["means"] if (one["method"], one["size"]) == (method, size))


def _continual(read: Read) -> str:
    results = [read(f"{name}-continual") for name in SETS]
    rows = [[f"paper: {words}", *figures] for words, figures in PUBLISHED.items()]
    for words, method, size in (
        ("**f, the closed form**", "f", None),
        ("f\\* of 400 exemplars (f answers where f\\* is not better)", "f*", "400"),
        ("ridge, from the same memory", "ridge", None),
        ("streaming LDA (Deep SLDA's recursion)", "streaming LDA", None),
        ("RanPAC's rule for λ", "RanPAC", None),
        ("nearest class mean", "nearest mean", None),
        ("GDumb, 400", "GDumb", "400"),
        ("experience replay, 400", "experience replay", "400"),
        ("naive fine-tuning, no memory", "naive fine-tuning", None),
    ):
        rows.append([words, *(spread(_row(result, method, size)["accuracy"]) for result in results)])
    return table(BOTH, rows)


def _buffers(read: Read) -> str:
    rows = []
    for name, words in zip(SETS, BOTH[1:], strict=True):
        result = read(f"{name}-continual")
        f = f"{100 * _row(result, 'f', None)['accuracy']['mean']:.1f}"
        rows.append([f"**{words}: f, with any buffer or none**", *[f] * len(SIZES)])
        for method, told in (
            ("f*", "f\\* (f answers where f\\* is not better)"),
            ("GDumb", "GDumb"),
            ("experience replay", "experience replay"),
        ):
            means = [_row(result, method, size)["accuracy"]["mean"] for size in SIZES]
            rows.append([f"{words}: {told}", *(f"{100 * mean:.1f}" for mean in means)])
    return table(["five folds, percent, exemplars in the buffer", *SIZES], rows)


def _vision(read: Read) -> str:
    result = read("vision")
    rows = []
    for one in result["records"]:
        if "400" in one["image"]:
            error, share = one["relative_error"], result["accuracy"].get(one["case"])
            rows.append(
                [
                    one["case"],
                    f"{one['milliseconds']:.1f}",
                    f"{one['ratio']:.2f}",
                    f"{one['ratio_to_one_thread']:.2f}",
                    "" if error is None else f"{error:.0e}",
                    "" if share is None else f"{100 * share:.1f} %",
                ]
            )
    head = ["4 s of BioTac (19 × 400), two cores", "ms", "of a bare torch forward, 2 threads", "1 thread"]
    return table([*head, "error of features", "RoboSkin, fold 0"], rows)


def _slide(read: Read) -> str:
    rows = [
        [one["part"], str(one["learned"]), str(one["tested"]), f"{100 * one['accuracy']:.1f}"]
        for one in read("fabric-slide")["parts"]
        if "→" in one["part"]
    ]
    return table(["four fabrics, learned → asked", "touches learned", "asked", "right, %"], rows)


SECTIONS: dict[str, Callable[[Read], str]] = {
    "results": _results,
    "speed": _speed,
    "frontier": _frontier,
    "peers": _peers,
    "interleaved": _interleaved,
    "continual": _continual,
    "buffers": _buffers,
    "vision": _vision,
    "tableone": tableone,
    "networks": networks,
    "efficiency": efficiency,
    "robustness": robustness,
    "robust": robust,
    "letters": letters,
    "slide": _slide,
    "attributes": attributes,
    "cameras": cameras,
    "contactile": contactile,
    "transfer": tasks,
    "sensors": sensors,
    "faults": faults,
}
"""Name → what makes the section from the results that it reads by name."""

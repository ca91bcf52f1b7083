"""The pictures of the results, drawn from the files in examples/paper/results by the code that measured them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from examples.paper.studies.continual import PUBLISHED
from examples.paper.studies.continual_picture import draw_continual
from examples.paper.studies.efficiency import draw_efficiency
from examples.paper.studies.strengths_picture import draw_robustness
from examples.paper.transfer.tasks import draw_transfer

RESULTS = Path(__file__).resolve().parents[1] / "examples/paper/results"


def _result(name: str) -> Any:
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def _trained() -> list[dict[str, Any]]:
    """The networks of Table I after each of their first twenty epochs, as `draw_efficiency` takes curves."""
    return [
        {"dataset": dataset, "by": "epochs", "system": row["system"], "points": found["points"][:20]}
        for row in _result("table1-networks")["rows"]
        for dataset, found in row["sets"].items()
    ]


def draw(folder: Path) -> None:
    """Draw all of them into a folder."""
    for dataset in ("BioTac-20", "RoboSkin-20"):
        name = dataset.lower()
        peers = sorted(path.stem for path in RESULTS.glob(f"robustness-peers-{name}*.json"))
        means = [row for peer in peers for row in _result(peer)["means"]]
        for study in ("length", "speed", "noise"):
            rows = [row for row in means if row["study"] == study]
            draw_robustness(
                folder / f"strengths-{name}-{study}.png", rows, title=f"{dataset}, trained on clean touches"
            )
        found = _result(f"{name}-continual")
        title = f"{dataset}, {found['embedding']['name']}, {found['schedule']}"
        lines = PUBLISHED.get(dataset, {})
        draw_continual(folder / f"continual-{name}.png", found["means"], title=title, lines=lines)
    draw_efficiency(folder / "efficiency.png", [*_result("efficiency")["curves"], *_trained()])
    draw_transfer(folder / "transfer-tasks.png", _result("transfer-tasks")["rows"])

"""The tools of a memory, served over standard input and output by the Model Context Protocol."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field
from scroll_tactile_store import StoreError

from scroll_tactile import __version__
from scroll_tactile.clients.planner.served import Columns, File, Place, Readings, Served, Topic
from scroll_tactile.clients.report.facts import MemoryFacts
from scroll_tactile.errors import ObservationError, ScrollTactileError
from scroll_tactile.health.diagnosis import advice, in_words
from scroll_tactile.learner import TactileLearner
from scroll_tactile.libraries import optional

__all__ = ["serve"]

RANKED = 10  # materials of an answer
FEW = 6  # touches: with fewer, each more of a material makes its answers clearly better
LISTED = 200  # materials, of which all is told at once
INSTRUCTIONS = (
    "What a robot's finger has touched: what it feels now, what it knows, and what is worth touching again. Where "
    "known is false it never felt this, and material is only the nearest; where known is null it cannot tell yet."
)

Material = Annotated[str, Field(max_length=1000)]


def serve(learner: TactileLearner, *, learn: bool = False, files: Path | None = None) -> None:
    """Serve a memory to one planner until it closes the standard input.

    learn: whether there are tools that change the memory. files: the folder in which recordings may be named; None: in
    none. Raises MissingLibraryError without the library, and InputError where files is no folder.
    """
    with optional("mcp", "mcp", "serving a memory to planners"):
        from mcp.server import MCPServer
        from mcp.server.mcpserver.exceptions import ToolError
    tools = _Tools(learner, Served(files))
    server = MCPServer("scroll-tactile", instructions=INSTRUCTIONS, version=__version__, log_level="WARNING")
    offered: list[Callable[..., Any]] = [tools.what_is_felt, tools.what_is_known, tools.what_to_touch_again]
    for tool in [*offered, tools.observe, tools.retract] if learn else offered:
        server.add_tool(_explained(tools, tool, ToolError))
    server.run("stdio")


def _explained(tools: _Tools, tool: Any, as_error: type[Exception]) -> Callable[..., Any]:
    """The tool, asked of the memory as it is by now; its errors say what was expected, others would say nothing."""

    @functools.wraps(tool)
    def explained(*values: Any, **named: Any) -> Any:
        try:
            tools.learner.refresh()  # a client keeps its server for days, and others may learn meanwhile
            return tool(*values, **named)
        except (ScrollTactileError, StoreError, OSError, MemoryError, UnicodeError) as error:
            raise as_error(tools.without_paths(str(error)) or type(error).__name__) from error

    return explained


class _Tools:
    """What a planner can ask; names, docstrings and types are what it reads."""

    def __init__(self, learner: TactileLearner, served: Served) -> None:
        self.learner, self.served = learner, served

    def without_paths(self, text: str) -> str:
        """An error's text without the paths of this machine."""
        path = self.learner.path
        return self.served.without_paths(text if path is None else text.replace(str(path), "the memory"))

    def what_is_felt(
        self,
        readings: Readings = None,
        file: File = None,
        topic: Topic = None,
        field: Place = None,
        columns: Columns = None,
        scene: list[Material] | None = None,
    ) -> dict[str, Any]:
        """Say of which material a touch is. scene: the materials that can be there; without it all that are known."""
        touch = self.learner.stream(self.served.touch(self.learner.sensor, readings, file, topic, field, columns))
        answer = self.learner.predict(touch, scene=scene)
        found: dict[str, Any] = {**answer.as_json(), "seconds": answer.seconds, "unlike": answer.unusual}
        found["ranking"] = {name: round(chance, 6) for name, chance in answer.ranking[:RANKED]}
        if self.learner.quantities:
            found["quantities"] = {name: own.as_json() for name, own in self.learner.estimate(touch).items()}
        return found

    def what_is_known(self, material: Material | None = None) -> dict[str, Any]:
        """Say what the memory knows: its sensor, materials with their touches, what they are made of; or of one."""
        learner = self.learner
        counts, described = learner.materials, learner.descriptions
        if material is not None:
            return {"touches": counts.get(material, 0), "description": described.get(material)}
        health = learner.health() if learner.has_health else None
        return {
            "sensor": learner.sensor.model_dump(mode="json", include={"name", "channels", "rate", "unit"}),
            "materials": dict(sorted(counts.items(), key=lambda pair: (-pair[1], pair[0]))[:LISTED]),
            "materials_in_all": len(counts),
            "descriptions": {name: described[name] for name in sorted(described)[:LISTED]},
            "quantities": {name: own.unit for name, own in learner.quantities.items()},
            "labels": learner.axes,
            "health": "not watched" if health is None else ". ".join(filter(None, (in_words(health), advice(health)))),
        }

    def what_to_touch_again(self, most: Annotated[int, Field(ge=1, le=LISTED)] = 10) -> list[dict[str, Any]]:
        """Say which materials are worth touching again, and why: mixed up with others, or hardly touched."""
        facts = MemoryFacts(self.learner, risk=0.05)
        why: dict[str, list[str]] = {}
        for one in facts.mistakes:
            said = f"{one.count} of {one.tested} of its touches, held out, were taken for {one.answer}"
            why.setdefault(one.material, []).append(said)
        for name, count in sorted(facts.counts.items(), key=lambda pair: (pair[1], pair[0])):
            if count < FEW:
                why.setdefault(name, []).append(f"touched {count} times only")
        return [{"material": name, "touches": facts.counts[name], "why": each} for name, each in why.items()][:most]

    def observe(
        self,
        material: Material,
        readings: Readings = None,
        file: File = None,
        topic: Topic = None,
        field: Place = None,
        columns: Columns = None,
    ) -> dict[str, Any]:
        """Learn that a touch is of this material, durably. Of what it had already nothing is learned twice."""
        touch = self.learner.stream(self.served.touch(self.learner.sensor, readings, file, topic, field, columns))
        receipt = self.learner.observe(material, touch, source=file)
        return {"observation": receipt.sequence, "material": receipt.material, "repeated": receipt.repeated}

    def retract(self, observation: int) -> dict[str, Any]:
        """Take an observation out of the memory again, by the number that observe gave; as if it had never been."""
        if all(row.sequence != observation for row in self.learner.observations()):  # adaptations have numbers, too
            raise ObservationError(
                f"expected the number that observe gave; came {observation}, which no observation has"
            )
        self.learner.retract(observation)
        return {"retracted": observation}

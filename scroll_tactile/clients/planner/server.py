"""The tools of a memory, served over standard input and output by the Model Context Protocol."""

from __future__ import annotations

import functools
import json
import math
import os
import sys
from collections.abc import AsyncIterator, Callable
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field
from pydantic_core import from_json
from scroll_tactile_store import StoreError

from scroll_tactile import __version__
from scroll_tactile.clients.report.memory_facts import MemoryFacts, mistakes
from scroll_tactile.errors import InputError, ObservationError, ScrollTactileError
from scroll_tactile.health.diagnosis import advice, in_words
from scroll_tactile.learner import TactileLearner
from scroll_tactile.libraries import optional
from scroll_tactile.recordings import read
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.facts import fact_warnings
from scroll_tactile.signals.stream import Stream

__all__ = ["serve"]

RANKED = 10  # materials of an answer
FEW = 6  # touches: with fewer, each more of a material makes its answers clearly better
LISTED = 200  # materials, of which all is told at once
INSTRUCTIONS = (
    "What a robot's finger has touched: what it feels now, what it knows, and what is worth touching again. Where "
    "known is false it never felt this, and material is only the nearest; where known is null it cannot tell yet."
)
MOST_VALUES = 2**20  # numbers in the readings of one call: a minute of 100 channels at 170 Hz
LARGEST = 2**28  # bytes of a recording

Readings = Annotated[
    list[list[float]] | None, Field(description="Rows of one touch in time, each with the sensor's channels.")
]
Text = Annotated[str, Field(max_length=1000)]
Material = Text
File = Annotated[Text | None, Field(description="In place of readings: a recording in the served folder, by its path.")]
Topic = Annotated[Text | None, Field(description="Of a file with several topics: the one to read.")]
Place = Annotated[Text | None, Field(description="Of a file with several fields: the one to read.")]
Columns = Annotated[Text | None, Field(description="Of a file with more channels: those to take, such as 0:2.")]


def serve(learner: TactileLearner, *, learn: bool = False, files: Path | None = None) -> None:
    """Serve a memory to one planner until it closes the standard input.

    learn: whether there are tools that change the memory. files: the folder in which recordings may be named; None: in
    none. Raises MissingLibraryError without the library, and InputError where files is no folder.
    """
    with optional("mcp", "mcp", "serving a memory to planners"):
        import anyio
        from mcp.server import MCPServer
        from mcp.server.mcpserver.exceptions import ToolError
        from mcp.server.mcpserver.tools import Tool
    tools = _Tools(learner, Served(files))
    offered: list[Callable[..., Any]] = [tools.what_is_felt, tools.what_is_known, tools.what_to_touch_again]
    offered += [tools.observe, tools.retract] if learn else []
    made = [Tool.from_function(_explained(tools, tool, ToolError)) for tool in offered]
    for tool in made:  # true or "1" is no number, and an argument that there is not is refused by its name
        model, how = tool.fn_metadata.arg_model, ConfigDict(extra="forbid", strict=True)
        strict: Any = type(model.__name__, (model,), {"model_config": how, "__module__": __name__})
        tool.fn_metadata.arg_model, tool.parameters = strict, strict.model_json_schema(by_alias=True)
    server = MCPServer(
        "scroll-tactile", instructions=INSTRUCTIONS, version=__version__, log_level="WARNING", tools=made
    )
    anyio.run(_answer_lines, server)


async def _answer_lines(server: Any) -> None:
    """Serve over standard input and output; a line that is no JSON is answered by an error, where MCP is silent."""
    import anyio
    from mcp.server.stdio import stdio_server
    from mcp.shared.message import SessionMessage
    from mcp_types import ErrorData, JSONRPCError

    async def lines() -> AsyncIterator[str]:
        async for line in anyio.wrap_file(TextIOWrapper(sys.stdin.buffer, encoding="utf-8", errors="replace")):
            try:
                from_json(line)
            except ValueError as error:
                said = ErrorData(code=-32700, message=f"expected a message in JSON: {error}")
                await outgoing.send(SessionMessage(JSONRPCError(jsonrpc="2.0", id=_number_of(line), error=said)))
            else:
                yield line

    given: Any = lines()
    async with stdio_server(stdin=given) as (incoming, outgoing):
        inner = server._lowlevel_server  # as MCPServer.run does, which takes no other input
        await inner.run(incoming, outgoing, inner.create_initialization_options())


def _number_of(line: str) -> int | None:
    """The number of a request that is JSON but for a lone half of a surrogate pair; None where it has none."""
    try:
        number = json.loads(line)["id"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return number if type(number) is int else None


def _explained(tools: _Tools, tool: Any, as_error: type[Exception]) -> Callable[..., Any]:
    """The tool, asked of the memory as it is by now; its errors say what was expected, others would say nothing."""

    @functools.wraps(tool)
    def explained(*values: Any, **named: Any) -> Any:
        try:
            tools.learner.refresh()  # a client keeps its server for days, and others may learn meanwhile
            return tool(*values, **named)
        except (ScrollTactileError, StoreError, OSError, MemoryError) as error:
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
        with fact_warnings() as facts:
            touch = self.learner.stream(self.served.touch(self.learner.sensor, readings, file, topic, field, columns))
        facts += map(str, self.learner._facts_of(touch))
        answer = self.learner.predict(touch, scene=scene)
        found: dict[str, Any] = {**answer.as_json(), "seconds": answer.seconds, "unlike": answer.unusual}
        found |= {"facts": facts} if facts else {}
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
        for one in mistakes(facts.held_out):
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
        with fact_warnings() as facts:
            touch = self.learner.stream(self.served.touch(self.learner.sensor, readings, file, topic, field, columns))
            receipt = self.learner.observe(material, touch, source=file)
        found = {"observation": receipt.sequence, "material": receipt.material, "repeated": receipt.repeated}
        return found | ({"facts": facts} if facts else {})

    def retract(self, observation: int) -> dict[str, Any]:
        """Take an observation out of the memory again, by the number that observe gave; as if it had never been."""
        if all(row.sequence != observation for row in self.learner.observations()):  # adaptations have numbers, too
            raise ObservationError(
                f"expected the number that observe gave; came {observation}, which no observation has"
            )
        self.learner.retract(observation)
        return {"retracted": observation}


class Served:
    """A folder of recordings, or None where none is served. Raises InputError for what is no folder."""

    def __init__(self, folder: Path | None) -> None:
        if folder is not None and not folder.is_dir():
            raise InputError(f"expected a folder of recordings as files={str(folder)!r}; there is none")
        self._folder = None if folder is None else folder.resolve()

    def touch(
        self, sensor: Sensor, readings: Readings, file: File, topic: Topic, field: Place, columns: Columns
    ) -> Stream | list[list[float]]:
        """One touch, by its readings or by a recording in the folder. Raises InputError for both, for neither and for
        too many readings, and what `read` and `Recording.stream` raise."""
        if (readings is None) == (file is None) or (file is None and any((topic, field, columns))):
            raise InputError("expected readings or a file, one of them; topic, field and columns are of a file")
        if readings is None:
            return read(self._place(str(file)), topic=topic, field=field, columns=columns).stream(sensor)
        if sum(map(len, readings)) > MOST_VALUES:
            raise InputError(f"expected at most {MOST_VALUES} numbers in a touch; cut it, or name a file")
        return readings

    def without_paths(self, text: str) -> str:
        """An error's text as a planner is to read it: the folder is not named."""
        return text if self._folder is None else text.replace(f"{self._folder}{os.sep}", "")

    def _place(self, file: str) -> Path:
        """A recording in the folder, wherever its links lead. Raises InputError for any other."""
        if self._folder is None:
            raise InputError("no folder of recordings is served: start with --files FOLDER, or give readings")
        place = self._folder if "\0" in file else (self._folder / file).resolve()
        if self._folder not in place.parents or _bytes(place) > LARGEST:
            raise InputError(
                f"expected a recording in the served folder, a file or the folder of one without links in it, of at "
                f"most {LARGEST >> 20} MB; came {file!r:.80}"
            )
        return place


def _bytes(place: Path) -> float:
    """Of a file, or of what a folder has; infinite for anything else, and where a link in it could lead elsewhere."""
    if place.is_file():
        return place.stat().st_size
    total = 0.0 if place.is_dir() else math.inf
    for folder, folders, files in os.walk(place):
        for name in (*folders, *files):
            inside = Path(folder, name)
            total += math.inf if inside.is_symlink() else inside.stat().st_size
        if total > LARGEST:
            break
    return total

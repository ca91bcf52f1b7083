"""`scroll-tactile mcp`, a real process, and the client of the protocol's own package."""

import json
import os
import subprocess
import sys
from pathlib import Path

import anyio
import numpy as np
import pytest
from commands import refused
from live_touches import slide
from robot_sets import FIELD, robot_set
from touches import PAD, SMALL

from scroll_tactile import Quantity, TactileLearner
from scroll_tactile.clients.planner import server
from scroll_tactile.errors import InputError, ObservationError

pytest.importorskip("mcp", reason="the extra mcp is not installed")

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place, random = tmp_path_factory.mktemp("planner"), np.random.default_rng(1)
    with TactileLearner.open(place / "memory", sensor=PAD, embedding=SMALL) as learner:
        learner.declare(Quantity(name="force", unit="N", low=0.0, high=10.0, resolution=0.01))
        learner.describe("a", {"cotton": 1.0})
        for repetition in range(8):
            for material in "abc" if repetition < 3 else "ab":
                learner.observe(material, slide(material, 50, random), values={"force": 1.0 + repetition})
    (place / "files" / "day").mkdir(parents=True)
    np.save(place / "files" / "day" / "t.npy", slide("b", 50, np.random.default_rng(5)))
    np.save(place / "outside.npy", slide("b", 50, random))
    (place / "files" / "link.npy").symlink_to(place / "outside.npy")
    return place


def talk(folder, *options, calls=()):
    """The names of the tools, and what each call gives: its content, or the text of its error."""
    from mcp.client.client import Client
    from mcp.client.stdio import StdioServerParameters, stdio_client

    words = ["-m", "scroll_tactile.clients.cli", "mcp", str(folder / "memory"), *map(str, options)]
    process = StdioServerParameters(
        command=sys.executable, args=words, env={"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'store'}"}
    )

    async def session():
        async with Client(stdio_client(process)) as client:
            names = [tool.name for tool in (await client.list_tools()).tools]
            results = [await client.call_tool(name, arguments) for name, arguments in calls]
        return names, results

    names, results = anyio.run(session)
    return names, [each.content[0].text if each.is_error else each.structured_content for each in results]


def test_what_is_felt_known_and_to_be_touched_again(folder):
    touch = slide("b", 50, np.random.default_rng(5))
    calls = [
        ("what_is_felt", {"readings": touch.tolist()}),
        ("what_is_felt", {"file": "day/t.npy"}),
        ("what_is_felt", {"readings": touch.tolist(), "scene": ["a", "c"]}),
        ("what_is_known", {}),
        ("what_is_known", {"material": "a"}),
        ("what_to_touch_again", {}),
    ]
    names, answers = talk(folder, "--files", folder / "files", calls=calls)
    assert names == ["what_is_felt", "what_is_known", "what_to_touch_again"]
    with TactileLearner.open(folder / "memory", mode="read") as learner:
        expected, force = learner.predict(touch), learner.estimate(touch)["force"]
    felt, of_file, within, known, one, again = answers
    assert (felt["material"], felt["probability"], felt["known"]) == (
        "b",
        expected.as_json()["probability"],
        expected.known,
    )
    assert felt["quantities"]["force"]["value"] == pytest.approx(force.value)
    assert of_file == felt
    assert set(within["ranking"]) == {"a", "c"}
    assert known["materials"] == {"a": 8, "b": 8, "c": 3} and known["quantities"] == {"force": "N"}
    assert known["sensor"]["channels"] == 2 and "no change of the sensor" in known["health"]
    assert one == {"touches": 8, "description": {"cotton": 1.0}}
    assert [each["material"] for each in again["result"]] == ["c"]
    assert "touched 3 times only" in again["result"][0]["why"]


def test_what_cannot_be_is_a_tools_error_that_says_what_to_do(folder):
    files = [("what_is_felt", {"file": name}) for name in ("../outside.npy", "link.npy", ".", "/dev/zero", "a\0b")]
    calls = [
        ("what_is_felt", {}),
        ("what_is_felt", {"readings": [[0.5, 0.5]] * 9, "file": "day/t.npy"}),
        ("what_is_felt", {"readings": [[0.1, 0.2, 0.3]] * 5}),
        ("what_is_felt", {"readings": [[0.1, 0.2], [0.1]]}),
        ("what_is_felt", {"readings": [[0.5, 0.5]] * 4, "scene": ["nothing"]}),
        ("what_is_felt", {"readings": "no numbers"}),
        ("what_is_felt", {"file": "day/t.npy", "field": "a" + " " * 5000 + "x"}),
        ("what_to_touch_again", {"most": 10**9}),
        ("observe", {"material": "d", "readings": [[0.5, 0.5]] * 9}),
        *files,
    ]
    _, answers = talk(folder, "--files", folder / "files", calls=calls)
    told = [
        "one of them",
        "one of them",
        "(T, 2)",
        "Were values lost",
        "nothing",
        "readings",
        "1000",
        "most",
        "observe",
    ] + ["in the served folder"] * 5
    for (name, arguments), answer, words in zip(calls, answers, told, strict=True):
        assert isinstance(answer, str) and words in answer, (name, arguments, answer)
        assert str(folder) not in answer


def test_only_with_learn_it_observes_and_retracts(folder, tmp_path):
    with TactileLearner.open(tmp_path / "memory", sensor=PAD, embedding=SMALL) as learner:
        before = learner.digest()
    readings = slide("a", 50, np.random.default_rng(9)).tolist()
    names, answers = talk(
        tmp_path,
        "--learn",
        calls=[
            ("observe", {"material": "silk", "readings": readings}),
            ("observe", {"material": "silk", "readings": readings}),
            ("what_is_known", {"material": "silk"}),
            ("retract", {"observation": 1}),
            ("retract", {"observation": 1}),
            ("what_is_felt", {"file": "t.npy"}),
        ],
    )
    assert names[3:] == ["observe", "retract"]
    learned, repeated, known, gone, again, file = answers
    assert learned == {"observation": 1, "material": "silk", "repeated": False} and repeated["repeated"]
    assert known["touches"] == 1 and gone == {"retracted": 1}
    assert "retracted" in again and "--files" in file
    with TactileLearner.open(tmp_path / "memory", mode="read") as learner:
        assert learner.digest() == before and learner.materials == {}
    with TactileLearner.open(tmp_path / "other", sensor=PAD, embedding=SMALL) as learner:
        server._Tools(learner, server.Served(folder / "files")).observe("b", file="day/t.npy")
        assert [each.source for each in learner.observations()] == ["day/t.npy"]


def test_arguments_of_another_type_and_those_that_there_are_not_are_refused(tmp_path):
    with TactileLearner.open(tmp_path / "memory", sensor=PAD, embedding=SMALL) as learner:
        learner.observe("silk", slide("a", 50, np.random.default_rng(9)))
    wrong = [
        *(("retract", {"observation": number}, "valid integer") for number in (True, "1", 1.0)),
        ("retract", {"observation": 1, "material": "silk"}, "material\n  Extra inputs are not permitted"),
        ("what_is_known", {"colour": "red"}, "colour\n  Extra inputs are not permitted"),
        ("what_to_touch_again", {"most": "3"}, "valid integer"),
        ("what_is_felt", {"readings": [["0.5", True]] * 9}, "valid number"),
    ]
    _, answers = talk(tmp_path, "--learn", calls=[call[:2] for call in wrong])
    for answer, (*_, said) in zip(answers, wrong, strict=True):
        assert isinstance(answer, str) and said in answer
    with TactileLearner.open(tmp_path / "memory", mode="read") as learner:
        assert learner.materials == {"silk": 1}


def test_each_line_has_an_answer(folder):
    """Half of a surrogate pair is no text in JSON, for the protocol's own package, which says nothing of it."""
    known = {"name": "what_is_known", "arguments": {"material": "a\ud800"}}
    client = {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": {"name": "raw", "version": "1"}}
    requests = [
        {"id": 1, "method": "initialize", "params": client},
        {"id": 2, "method": "tools/call", "params": known},
        {"id": "\ud800", "method": "tools/call", "params": known},
        {"id": 3, "method": "ping"},
    ]
    lines = [json.dumps({"jsonrpc": "2.0", **each}) for each in requests]
    words = [sys.executable, "-m", "scroll_tactile.clients.cli", "mcp", str(folder / "memory")]
    paths = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'store'}"}
    with subprocess.Popen(words, env=paths, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        said = []
        for line in [*lines, "{", "[" * 9999]:
            process.stdin.write(f"{line}\n")
            process.stdin.flush()
            said.append(json.loads(process.stdout.readline()))
        process.stdin.close()
        assert process.wait(60) == 0
    assert [each["id"] for each in said] == [1, 2, None, 3, None, None]
    assert all("expected a message in JSON" in said[i]["error"]["message"] for i in (1, 2, 4, 5))


def test_a_planner_can_follow_what_it_is_told_of_a_file(folder, tmp_path):
    import h5py

    touch = slide("b", 50, np.random.default_rng(5))
    with h5py.File(tmp_path / "two.h5", "w") as file:
        file["left"], file["right"] = touch, touch[::-1]
    np.save(tmp_path / "wide.npy", np.hstack([touch, touch]))
    robot_set(tmp_path / "set", [("b", touch)])
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "metadata.yaml").symlink_to(folder / "outside.npy")
    calls = [
        {"file": "two.h5"},
        {"file": "two.h5", "field": "left"},
        {"file": "wide.npy"},
        {"file": "wide.npy", "columns": "0:2"},
        {"file": "set"},
        {"file": "set", "field": FIELD},
        {"file": "linked"},
        {"readings": touch.tolist(), "field": "left"},
    ]
    _, answers = talk(folder, "--files", tmp_path, calls=[("what_is_felt", each) for each in calls])
    several, left, wide, some, episodes, whole, linked, both = answers
    assert "such as field='left'" in several and "columns='0:2'" in wide
    assert left["material"] == some["material"] == episodes["material"] == whole["material"] == "b"
    assert "without links" in linked and "are of a file" in both
    for told in (several, wide, linked):
        assert str(tmp_path) not in told and str(folder) not in told


def test_it_answers_from_the_memory_as_it_is_by_now_and_retracts_observations_alone(tmp_path):
    random = np.random.default_rng(1)
    with TactileLearner.open(tmp_path / "memory", sensor=PAD, embedding=SMALL) as learner:
        learner.observe("a", slide("a", 50, random))
        learner.describe("a", {"cotton": 1.0})
        with TactileLearner.open(tmp_path / "memory", mode="read") as reader:
            tools = server._Tools(reader, server.Served(None))
            known = server._explained(tools, tools.what_is_known, ValueError)
            assert known("b")["touches"] == 0
            learner.observe("b", slide("b", 50, random))
            assert known("b")["touches"] == 1
        tools = server._Tools(learner, server.Served(None))
        with pytest.raises(ObservationError, match="the number that observe gave"):
            tools.retract(2)  # the description
        assert tools.retract(3) == {"retracted": 3} and learner.materials == {"a": 1}


def test_a_call_is_bounded(folder, monkeypatch):
    monkeypatch.setattr(server, "MOST_VALUES", 10)
    monkeypatch.setattr(server, "LARGEST", 10)
    with TactileLearner.open(folder / "memory", mode="read") as learner:
        tools = server._Tools(learner, server.Served(folder / "files"))
        monkeypatch.setattr(server, "FEW", 10)
        again = tools.what_to_touch_again()
        assert len(again) == 3 and tools.what_to_touch_again(2) == again[:2]
        with pytest.raises(InputError, match="at most 10 numbers"):
            tools.what_is_felt([[0.0, 1.0]] * 6)
        with pytest.raises(InputError, match="expected a recording"):
            tools.what_is_felt(file="day/t.npy")


def test_what_cannot_be_served_is_one_red_line(folder):
    assert "expected a folder" in refused("mcp", folder / "memory", "--files", folder / "nothing")
    assert "no memory" in refused("mcp", folder / "nothing")

"""Doubles of the names that launch files use, and the command that launch would run for a file's node.

The packages launch and launch_ros have no wheels. What is kept of them here is what their documentation promises: an
argument's value or default takes its substitution's place, and a node is its executable with its arguments, behind
--ros-args its name and namespace, and its parameters, files as they are and dictionaries as files.
"""

import json
import runpy
import sys
from types import ModuleType


class Argument:
    def __init__(self, name, default_value=None, description=""):
        assert description
        self.name, self.default = name, default_value


class Value:
    def __init__(self, name):
        self.name = name


class Node:
    def __init__(self, *, executable, arguments, name, namespace, parameters, output="log"):
        self.words, self.name, self.namespace, self.parameters = [executable, *arguments], name, namespace, parameters


class Event:
    def __init__(self, **fields):
        vars(self).update(fields)


def doubles(monkeypatch):
    """Put the doubles where launch files import from."""
    names = {
        "launch": {"LaunchDescription": list},
        "launch.actions": {"DeclareLaunchArgument": Argument, "EmitEvent": Event, "RegisterEventHandler": list},
        "launch.events": {"matches_action": id},
        "launch.substitutions": {"LaunchConfiguration": Value},
        "launch_ros": {},
        "launch_ros.actions": {"Node": Node, "LifecycleNode": Node},
        "launch_ros.event_handlers": {"OnStateTransition": lambda **fields: [Event(**fields)]},
        "launch_ros.events": {},
        "launch_ros.events.lifecycle": {"ChangeState": Event},
    }
    for name, found in names.items():
        module = ModuleType(name)
        vars(module).update(found)
        monkeypatch.setitem(sys.modules, name, module)


def launched(file, folder, **given):
    """The words of the command that a launch file's node is, with these launch arguments, and its transitions."""
    entities = runpy.run_path(str(file))["generate_launch_description"]()
    arguments = {each.name: given.get(each.name, each.default) for each in entities if isinstance(each, Argument)}
    assert given.keys() <= arguments.keys() and None not in arguments.values()
    [node] = [each for each in entities if isinstance(each, Node)]

    def of(value):
        return arguments[value.name] if isinstance(value, Value) else value

    words = [*node.words, "--ros-args", "-r", f"__node:={node.name}"]
    if of(node.namespace):
        words += ["-r", f"__ns:={of(node.namespace)}"]
    for i, each in enumerate(node.parameters):
        if isinstance(each, dict):
            file = folder / f"launch_{i}.yaml"
            lines = [f"    {key}: {json.dumps(of(value))}\n" for key, value in each.items()]
            file.write_text(f"/**:\n  ros__parameters:\n{''.join(lines)}")
        words += ["--params-file", str(file if isinstance(each, dict) else of(each))]
    first = [each.event for each in entities if isinstance(each, Event)]
    handled = [handler for each in entities if isinstance(each, list) for handler in each]
    later = [entity.event for handler in handled for entity in handler.entities if handler.goal_state == "inactive"]
    assert all(event.lifecycle_node_matcher == id(node) for event in (*first, *later))
    assert all(handler.target_lifecycle_node is node for handler in handled)
    return words, [event.transition_id for event in (*first, *later)]

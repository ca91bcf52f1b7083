"""Doubles of the names that launch files use, and the commands that launch would run for a file's nodes.

The packages launch and launch_ros have no wheels. What is kept of them here is what their documentation promises: an
argument's value or default takes its substitution's place, a list of substitutions is one text, and a node is its
executable with its arguments, behind --ros-args its name and namespace, and its parameters, files as they are and
dictionaries as files.
"""

import json
import re
import runpy
import sys
from types import ModuleType, SimpleNamespace


def argument(name, default_value=None, *, description):
    return name, default_value


def launched(monkeypatch, file, folder, **given):
    """The words of the command that each node of a launch file is, with these launch arguments."""
    names = {
        "launch": {"LaunchDescription": list},
        "launch.actions": {"DeclareLaunchArgument": argument},
        "launch.substitutions": {"LaunchConfiguration": "<{}>".format},
        "launch_ros": {},
        "launch_ros.actions": {"Node": SimpleNamespace},
    }
    for name, found in names.items():
        module = ModuleType(name)
        vars(module).update(found)
        monkeypatch.setitem(sys.modules, name, module)
    entities = runpy.run_path(str(file))["generate_launch_description"]()
    defaults = dict(each for each in entities if isinstance(each, tuple))
    arguments = defaults | given
    assert defaults.keys() == arguments.keys() and None not in arguments.values()

    def of(value):
        text = "".join(value) if isinstance(value, list) else value
        return re.sub("<(.+?)>", lambda found: arguments[found[1]], text) if isinstance(text, str) else text

    def words(number, node):
        made = [node.executable, *node.arguments, "--ros-args", "-r", f"__node:={node.name}"]
        made += ["-r", f"__ns:={of(node.namespace)}"] if of(node.namespace) else []
        for i, each in enumerate(node.parameters):
            place = of(each) if not isinstance(each, dict) else folder / f"launch_{number}_{i}.yaml"
            if isinstance(each, dict):
                lines = [f"    {key}: {json.dumps(of(value))}\n" for key, value in each.items()]
                place.write_text(f"/**:\n  ros__parameters:\n{''.join(lines)}")
            made += ["--params-file", str(place)]
        return made

    nodes = [each for each in entities if not isinstance(each, tuple)]
    return [words(i, node) for i, node in enumerate(nodes)]

import inspect
import pickle
import re
from pathlib import Path

import pytest
from scroll_tactile_store import exceptions

from scroll_tactile import errors
from scroll_tactile.errors import ScrollTactileError, UnknownMaterialError


def classes():
    found = [item for item in vars(errors).values() if inspect.isclass(item)]
    return [item for item in found if not issubclass(item, Warning)]


def drawn():
    """(name, parent, other base) for each line of the tree in the module's docstring."""
    parents = {}
    for line in errors.__doc__.splitlines():
        match = re.match(r"    ([│├└─ ]*)(\w+Error)\s*(?:\((\w+)\))?", line)
        if match:
            branch, name, other = match.groups()
            depth = len(branch) // 4
            parents[depth] = name
            yield name, parents.get(depth - 1), other


def test_the_tree_drawn_in_the_docstring_is_the_tree():
    actual = {(c.__name__, *[base.__name__ for base in c.__bases__]) for c in classes()}
    assert {tuple(part for part in line if part) for line in drawn()} == actual


def test_every_error_is_a_scroll_tactile_error_with_a_docstring():
    assert classes()
    for error in classes():
        assert issubclass(error, ScrollTactileError)
        assert error.__doc__


@pytest.mark.parametrize("error", classes())
def test_messages_read_as_written_and_survive_pickling(error):
    message = "expected 'a' or\n'b'; came “c”"
    assert str(error(message)) == message
    again = pickle.loads(pickle.dumps(error(message)))
    assert type(again) is error
    assert str(again) == message


OF_DAMAGE = {"path": Path("log"), "sequence": 7, "offset": 4096, "frame": 3}


@pytest.mark.parametrize("error", [each for name, each in vars(exceptions).items() if name.endswith("Error")])
def test_an_error_of_the_store_comes_whole_from_another_process(error):
    fields = OF_DAMAGE if error is exceptions.DamageError else {}
    again = pickle.loads(pickle.dumps(error("row 7 is damaged", **fields)))
    assert (type(again), again.args, vars(again)) == (error, ("row 7 is damaged",), fields)


def test_an_unknown_material_is_caught_as_key_error_and_as_value_error():
    for kind in (KeyError, ValueError, errors.InputError):
        with pytest.raises(kind, match=r"^never observed: 'wool'$"):
            raise UnknownMaterialError("never observed: 'wool'")

"""Settings of a learner, and checks of names and scenes that are passed to it."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Sequence
from collections.abc import Set as AbstractSet
from typing import Annotated, Any, Literal, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from scroll_tactile.errors import InputError, MaterialError, UnknownMaterialError

__all__ = [
    "GONE",
    "LONGEST_NAME",
    "LONGEST_SOURCE",
    "Settings",
    "ValidatedFields",
    "candidates_of",
    "names_of",
    "require_name",
    "require_source",
]

LONGEST_NAME = 200  # characters
LONGEST_SOURCE = 1000

GONE = {
    "again": "A touch is learned once: readings that a memory has already are not counted anew.",
    "shared": "Merging makes a memory of the touches of both: one that both observed is counted once.",
    "augmentation": "A touch is learned as it was felt; fine-tuning makes its varied copies by itself.",
    "runtime": "Vision runs in torch.",
    "precision": "Vision computes in float32.",
    "annotate": "examples/lerobot_annotate.py writes a new LeRobot data set with answers.",
    "mcap": "live --json prints each answer as a line; examples/rerun_live.py shows a session.",
    "rerun": "examples/rerun_live.py shows a session in Rerun.",
    "finger": "A node has one finger: start one for each, in namespaces, by --ros-args -r __ns:=/left.",
}
"""Settings, options and commands of earlier versions, and what is there in their place."""


class ValidatedFields(BaseModel):
    """Fields that are validated once and never change; raises InputError for what does not fit."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    def __init__(self, **fields: Any) -> None:
        try:
            super().__init__(**fields)
        except ValidationError as error:
            loc = error.errors()[0]["loc"]
            raise InputError(_described(error, type(self)), argument=str(loc[0]) if loc else None) from None


class Settings(ValidatedFields):
    """How a learner reads its memory; all but `kept_touches` and `exemplars` can differ at every opening.

    readout: "lda" or "ridge" (the paper's); both are computed from the same statistics.
    false_alarms: the share of touches of known materials that may be called unknown, between 0 and 1.
    kept_touches: touches that are kept, as small integers, to compare a touch with that was felt through noise or dead
    channels, or at another speed. 0 keeps none. None is as many as 16 MB hold, at most 1000, and none for a camera.
    exemplars: streams in the buffer that `fine_tune` trains on; three times as many are kept raw, to choose from. 0
    keeps none. None is 400, and none for a camera, whose frames are large (480 × 640: 4 MB).

    Raises InputError for anything else.
    """

    readout: Literal["lda", "ridge"] = "lda"
    false_alarms: Annotated[float, Field(gt=0, lt=1, strict=False)] = 0.05
    kept_touches: Annotated[int, Field(ge=0)] | None = None
    exemplars: Annotated[int, Field(ge=0)] | None = None


def _described(error: ValidationError, model: type[BaseModel]) -> str:
    """The first thing wrong, with what was expected and what came."""
    first = error.errors()[0]
    name = str(first["loc"][0]) if first["loc"] else model.__name__
    if first["type"] == "extra_forbidden":
        if name in GONE:
            return f"{name!r} is gone. {GONE[name]}"
        return f"{name!r} is no setting of {model.__name__}; there are {', '.join(model.model_fields)}"
    if first["type"] == "missing":
        return f"{model.__name__} needs {name}"
    what = first["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    return f"expected {name} to be {what}; came {first['input']!r:.80}"


def require_name(material: str) -> str:
    """The name of a material, of no subclass of str such as numpy's; raises MaterialError for what cannot be one.

    Spaces around it go, and letters with marks are composed (NFC): what prints alike is one material.
    """
    if not isinstance(material, str):
        raise MaterialError(f"expected a material's name as a string; came {type(material).__name__} {material!r:.60}")
    material = _composed(material)
    if not material or len(material) > LONGEST_NAME:
        raise MaterialError(
            f"expected a name of 1 to {LONGEST_NAME} characters; came {len(material)}", argument="material"
        )
    if not material.isprintable():
        raise MaterialError(f"expected a name of printable characters; came {material!r}", argument="material")
    return str(material)


def _composed(name: str) -> str:
    return unicodedata.normalize("NFC", name.strip())


def require_source(source: str) -> str:
    """Where a touch comes from, as a str and no subclass; raises InputError for what `observe` does not keep."""
    if not isinstance(source, str):
        raise InputError(f"expected source as a string; came {type(source).__name__} {source!r:.60}")
    if not (0 < len(source) <= LONGEST_SOURCE and source.isprintable()):
        raise InputError(
            f"expected a source of 1 to {LONGEST_SOURCE} printable characters; came {len(source)}: {source!r:.60}"
        )
    return str(source)


def names_of(what: str, names: Iterable[str] | None, wrong: type[InputError] = InputError) -> list[str] | None:
    """The names in a sequence or an iterator, as `require_name` writes them; None where it is None.

    `what` and `wrong` say how others are refused.
    """
    if names is None:
        return None
    advice = f". Use [{names!r:.60}]" if isinstance(names, str) else ""
    found = [None] if isinstance(names, str | bytes) or not isinstance(names, Iterable) else list(names)
    if not all(isinstance(name, str) for name in found):
        came = f"{type(names).__name__} {names!r:.60}"
        raise wrong(f"expected {what} as a sequence of names; came {came}{advice}")
    return [_composed(name) for name in cast("list[str]", found)]


def candidates_of(scene: Sequence[str] | None, names: list[str], known: AbstractSet[str]) -> list[str]:
    """The materials of a scene, in alphabetical order; all that were observed where it is None.

    names: all, in that order. known: the same.

    Raises InputError for an empty one, UnknownMaterialError for one that names what was never observed.
    """
    if scene is None:
        return names
    wanted = list(dict.fromkeys(scene))
    if not wanted:
        raise InputError(
            "expected at least one material in the scene; came none. Leave scene out for all of them", argument="scene"
        )
    missing = [name for name in wanted if name not in known]
    if missing:
        raise UnknownMaterialError(
            f"the scene names {missing[:30]}, which were never observed; observed were "
            f"{names if len(names) <= 30 else len(names)}",
            argument="scene",
        )
    return sorted(wanted)

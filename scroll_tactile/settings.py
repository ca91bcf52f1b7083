"""What a learner is asked for, looked at before anything is done."""

from __future__ import annotations

from collections.abc import Sequence

from scroll_tactile.errors import InputError, MaterialError, UnknownMaterialError
from scroll_tactile.sensors import Sensor
from scroll_tactile.signals.copies import Augmented

__all__ = ["candidates_of", "require_augmentable", "require_name", "require_settings"]

LONGEST_NAME = 200  # characters


def require_settings(readout: str, false_alarms: float, refit: float, solver: str) -> None:
    """Raise InputError for readouts and solvers that there are not, and shares that are none."""
    if readout not in ("lda", "ridge"):
        raise InputError(f"readout must be 'lda' or 'ridge'; came {readout!r}")
    if not 0 < false_alarms < 1:
        raise InputError(f"false_alarms must be a share between 0 and 1; came {false_alarms!r}")
    if not 0 <= refit <= 1:
        raise InputError(f"refit must be a share from 0 to 1; came {refit!r}")
    if solver not in ("exact", "recursive"):
        raise InputError(f"solver must be 'exact' or 'recursive'; came {solver!r}")
    if solver == "recursive" and not refit:
        raise InputError(
            "solver='recursive' is what happens between two fits, and with refit=0 every change is followed by one: "
            "give refit=1.0, say, to fit again when the memory has doubled"
        )


def require_augmentable(sensor: Sensor, augmentation: Augmented | None) -> Augmented | None:
    """The augmentation. Raises InputError for what is none, and for a camera, whose frames are not slid along time."""
    if augmentation is not None and not isinstance(augmentation, Augmented):
        raise InputError(f"expected an augmentation such as Augmented(copies=4); came {augmentation!r:.60}")
    if augmentation is not None and sensor.camera:
        raise InputError(
            f"the copies of an augmentation differ in speed, noise and broken wires, and camera {sensor.name!r} takes "
            "whole frames: leave the augmentation out"
        )
    return augmentation


def require_name(material: str) -> None:
    """Raise MaterialError for what cannot name a material."""
    if not isinstance(material, str):
        raise MaterialError(f"expected a material's name as a string; came {type(material).__name__} {material!r:.60}")
    if not material or len(material) > LONGEST_NAME:
        raise MaterialError(f"expected a name of 1 to {LONGEST_NAME} characters; came {len(material)}")
    if not material.isprintable():
        raise MaterialError(f"expected a name of printable characters; came {material!r}")


def candidates_of(scene: Sequence[str], names: list[str]) -> list[str]:
    """The materials of a scene, in alphabetical order.

    Raises InputError for an empty one, UnknownMaterialError for one that names what was never felt.
    """
    if isinstance(scene, str):
        raise InputError(f"expected a scene as a sequence of names; came the string {scene!r}. Use [{scene!r}]")
    wanted = list(dict.fromkeys(scene))
    if not wanted:
        raise InputError("expected at least one material in the scene; came none. Leave scene out for all of them")
    felt = set(names)
    missing = [name for name in wanted if name not in felt]
    if missing:
        raise UnknownMaterialError(
            f"the scene names {missing}, which were never felt; felt were {names if len(names) <= 30 else len(names)}"
        )
    return sorted(wanted)

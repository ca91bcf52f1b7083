"""GelSight contact frames of everyday objects: PhysiCLeAR, as frames of its videos.

From github.com/clear-nus/octopi (S. Yu et al., Octopi: Object Property Reasoning with Large Tactile-Language Models,
RSS 2024), laid out as::

    physiclear/<object>/<object>_<video>_<frame>.jpg      four frames, 0 to 3, in which the gel touches the object
    physiclear/attributes.json                            hardness, roughness and texture of most objects: 0, 1 or 2

Frames of one video are all but the same picture: they lie in one fold, or the test would be of what was learned.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from examples.paper.readers.labelled import Recordings
from scroll_tactile.errors import DatasetError, InputError, StreamError
from scroll_tactile.libraries import optional
from scroll_tactile.sensors import GELSIGHT, Sensor
from scroll_tactile.signals.stream import Stream, validate

__all__ = ["ATTRIBUTES", "FRAMES", "HALF_SIZE", "load", "read_attributes", "videos"]

FOLDER = "physiclear"
FRAMES = 4
"""Frames of a video."""

ATTRIBUTES = ("hardness", "roughness", "texture")
"""Of objects, each 0, 1 or 2."""

HALF_SIZE: Sensor = GELSIGHT.model_copy(update={"channels": 120 * 160 * 3, "layout": (120, 160, 3)})
"""The camera at the size that frames are read in: 320 × 240, averaged over 2 × 2 pixels."""

_FOLDS = 5
_SIZE = (320, 240)  # columns and rows of the published frames
_WHERE = "Get the videos of PhysiCLeAR by github.com/clear-nus/octopi, and write the frames of each out as"


def load(root: str | Path, seed: int = 0) -> Recordings:
    """Read all frames, each a stream of its own, (1, 120, 160, 3), whose material is the object.

    root: the folder of the data set, or the folder it lies in. seed: deals the videos of each object into five folds.
    Frames of one video share `repetition`, the video's number. Folds are of unequal size: objects have 4 to 7 videos.

    Raises DatasetError if a folder or file is missing or not as published, InputError for a negative seed or where
    Pillow, which reads the frames, is missing.
    """
    if seed < 0:
        raise InputError(f"expected a seed of 0 or more; came {seed}")
    folder = _find(Path(root).expanduser())
    streams: list[Stream] = []
    materials: list[str] = []
    repetition: list[int] = []
    folds: list[int] = []
    for number, home in enumerate(sorted(path for path in folder.iterdir() if path.is_dir())):
        videos = _videos(home)
        # Each object begins with another fold, so that the folds come out nearly equal.
        dealt = np.random.default_rng([seed, number]).permutation((np.arange(len(videos)) + number) % _FOLDS)
        for (video, frames), fold in zip(videos.items(), dealt.tolist(), strict=True):
            streams += [_read(path) for path in frames]
            materials += [home.name] * len(frames)
            repetition += [video] * len(frames)
            folds += [fold] * len(frames)
    if len(set(materials)) < 2:
        raise DatasetError(f"expected folders of objects in {folder}; there are {len(set(materials))}. {_wanted()}")
    return Recordings(
        name="GelSight frames",
        sensor=HALF_SIZE,
        streams=streams,
        materials=materials,
        repetition=np.array(repetition),
        fold=np.array(folds),
        ordered=False,
    )


def videos(recordings: Recordings) -> Recordings:
    """The recordings that `load` gives with each video as one stream, (4, 120, 160, 3): all its frames in contact.

    Raises InputError for recordings whose frames of a video are not in one fold.
    """
    marks = list(zip(recordings.materials, recordings.repetition.tolist(), strict=True))
    places: dict[tuple[str, int], list[int]] = {}
    for i, mark in enumerate(marks):
        places.setdefault(mark, []).append(i)
    if any(len(set(recordings.fold[frames].tolist())) > 1 for frames in places.values()):
        raise InputError(f"expected the frames of each video of {recordings.name} in one fold; some are in several")
    first = [frames[0] for frames in places.values()]
    joined = [np.concatenate([recordings.streams[i].readings for i in frames]) for frames in places.values()]
    return replace(
        recordings,
        name="GelSight videos",
        streams=[validate(readings, recordings.sensor) for readings in joined],
        materials=[recordings.materials[i] for i in first],
        repetition=recordings.repetition[first],
        fold=recordings.fold[first],
    )


def read_attributes(root: str | Path) -> dict[str, dict[str, int]]:
    """Object → hardness, roughness and texture, each 0, 1 or 2, of the objects of which all three are published.

    root: as for `load`. Raises DatasetError where the file is missing or not as published.
    """
    path = _find(Path(root).expanduser()) / "attributes.json"
    try:
        grades = json.loads(path.read_text(encoding="utf-8"))
        of_each = {name: {key: grades[name][key] for key in grades[name]} for name in ATTRIBUTES}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"expected {', '.join(ATTRIBUTES)} of the objects in {path}; they cannot be read: {error!r}. It is part of "
            "the annotations of github.com/clear-nus/octopi"
        ) from error
    strange = {value for values in of_each.values() for value in values.values()} - {0, 1, 2}
    if strange:
        raise DatasetError(f"expected attributes of 0, 1 or 2 in {path}; it also has {sorted(map(str, strange))}")
    known = set.intersection(*(set(values) for values in of_each.values()))
    return {key: {name: of_each[name][key] for name in ATTRIBUTES} for key in sorted(known)}


def _find(root: Path) -> Path:
    for folder in (root, root / FOLDER):
        if folder.is_dir() and any(folder.glob("*/*_[0-9]*_[0-9]*.jpg")):
            return folder
    state = "holds none" if root.is_dir() else "is not there"
    raise DatasetError(f"expected GelSight frames in {root} or its folder {FOLDER}/; {root} {state}. {_wanted()}")


def _wanted() -> str:
    return f"{_WHERE} {FOLDER}/<object>/<object>_<video>_<frame>.jpg, frames 0 to {FRAMES - 1}"


def _videos(home: Path) -> Mapping[int, Sequence[Path]]:
    """Video → its frames in order."""
    pattern = re.compile(rf"{re.escape(home.name)}_(\d+)_(\d+)\.jpg")
    found: dict[int, dict[int, Path]] = {}
    for path in sorted(home.iterdir()):
        match = pattern.fullmatch(path.name)
        if match is None:
            raise DatasetError(f"expected frames {home.name}_<video>_<frame>.jpg in {home}; it also holds {path.name}")
        found.setdefault(int(match[1]), {})[int(match[2])] = path
    if len(found) < 2:
        raise DatasetError(f"expected two videos or more in {home}, to learn from and to test; it has {len(found)}")
    for video, frames in found.items():
        missing = sorted(set(range(FRAMES)) - set(frames))
        if missing:
            raise DatasetError(f"expected {home / f'{home.name}_{video}_{missing[0]}.jpg'}; it is missing. {_wanted()}")
    return {video: [found[video][frame] for frame in sorted(found[video])] for video in sorted(found)}


def _read(path: Path) -> Stream:
    with optional("Pillow", "gelsight", "reading GelSight's frames"):
        from PIL import Image
    try:
        with Image.open(path) as picture:
            if picture.size != _SIZE or picture.mode != "RGB":
                came = f"{picture.size[0]} × {picture.size[1]} in {picture.mode}"
                raise DatasetError(f"expected {path} to be {_SIZE[0]} × {_SIZE[1]} in RGB; it is {came}")
            frame: npt.NDArray[Any] = np.asarray(picture.reduce(2))
        return validate(frame[None], HALF_SIZE)
    except (OSError, SyntaxError, StreamError) as error:  # Pillow raises SyntaxError for some damaged headers
        raise DatasetError(
            f"expected a JPEG picture in {path}; it cannot be read, and may be damaged: {error}"
        ) from error

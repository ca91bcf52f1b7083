"""GelSight contact frames of everyday objects: PhysiCLeAR, as frames of its videos.

From github.com/clear-nus/octopi (S. Yu et al., Octopi: Object Property Reasoning with Large Tactile-Language Models,
RSS 2024), laid out as::

    physiclear/<object>/<object>_<video>_<frame>.jpg      four frames, 0 to 3, in which the gel touches the object

Frames of one video are all but the same picture: they lie in one fold, or the test would be of what was learned.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scroll_tactile.datasets.recordings import Recordings
from scroll_tactile.errors import DatasetError, InputError, StreamError
from scroll_tactile.sensors import GELSIGHT, Sensor
from scroll_tactile.streams import Stream, validate

__all__ = ["FRAMES", "HALF_SIZE", "load"]

FOLDER = "physiclear"
FRAMES = 4
"""Frames of a video."""

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
    try:
        from PIL import Image
    except ImportError as error:
        raise InputError(
            "GelSight frames are read by Pillow, which is not installed: pip install 'scroll-tactile[gelsight]'"
        ) from error
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

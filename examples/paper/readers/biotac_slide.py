"""BioTac-20 and RoboSkin-20: the same twenty materials under two sensors, 50 touches each.

Published as github.com/dexrob/BioTac_slide_20_50 (R. Gao et al., Supervised Autoencoder Joint Learning on
Heterogeneous Tactile Sensory Data, IROS 2020), in this layout::

    raw_data/mat{1..20}/mat{m}_{1..50}.pt      BioTac: int tensors (≥ 400, 44) at 100 Hz; columns tdc, tac, pdc,
                                               pac1..22, ele1..19
    compiled_data/icub_{val_0..3,test}.npy     RoboSkin: five folds of float (200, 6, 10, 75) at 50 Hz
    compiled_data/labels_{val_0..3,test}.npy   their labels: l is material l + 1

The publisher names the materials mat1 to mat20, and so do we. No file says which touch of a material a
RoboSkin stream is, nor when it was made.

RoboSkin's arrays are published mixed up. Each touch was an array of (10 taxels, 75 readings, 6 patches) whose last
two axes were reshaped to (6, 75) where they should have been exchanged: a row of 75 holds 12.5 readings of the six
patches in turn, and the six rows of a taxel follow each other in time. Put back, a channel's mean step between
neighbours is 1.3 % of the spread, as published 48 %, and no larger where a row ended. The paper's figures are of the
arrays as published, and so are ours unless they say otherwise. Of those no first 0.3 s can be had, for each column
holds readings from all of the touch, and no other speed.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from examples.paper.readers.labelled import Recordings
from scroll_tactile.errors import DatasetError, InputError, StreamError
from scroll_tactile.libraries import optional
from scroll_tactile.sensors import BIOTAC, BIOTAC_ALL, ROBOSKIN, Sensor
from scroll_tactile.signals.stream import Stream, validate

__all__ = ["MATERIALS", "all_channels", "load"]

FOLDER = "biotac_slide_20_50"
MATERIALS = tuple(f"mat{number}" for number in range(1, 21))
"""The twenty materials, named as their publisher does, for both sensors."""

_REPETITIONS = 50
_FOLDS = 5
_COLUMNS = 44  # of a raw BioTac recording
_VIBRATION = slice(3, 25)  # of these columns
_ROBOSKIN_FILES = ("val_0", "val_1", "val_2", "val_3", "test")  # icub_test_4.npy overlaps these: left out
_ROBOSKIN_SHAPE = (200, 6, 10, 75)


def load(
    root: str | Path, sensor: Literal["biotac", "biotac-all", "roboskin"], seed: int = 0, *, unmixed: bool = False
) -> Recordings:
    """Read one sensor's 1000 streams: (400, 19) for "biotac", (75, 60) for "roboskin", both in counts.

    "biotac-all": the same touches and folds as "biotac" with all that the sensor measures, (400, 25); see BIOTAC_ALL.

    root: the folder of the data set, or the folder it lies in.
    seed: deals BioTac's repetitions into five folds of ten for each material. RoboSkin's five folds are its
        publisher's files, whatever the seed.
    unmixed: of "roboskin", put the readings in the order of time and channels (patch · 10 + taxel); see above.

    Every BioTac recording is cropped to 400 readings: those of some materials are shorter than all others, so
    that their length would tell what they are. Electrodes' glitches are clipped, as `validate` does.

    Raises DatasetError if a file is missing or not as published, InputError for another sensor, a negative seed,
    or a BioTac that is to be unmixed.
    """
    if sensor not in ("biotac", "biotac-all", "roboskin"):
        raise InputError(f"expected sensor 'biotac', 'biotac-all' or 'roboskin'; came {sensor!r}")
    if seed < 0:
        raise InputError(f"expected a seed of 0 or more; came {seed}")
    if unmixed and sensor != "roboskin":
        raise InputError(f"expected sensor 'roboskin' to be unmixed; came {sensor!r}, which is published in order")
    folder = _find(Path(root).expanduser())
    if sensor == "roboskin":
        return _load_roboskin(folder, unmixed)
    return _load_biotac(folder / "raw_data", BIOTAC if sensor == "biotac" else BIOTAC_ALL, seed)


def all_channels(words: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Readings of BIOTAC_ALL, shape (T, 25), of a BioTac's words of each 10 ms, shape (T, 44).

    words: tdc, tac, pdc, pac1..22, ele1..19. The 22 vibration readings come in as what they say of the 10 ms: their
    mean, standard deviation and mean absolute change from one to the next. Each as a channel of its own they drown the
    others. Raises InputError for another shape.
    """
    if words.ndim != 2 or words.shape[1] != _COLUMNS:
        raise InputError(f"expected a BioTac's words of shape (T, {_COLUMNS}); came {words.shape}")
    values = words.astype(np.float64)
    vibration = values[:, _VIBRATION]
    count = vibration.shape[1]
    with np.errstate(invalid="ignore"):  # what is infinite is missing in all three
        mean = vibration.sum(axis=1) / count
        # Of whole numbers both sums are exact, so that no machine rounds another energy.
        energy = np.maximum(count * np.square(vibration).sum(axis=1) - np.square(vibration.sum(axis=1)), 0)
        change = np.abs(np.diff(vibration, axis=1)).sum(axis=1) / (count - 1)
    slow, electrodes = values[:, : _VIBRATION.start], values[:, _VIBRATION.stop :]
    return np.column_stack([electrodes, slow, mean, np.sqrt(energy) / count, change])


def _find(root: Path) -> Path:
    for folder in (root, root / FOLDER):
        if (folder / "raw_data").is_dir() or (folder / "compiled_data").is_dir():
            return folder
    raise DatasetError(
        f"expected {root} to be the folder {FOLDER}, with raw_data/ and compiled_data/ in it, or to hold it; "
        + ("it is and does not" if root.is_dir() else "there is no such folder")
        + f". Get it from github.com/dexrob/{FOLDER}"
    )


def _load_biotac(folder: Path, sensor: Sensor, seed: int) -> Recordings:
    streams, folds = [], []
    for number, material in enumerate(MATERIALS):
        for file in range(1, _REPETITIONS + 1):
            streams.append(_read_biotac(folder / material / f"{material}_{file}.pt", sensor))
        dealt = np.arange(_REPETITIONS) % _FOLDS
        folds.append(np.random.default_rng([seed, number]).permutation(dealt))
    return Recordings(
        name="BioTac-20" if sensor is BIOTAC else "BioTac-20, all channels",
        sensor=sensor,
        streams=streams,
        materials=[material for material in MATERIALS for _ in range(_REPETITIONS)],
        repetition=np.tile(np.arange(_REPETITIONS), len(MATERIALS)),
        fold=np.concatenate(folds),
        ordered=True,
    )


def _read_biotac(path: Path, sensor: Sensor) -> Stream:
    with optional("torch", "torch", "reading BioTac's files"):
        import torch  # a second or more: not for those who read RoboSkin only

    wanted = f"a tensor of shape (≥ {BIOTAC.readings}, {_COLUMNS})"
    tensor = _read(path, lambda file: torch.load(file, weights_only=True), wanted)
    if not isinstance(tensor, torch.Tensor):
        raise DatasetError(f"expected {path} to hold {wanted}; it holds a {type(tensor).__name__}")
    if tensor.ndim != 2 or len(tensor) < BIOTAC.readings or tensor.shape[1] != _COLUMNS:
        raise DatasetError(f"expected {path} to hold {wanted}; its shape is {tuple(tensor.shape)}")
    words = tensor[: BIOTAC.readings].numpy()
    return _stream(words[:, -BIOTAC.channels :] if sensor is BIOTAC else all_channels(words), sensor, path)


def _load_roboskin(folder: Path, unmixed: bool) -> Recordings:
    streams: list[Stream] = []
    materials: list[str] = []
    repetitions = []
    for name in _ROBOSKIN_FILES:
        source = folder / "compiled_data" / f"icub_{name}.npy"
        readings = _read_array(source, _ROBOSKIN_SHAPE)
        path = folder / "compiled_data" / f"labels_{name}.npy"
        labels = _read_array(path, _ROBOSKIN_SHAPE[:1])
        if not np.isin(labels, np.arange(len(MATERIALS))).all():
            raise DatasetError(f"expected {path} to hold labels 0 to 19; it holds {np.unique(labels)}")
        labels = labels.astype(np.int64)
        in_rows = [_unmix(touch) if unmixed else touch.reshape(ROBOSKIN.channels, -1).T for touch in readings]
        streams += [_stream(rows, ROBOSKIN, source) for rows in in_rows]
        materials += [MATERIALS[label] for label in labels]
        repetitions.append(_count_before(labels))
    return Recordings(
        name="RoboSkin-20, unmixed" if unmixed else "RoboSkin-20",
        sensor=ROBOSKIN,
        streams=streams,
        materials=materials,
        repetition=np.concatenate(repetitions),
        fold=np.repeat(np.arange(len(_ROBOSKIN_FILES)), _ROBOSKIN_SHAPE[0]),
        ordered=False,
    )


def _unmix(touch: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Readings in time order, shape (75, 60), of a touch as published, shape (6, 10, 75)."""
    patches, taxels, readings = touch.shape
    of_taxels = touch.transpose(1, 0, 2).reshape(taxels, readings, patches)
    return of_taxels.transpose(1, 2, 0).reshape(readings, patches * taxels)


def _stream(readings: npt.NDArray[Any], sensor: Sensor, path: Path) -> Stream:
    try:
        return validate(readings, sensor)
    except StreamError as error:
        raise DatasetError(f"{path} holds no sound readings: {error}") from error


def _count_before(labels: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """For each label, how many equal ones come before it."""
    return np.array([np.count_nonzero(labels[:i] == label) for i, label in enumerate(labels)])


def _read_array(path: Path, shape: tuple[int, ...]) -> npt.NDArray[Any]:
    wanted = f"an array of shape {shape}"
    array = _read(path, lambda file: np.load(file, allow_pickle=False), wanted)
    if not isinstance(array, np.ndarray) or array.shape != shape:
        came = array.shape if isinstance(array, np.ndarray) else type(array).__name__
        raise DatasetError(f"expected {path} to hold {wanted}; it holds {came}")
    return array


def _read(path: Path, reader: Callable[[Path], Any], wanted: str) -> Any:
    try:
        return reader(path)
    except FileNotFoundError as error:
        raise DatasetError(
            f"expected {wanted} in {path}; there is no such file. The layout is that of github.com/dexrob/{FOLDER}"
        ) from error
    except Exception as error:  # damaged bytes make the parsers fail in any way: IndexError, SyntaxError, …
        raise DatasetError(
            f"expected {wanted} in {path}; it cannot be read, and may be damaged or half copied: {error}"
        ) from error

"""Small recordings in every format, each by its own library's writer."""

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bags
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import zarr
from numcodecs import LZ4, Blosc, GZip, Zlib, Zstd

RNG = np.random.default_rng(3)
TIP = RNG.standard_normal((30, 19)).astype(np.float32)
PAD = RNG.standard_normal((30, 4, 6, 3)).astype(np.float32)


def lerobot(folder: Path, **more: tuple[str, pa.Array]) -> Path:
    """A LeRobotDataset v3 of three episodes in two files, as its writer lays it out; more: its type and 30 rows."""
    episode = np.repeat([0, 1, 2], 10)
    columns = {
        "tip": pa.FixedSizeListArray.from_arrays(pa.array(TIP.ravel()), 19),
        "pad": pa.array(PAD.tolist(), pa.list_(pa.list_(pa.list_(pa.float32())))),
        "timestamp": pa.array(np.tile(np.arange(10) / 100, 3).astype(np.float32)),
        "frame_index": pa.array(np.tile(np.arange(10), 3)),
        "episode_index": pa.array(episode),
        "index": pa.array(np.arange(30)),
        "task_index": pa.array(np.where(episode == 1, 1, 0)),
    }
    table = pa.table({("observation.tactile." + k if k in ("tip", "pad") else k): v for k, v in columns.items()})
    for name, (_, column) in more.items():
        table = table.append_column(f"observation.{name}", column)
    for name in ("data/chunk-000", "meta/episodes/chunk-000"):
        (folder / name).mkdir(parents=True)
    pq.write_table(table[:20], folder / "data/chunk-000/file-000.parquet")
    pq.write_table(table[20:], folder / "data/chunk-000/file-001.parquet")
    episodes = {"episode_index": [0, 1, 2], "data/chunk_index": [0, 0, 0], "data/file_index": [0, 0, 1]}
    pq.write_table(pa.table(episodes), folder / "meta/episodes/chunk-000/file-000.parquet")
    tasks = pa.table({"task_index": [0, 1], "__index_level_0__": ["slide over felt", "slide over cork"]})
    pq.write_table(tasks, folder / "meta/tasks.parquet")
    features = {
        "observation.tactile.tip": {"dtype": "float32", "shape": [19]},
        "observation.tactile.pad": {"dtype": "float32", "shape": [4, 6, 3]},
        "observation.image": {"dtype": "video", "shape": [4, 4, 3]},
    } | {name: {"dtype": "int64", "shape": [1]} for name in list(columns)[2:]}
    for name, (kind, column) in more.items():
        features[f"observation.{name}"] = {"dtype": kind, "shape": [getattr(column.type, "list_size", 1)]}
    about = {"codebase_version": "v3.0", "fps": 100, "total_frames": 30, "features": features}
    about["data_path"] = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    (folder / "meta/info.json").write_text(json.dumps(about))
    return folder


def robomimic(path: Path, odd: bool = False) -> Path:
    with h5py.File(path, "w") as file:
        for i in (10, 2, 0):
            demo = file.create_group(f"data/demo_{i}")
            demo["obs/tactile"] = TIP[: i + 3, : 18 if odd and i == 2 else 19]
            demo["obs/pad"] = PAD[: i + 3]
            demo["obs/time"] = np.arange(i + 3) / 20
            demo["actions"] = np.zeros((i + 3, 7))
        file["name"] = "cup"
    return path


def ros(folder: Path, form: str, compress: str = "") -> Path:
    store = bags.typestore(1 if form == "bag" else 2)
    messages = [(bags.START + i / 100, bags.array(store, row)) for i, row in enumerate(TIP)]
    path = folder / ("b.bag" if form == "bag" else "b")
    return bags.write(path, store, {"/skin": messages}, form=form, compress=compress)


def nested(folder: Path, form: str) -> Path:
    """Messages in messages, beside texts that name what is touched."""
    store = bags.typestore(1 if form == "bag" else 2)
    messages = [
        (bags.START + i / 100, bags.biotac(store, np.arange(19, dtype=np.int16) + i, bags.START + i / 100, i))
        for i in range(20)
    ]
    names = [(bags.START + i / 10, bags.text(store, f"m{i}")) for i in range(2)]
    path = folder / ("n.bag" if form == "bag" else "n")
    return bags.write(path, store, {"/rh/tactile": messages, "/material": names}, form=form)


def pictures(folder: Path) -> Path:
    import io

    from PIL import Image

    store = bags.typestore(2)
    kind, messages = store.types["sensor_msgs/msg/CompressedImage"], []
    for i, form in enumerate(("PNG", "JPEG", "PNG")):
        buffer = io.BytesIO()
        Image.fromarray(RNG.integers(0, 256, (8, 6, 3), dtype=np.uint8)).save(buffer, form)
        data = np.frombuffer(buffer.getvalue(), np.uint8)
        messages.append((bags.START + i, kind(header=bags.header(store, 1.0 + i), format=form.lower(), data=data)))
    return bags.write(folder / "i", store, {"/gel": messages}, form="mcap")


def npy(folder: Path) -> Path:
    np.save(folder / "a.npy", TIP)
    return folder / "a.npy"


def csv(folder: Path) -> Path:
    (folder / "a.csv").write_text("time,a,b\n" + "".join(f"{i},{i * 2},{i / 3}\n" for i in range(20)))
    return folder / "a.csv"


def hdf5(folder: Path) -> Path:
    """A data set in chunks, as robomimic's are not."""
    with h5py.File(folder / "c.h5", "w") as file:
        for i in range(2):
            file.create_dataset(
                f"data/demo_{i}/obs/tactile", data=TIP, chunks=(7, 19), compression="gzip", shuffle=True
            )
            file[f"data/demo_{i}/obs/time"] = np.arange(30) / 20
    return folder / "c.h5"


CODECS = {
    "none": None,
    "lz4": Blosc("lz4", shuffle=Blosc.SHUFFLE),
    "bits": Blosc("zstd", shuffle=Blosc.BITSHUFFLE),
    "gzip": GZip(),
    "zlib": Zlib(),
    "frame": LZ4(),
    "zstd": Zstd(),
}


def buffer(folder: Path, version: int = 3, codec: str | None = None, **options: Any) -> Path:
    """A replay buffer of two episodes; codec: of `CODECS`, without it Zarr's own."""
    group = zarr.open_group(folder / "b.zarr", mode="w", zarr_format=version)
    if codec is not None:
        options["compressors"] = CODECS[codec]
    group.create_array("data/tactile", data=TIP, chunks=(7, 10), **options)
    group.create_array("data/timestamp", data=np.arange(30) / 20)
    group.create_array("meta/episode_ends", data=np.array([5, 30]))
    return folder / "b.zarr"


def zipped(folder: Path) -> Path:
    inside = buffer(folder, 2, "lz4")
    with zipfile.ZipFile(folder / "z.zarr.zip", "w", zipfile.ZIP_DEFLATED) as file:
        for path in sorted(inside.rglob("*")):
            if path.is_file():
                file.write(path, path.relative_to(inside))
                path.unlink()
    return folder / "z.zarr.zip"


Made = tuple[Callable[[Path], Path], dict[str, Any]]
SKIN = {"topic": "/skin", "field": "data"}
FORMATS: dict[str, Made] = {
    "bag": (lambda d: ros(d, "bag", "lz4"), SKIN),
    "bag bz2": (lambda d: ros(d, "bag", "bz2"), SKIN),
    "bag nested": (lambda d: nested(d, "bag"), {"preset": "biotac"}),
    "db3": (lambda d: ros(d, "db3"), SKIN),
    "db3 messages": (lambda d: ros(d, "db3", "MESSAGE ZSTD"), SKIN),
    "db3 file": (lambda d: ros(d, "db3", "FILE ZSTD"), SKIN),
    "mcap": (lambda d: ros(d, "mcap", "STORAGE ZSTD"), SKIN),
    "mcap nested": (lambda d: nested(d, "mcap"), {"preset": "biotac", "labels": "/material"}),
    "mcap pictures": (pictures, {"topic": "/gel", "field": "data"}),
    "lerobot": (lambda d: lerobot(d / "set"), {"field": "tip"}),
    "hdf5": (lambda d: robomimic(d / "d.h5"), {"field": "obs/tactile"}),
    "hdf5 chunks": (hdf5, {"field": "obs/tactile"}),
    "zarr": (buffer, {"field": "tactile"}),
    "zarr 3 gzip": (
        lambda d: buffer(
            d,
            compressors=[zarr.codecs.GzipCodec(), zarr.codecs.Crc32cCodec()],
            filters=[zarr.codecs.TransposeCodec(order=(1, 0))],
        ),
        {"field": "tactile"},
    ),
    "zarr zip": (zipped, {"field": "tactile"}),
    "npy": (npy, {}),
    "csv": (csv, {}),
}
for _codec in CODECS:
    FORMATS[f"zarr 2 {_codec}"] = (lambda d, codec=_codec: buffer(d, 2, codec), {"field": "tactile"})
"""Of each what makes it in a folder, and what `read` takes to read it."""

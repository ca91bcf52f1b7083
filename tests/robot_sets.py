"""LeRobot data sets as their writer lays them out, with statistics, a video's file and texts, of given readings."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

FIELD = "observation.tactile.pad"


def flat(values):
    """Statistics of a column (T, n), those that older versions of LeRobot keep."""
    found = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    return {name: each.tolist() for name, each in found.items()} | {"count": [len(values)]}


def robot_set(folder: Path, episodes, *, files=(0,), rate=50.0) -> Path:
    """A LeRobotDataset v3. episodes: (task, readings); files: the file of each, the last for the rest."""
    tasks = sorted({task for task, _ in episodes})
    places = [files[min(i, len(files) - 1)] for i in range(len(episodes))]
    width, at, rows, tables = episodes[0][1].shape[1], 0, [], {}
    for number, ((task, readings), place) in enumerate(zip(episodes, places, strict=True)):
        count, values = len(readings), readings.astype(np.float32)
        columns = {
            FIELD: pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), width),
            "timestamp": pa.array((np.arange(count) / rate).astype(np.float32)),
            "frame_index": pa.array(np.arange(count)),
            "episode_index": pa.array(np.full(count, number)),
            "index": pa.array(np.arange(at, at + count)),
            "task_index": pa.array(np.full(count, tasks.index(task))),
            "note": pa.array([f"{task} {i}" if i % 3 else None for i in range(count)]),
        }
        tables.setdefault(place, []).append(pa.table(columns))
        row = {"episode_index": number, "tasks": [task], "length": count}
        row |= {"data/chunk_index": 0, "data/file_index": place}
        rows.append(row | {f"stats/{FIELD}/{name}": each for name, each in flat(values).items()})
        at += count
    for name in ("data/chunk-000", "meta/episodes/chunk-000", "videos/observation.image/chunk-000"):
        (folder / name).mkdir(parents=True)
    for place, parts in tables.items():
        path = folder / f"data/chunk-000/file-{place:03d}.parquet"
        with pq.ParquetWriter(path, parts[0].schema) as writer:  # a row group an episode
            for part in parts:
                writer.write_table(part)
    pq.write_table(pa.Table.from_pylist(rows), folder / "meta/episodes/chunk-000/file-000.parquet")
    named = pa.table({"task_index": range(len(tasks)), "__index_level_0__": tasks})
    pq.write_table(named, folder / "meta/tasks.parquet")
    (folder / "videos/observation.image/chunk-000/file-000.mp4").write_bytes(b"a video" * 1000)
    (folder / "README.md").write_text("what a robot did")
    kinds = {"timestamp": "float32", "note": "string"}
    features = {FIELD: {"dtype": "float32", "shape": [width], "names": None}}
    features["observation.image"] = {"dtype": "video", "shape": [4, 4, 3], "names": None}
    for name in ("timestamp", "frame_index", "episode_index", "index", "task_index", "note"):
        features[name] = {"dtype": kinds.get(name, "int64"), "shape": [1], "names": None}
    info = {"codebase_version": "v3.0", "robot_type": None, "fps": rate, "features": features}
    info |= {"total_episodes": len(episodes), "total_frames": at, "total_tasks": len(tasks)}
    info["data_path"] = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    (folder / "meta/info.json").write_text(json.dumps(info, indent=4))
    frames = np.concatenate([readings for _, readings in episodes]).astype(np.float32)
    (folder / "meta/stats.json").write_text(json.dumps({FIELD: flat(frames)}, indent=4))
    return folder


def whole(folder: Path) -> pa.Table:
    """All frames of a data set."""
    return pa.concat_tables([pq.read_table(path) for path in sorted(folder.glob("data/*/*.parquet"))])


def contents(folder: Path) -> dict[str, bytes]:
    """All files in a folder, by their paths."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}

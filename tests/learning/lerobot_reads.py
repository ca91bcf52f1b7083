"""Run by a Python that has lerobot: reads a data set with it, and prints as JSON what it found."""

import json
import sys

from lerobot.datasets.lerobot_dataset import LeRobotDataset

root, column = sys.argv[1:]
data = LeRobotDataset("somebody/touches", root=root)
frames = [data[i] for i in range(len(data))]
touch = [name for name in data.meta.features if name.startswith("observation.touch.")]
found = {
    "features": {name: [data.meta.features[name]["dtype"], list(data.meta.features[name]["shape"])] for name in touch},
    "kinds": {name: str(frames[0][name].dtype) for name in touch},
    "values": {name: [frame[name].tolist() for frame in frames] for name in touch},
    "readings": [frame[column].tolist() for frame in frames],
    "events": [[row["content"] for row in frame.get("language_events") or []] for frame in frames],
    "stats": {name: {key: value.tolist() for key, value in data.meta.stats[name].items()} for name in touch},
    "tasks": sorted({frame["task"] for frame in frames}),
}
try:  # how a recipe of a policy finds them
    from lerobot.datasets.language_render import emitted_at
except ImportError:
    pass
else:
    rows = [(frame["timestamp"].item(), frame.get("language_events") or []) for frame in frames]
    how = {"persistent": [], "style": "interjection", "role": "tool"}
    said = [emitted_at(time, events=events, **how) for time, events in rows]
    found["emitted"] = [None if row is None else row["content"] for row in said]
print(json.dumps(found))

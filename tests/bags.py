"""Recordings written by others' writers with drivers' schemas, and their truth."""

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

DEFINITIONS = {
    "sr_robot_msgs/msg/Biotac": "int16 pac0\nint16 pac1\nint16[] pac\nint16 pdc\nint16 tac\nint16 tdc\n"
    "int16[] electrodes",
    "sr_robot_msgs/msg/BiotacAll": "std_msgs/Header header\nsr_robot_msgs/Biotac[5] tactiles",
    "tactile_msgs/msg/TactileState": "std_msgs/Header header\nsensor_msgs/ChannelFloat32[] sensors",
    "xela_server_ros2/msg/Taxel": "uint16 x\nuint16 y\nuint16 z",
    "xela_server_ros2/msg/Forces": "float32 x\nfloat32 y\nfloat32 z",
    "xela_server_ros2/msg/SensorFull": "uint32 message\nfloat64 time\nstring model\nuint8 sensor_pos\n"
    "xela_server_ros2/Taxel[] taxels\nxela_server_ros2/Forces[] forces",
    "xela_server_ros2/msg/SensStream": "xela_server_ros2/SensorFull[] sensors",
    "papillarray_ros_v2/msg/PillarState": "int32 id\nfloat32 dX\nfloat32 dY\nfloat32 dZ\nfloat32 fX\nfloat32 fY\n"
    "float32 fZ\nbool in_contact\nint32 slip_state",
    "papillarray_ros_v2/msg/SensorState": "std_msgs/Header header\nint64 tus\n"
    "papillarray_ros_v2/PillarState[] pillars\nfloat32 gfX",
    "robotiq_tsf/msg/Taxels": "uint16[28] values",
    "robotiq_tsf/msg/StaticData": "robotiq_tsf/Taxels[2] taxels",
}
START = 1_760_000_000


def typestore(ros: int) -> Any:
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    types: dict[str, Any] = {}
    for name, text in DEFINITIONS.items():
        types |= get_types_from_msg(text, name)
    store.register(types)
    return store


def write(path: Path, store: Any, topics: dict[str, list[tuple[float, Any]]], *, form: str, compress: str = "") -> Path:
    """A bag of (log time in s, message) by topic; form: "bag", "db3" or "mcap"."""
    if form == "bag":
        writer: Any = Writer1(path)
        if compress:
            writer.set_compression(Writer1.CompressionFormat[compress.upper()])
        serialize = store.serialize_ros1
    else:
        writer = Writer2(
            path, version=9, storage_plugin=StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
        )
        if compress:
            mode, how = compress.split()
            writer.set_compression(CompressionMode[mode], CompressionFormat[how])
        serialize = store.serialize_cdr
    with writer:
        events = []
        for topic, messages in topics.items():
            kind = messages[0][1].__msgtype__
            connection = writer.add_connection(topic, kind, typestore=store)
            events += [(time, i, connection, kind, message) for i, (time, message) in enumerate(messages)]
        for time, _, connection, kind, message in sorted(events, key=lambda event: event[:2]):
            writer.write(connection, round(time * 1e9), serialize(message, kind))
    return path


def header(store: Any, seconds: float, seq: int = 0) -> Any:
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=int(seconds), nanosec=round(seconds % 1 * 1e9))
    kind = types["std_msgs/msg/Header"]
    if "seq" in kind.__dataclass_fields__:
        return kind(seq=seq, stamp=stamp, frame_id="tip")
    return kind(stamp=stamp, frame_id="tip")


def biotac(store: Any, electrodes: np.ndarray, stamp: float, seq: int = 0) -> Any:
    types = store.types

    def finger(values: np.ndarray) -> Any:
        return types["sr_robot_msgs/msg/Biotac"](
            pac0=1, pac1=2, pac=np.arange(22, dtype=np.int16), pdc=3, tac=4, tdc=5, electrodes=values
        )

    fingers = [finger(electrodes), *(finger(np.zeros_like(electrodes)) for _ in range(4))]
    return types["sr_robot_msgs/msg/BiotacAll"](header=header(store, stamp, seq), tactiles=fingers)


def array(store: Any, values: np.ndarray) -> Any:
    types = store.types
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    return types["std_msgs/msg/Float32MultiArray"](layout=layout, data=values.astype(np.float32))


def uskin(store: Any, taxels: np.ndarray, count: int, seconds: float) -> Any:
    types = store.types
    of = [types["xela_server_ros2/msg/Taxel"](*map(int, row)) for row in taxels]
    forces = [types["xela_server_ros2/msg/Forces"](0.5, 0.5, 0.5) for _ in taxels]
    full = types["xela_server_ros2/msg/SensorFull"](count, seconds, "XR1944", 1, of, forces)
    return types["xela_server_ros2/msg/SensStream"](sensors=[full])


def papillarray(store: Any, forces: np.ndarray, tus: int, stamp: float) -> Any:
    types = store.types
    kind = types["papillarray_ros_v2/msg/PillarState"]
    pillars = [kind(i, 0.0, 0.0, 0.0, *map(float, row), False, 0) for i, row in enumerate(forces)]
    return types["papillarray_ros_v2/msg/SensorState"](header(store, stamp), tus, pillars, 0.0)


def text(store: Any, value: str) -> Any:
    return store.types["std_msgs/msg/String"](data=value)

"""ROS 2 bag export, through rosbags: poses as geometry_msgs/PoseStamped and as transforms on /tf.

Gaps have no messages.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from sylpose.atomic_io import make_output_folder, output_errors, partial_path
from sylpose.io.exports.poses import Poses

__all__ = ["write_rosbag"]

WORLD_FRAME = "world"
# Bag format version (choice: what ROS 2 reads since Iron, and earlier ones too).
BAG_VERSION = 8


def write_rosbag(poses: Poses, path: Path) -> list[str]:
    """Write a bag folder in meters and return notes on it.

    Topics are /NAME/pose and /tf, from frame "world" to the object's name.

    Raises:
        ValueError: an existing folder, which is never replaced; times before 1970.
    """
    if path.exists():
        raise ValueError(f"{path}: already exists, and bags are not replaced")
    if poses.times[0] < 0:
        raise ValueError(f"a bag cannot have times before 0, and the first frame is at {poses.times[0]:g} s")
    poses = poses.in_unit("m")
    name = re.sub(r"\W", "_", poses.name, flags=re.ASCII)
    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = store.types
    stamp, head = kinds["builtin_interfaces/msg/Time"], kinds["std_msgs/msg/Header"]
    # Write into a temporary folder, but under the final name, which names the files in it.
    part = partial_path(path)
    with output_errors(path):
        shutil.rmtree(part, ignore_errors=True)
        try:
            make_output_folder(path.parent)
            part.mkdir()
            with Writer(part / path.name, version=BAG_VERSION) as bag:
                pose_connection = bag.add_connection(f"/{name}/pose", "geometry_msgs/msg/PoseStamped", typestore=store)
                tf_connection = bag.add_connection("/tf", "tf2_msgs/msg/TFMessage", typestore=store)
                for k in np.flatnonzero(poses.has_pose):
                    stamp_ns = round(float(poses.times[k]) * 1e9)
                    header = head(stamp(stamp_ns // 10**9, stamp_ns % 10**9), WORLD_FRAME)
                    (tx, ty, tz), quaternion = poses.positions[k].tolist(), poses.quaternions[k].tolist()
                    rotation = kinds["geometry_msgs/msg/Quaternion"](*quaternion)
                    pose = kinds["geometry_msgs/msg/Pose"](kinds["geometry_msgs/msg/Point"](tx, ty, tz), rotation)
                    message = kinds["geometry_msgs/msg/PoseStamped"](header, pose)
                    bag.write(pose_connection, stamp_ns, store.serialize_cdr(message, pose_connection.msgtype))
                    transform = kinds["geometry_msgs/msg/Transform"](
                        kinds["geometry_msgs/msg/Vector3"](tx, ty, tz), rotation
                    )
                    stamped = kinds["geometry_msgs/msg/TransformStamped"](header, name, transform)
                    message = kinds["tf2_msgs/msg/TFMessage"]([stamped])
                    bag.write(tf_connection, stamp_ns, store.serialize_cdr(message, tf_connection.msgtype))
            (part / path.name).rename(path)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    return [] if poses.unit == "m" else ["lengths are in the calibration's unknown unit, not m"]

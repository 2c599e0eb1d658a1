"""A ROS 2 bag, through rosbags: the poses as geometry_msgs/PoseStamped and as transforms on /tf; no message in gaps."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from sylpose.atomic_io import beside, output_folder, writing
from sylpose.exports.poses import Poses

__all__ = ["write_rosbag"]

WORLD = "world"
# Of the bag's own format (choice: what ROS 2 reads since Iron, and earlier ones too).
VERSION = 8


def write_rosbag(poses: Poses, path: Path) -> list[str]:
    """A folder, in metres; topics /NAME/pose and /tf, from frame "world" to the object's name.

    Raises:
        ValueError: a folder that is there, which no bag replaces; times before 1970.
    """
    if path.exists():
        raise ValueError(f"{path}: is there already, and no bag is replaced")
    if poses.times[0] < 0:
        raise ValueError(f"a bag has no times before 0, and the first frame is at {poses.times[0]:g} s")
    poses = poses.in_unit("m")
    name = re.sub(r"\W", "_", poses.name, flags=re.ASCII)
    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = store.types
    stamp, head = kinds["builtin_interfaces/msg/Time"], kinds["std_msgs/msg/Header"]
    # Under its own name, after which the files in it are called.
    part = beside(path)
    with writing(path):
        shutil.rmtree(part, ignore_errors=True)
        try:
            output_folder(path.parent)
            part.mkdir()
            with Writer(part / path.name, version=VERSION) as bag:
                poses_to = bag.add_connection(f"/{name}/pose", "geometry_msgs/msg/PoseStamped", typestore=store)
                transforms_to = bag.add_connection("/tf", "tf2_msgs/msg/TFMessage", typestore=store)
                for k in np.flatnonzero(poses.found):
                    at = round(float(poses.times[k]) * 1e9)
                    header = head(stamp(at // 10**9, at % 10**9), WORLD)
                    (tx, ty, tz), quaternion = poses.positions[k].tolist(), poses.quaternions[k].tolist()
                    turn = kinds["geometry_msgs/msg/Quaternion"](*quaternion)
                    pose = kinds["geometry_msgs/msg/Pose"](kinds["geometry_msgs/msg/Point"](tx, ty, tz), turn)
                    message = kinds["geometry_msgs/msg/PoseStamped"](header, pose)
                    bag.write(poses_to, at, store.serialize_cdr(message, poses_to.msgtype))
                    moved = kinds["geometry_msgs/msg/Transform"](kinds["geometry_msgs/msg/Vector3"](tx, ty, tz), turn)
                    stamped = kinds["geometry_msgs/msg/TransformStamped"](header, name, moved)
                    message = kinds["tf2_msgs/msg/TFMessage"]([stamped])
                    bag.write(transforms_to, at, store.serialize_cdr(message, transforms_to.msgtype))
            (part / path.name).rename(path)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    return [] if poses.unit == "m" else ["lengths are as in the calibration, which does not say its unit, and not m"]

"""glTF 2.0 export, .glb or .gltf: an animated node with the object's axes and points, hidden in gaps; cameras.

Key frames are the frames with a pose, and viewers interpolate between them; in gaps a step of the scale to 0 hides it.
"""

from __future__ import annotations

import base64
import json
import math
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sylpose.atomic_io import replace_atomically
from sylpose.geometry.arrays import FloatArray
from sylpose.io.exports.poses import UP_UNKNOWN_NOTE, Poses, find_runs, look_along_minus_z

FLOAT, UNSIGNED_INT, LINES, POINTS = 5126, 5125, 1, 0
_COLORS = np.eye(3)
# In glTF, y is up: a world with z up is rotated about x by -90 degrees; x y z w.
_Y_UP_FROM_Z_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]


def write_gltf(poses: Poses, path: Path) -> list[str]:
    """Write a glTF file with lengths in meters and times since the first frame, and return notes on it.

    Poses keep the world's axes; if z is up, a parent node rotates it to glTF's up axis.
    """
    poses = poses.in_unit("m")
    buffer = BufferBuilder()
    points = np.zeros((6, 3))
    points[1::2] = poses.axis_length * np.eye(3)
    mesh = {
        "POSITION": buffer.add_accessor(points, "VEC3", bounds=True),
        "COLOR_0": buffer.add_accessor(np.repeat(_COLORS, 2, 0), "VEC3"),
    }
    primitives = [{"attributes": mesh, "mode": LINES}]
    if len(cloud := poses.surroundings.points):
        attributes = {"POSITION": buffer.add_accessor(cloud, "VEC3", bounds=True)}
        attributes["COLOR_0"] = buffer.add_accessor(poses.surroundings.colors, "VEC3")
        primitives.append({"attributes": attributes, "mode": POINTS})
    has_pose, times = poses.has_pose, poses.times - poses.times[0]
    moved = times[has_pose], {"translation": poses.positions[has_pose], "rotation": poses.quaternions[has_pose]}
    animation = _build_animation(buffer, *moved, "LINEAR")
    if not has_pose.all():
        changes = sorted({0, *(k for run in find_runs(has_pose) for k in run if k < len(poses))})
        scales = np.where(has_pose[changes], 1.0, 0.0)[:, None] * np.ones(3)
        animation |= _build_animation(buffer, times[changes], {"scale": scales}, "STEP")
    channels = [{"sampler": k, "target": {"node": 1, "path": path}} for k, path in enumerate(animation)]
    cameras, camera_nodes = _build_cameras(poses)
    children = [*range(1, 2 + len(cameras))]
    world = {"name": "world", "children": children} | ({"rotation": _Y_UP_FROM_Z_UP} if poses.z_up else {})
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "sylpose"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [world, {"name": poses.name, "mesh": 0}, *camera_nodes],
        "meshes": [{"name": "axes", "primitives": primitives}],
        "animations": [{"name": "trajectory", "samplers": [*animation.values()], "channels": channels}],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    if cameras:
        content["cameras"] = cameras
    is_binary = path.suffix.lower() == ".glb"
    with replace_atomically(path) as part:
        part.write_bytes((encode_binary if is_binary else _encode_text)(content, bytes(buffer.data)))
    notes = poses.note_unit("m")
    return notes if poses.z_up else [*notes, UP_UNKNOWN_NOTE]


def _build_cameras(poses: Poses) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Build the cameras and their nodes; the format has neither principal points nor distortion."""
    cameras, nodes = [], []
    near, far = 0.1 * poses.axis_length, 1000.0 * poses.axis_length
    for k, camera in enumerate(poses.surroundings.cameras):
        (width, height), fx, fy = camera.size, float(camera.matrix[0, 0]), float(camera.matrix[1, 1])
        lens = {"yfov": 2.0 * math.atan(0.5 * height / fy), "aspectRatio": (width / fx) / (height / fy)}
        cameras.append(
            {"name": camera.name, "type": "perspective", "perspective": {**lens, "znear": near, "zfar": far}}
        )
        pose = look_along_minus_z(camera)
        at = {"translation": pose.translation.tolist(), "rotation": pose.rotation.as_quat().tolist()}
        nodes.append({"name": camera.name, "camera": k, **at})
    return cameras, nodes


def _build_animation(
    buffer: BufferBuilder, times: FloatArray, values: Mapping[str, FloatArray], interpolation: str
) -> dict[str, dict[str, Any]]:
    """Build the sampler of each animated property of a node."""
    start = buffer.add_accessor(times, "SCALAR", bounds=True)
    outputs = {path: buffer.add_accessor(array, f"VEC{array.shape[1]}") for path, array in values.items()}
    return {
        path: {"input": start, "output": output, "interpolation": interpolation} for path, output in outputs.items()
    }


class BufferBuilder:
    """Builder of a buffer of consecutive arrays, float32 or of indices, with their glTF views and accessors."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add_accessor(self, values: NDArray[Any], kind: str, bounds: bool = False) -> int:
        """Append an array and return the index of its accessor."""
        is_index = np.asarray(values).dtype.kind in "iu"
        array = np.ascontiguousarray(values, "<u4" if is_index else "<f4")
        rows = array.reshape(len(array), -1)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes})
        kind_of_number = UNSIGNED_INT if is_index else FLOAT
        accessor: dict[str, Any] = {"bufferView": len(self.views) - 1, "componentType": kind_of_number}
        accessor |= {"count": len(array), "type": kind}
        if bounds:
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self.data += array.tobytes()
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def _encode_text(content: dict[str, Any], data: bytes) -> bytes:
    content["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    return json.dumps(content).encode()


def encode_binary(content: dict[str, Any], data: bytes) -> bytes:
    """Encode as .glb: a header and two chunks, each padded to four bytes."""
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

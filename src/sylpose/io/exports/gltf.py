"""glTF 2.0 export, .glb or .gltf: an animated node with the object's axes, hidden in gaps.

Key frames are the frames with a pose, and viewers interpolate between them; in gaps a step of the scale to 0 hides it.
"""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sylpose.atomic_io import replace_atomically
from sylpose.io.exports.poses import UP_UNKNOWN_NOTE, Poses, find_runs

FLOAT, LINES = 5126, 1
_COLORS = np.eye(3)
# In glTF, y is up: a world with z up is rotated about x by -90 degrees; x y z w.
_Y_UP_FROM_Z_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]


def write_gltf(poses: Poses, path: Path) -> list[str]:
    """Write a glTF file with lengths in meters and times since the first frame, and return notes on it.

    Poses keep the world's axes; if z is up, a parent node rotates it to glTF's up axis.
    """
    poses = poses.in_unit("m")
    buffer = _BufferBuilder()
    points = np.zeros((6, 3))
    points[1::2] = poses.axis_length * np.eye(3)
    mesh = {
        "POSITION": buffer.add_accessor(points, "VEC3", bounds=True),
        "COLOR_0": buffer.add_accessor(np.repeat(_COLORS, 2, 0), "VEC3"),
    }
    has_pose, times = poses.has_pose, poses.times - poses.times[0]
    times_accessor = buffer.add_accessor(times[has_pose], "SCALAR", bounds=True)
    samplers: list[dict[str, Any]] = [
        {
            "input": times_accessor,
            "output": buffer.add_accessor(poses.positions[has_pose], "VEC3"),
            "interpolation": "LINEAR",
        },
        {
            "input": times_accessor,
            "output": buffer.add_accessor(poses.quaternions[has_pose], "VEC4"),
            "interpolation": "LINEAR",
        },
    ]
    animated_paths = ["translation", "rotation"]
    if not has_pose.all():
        changes = sorted({0, *(k for run in find_runs(has_pose) for k in run if k < len(poses))})
        scales = np.where(has_pose[changes], 1.0, 0.0)[:, None] * np.ones(3)
        visibility_accessors = (
            buffer.add_accessor(times[changes], "SCALAR", bounds=True),
            buffer.add_accessor(scales, "VEC3"),
        )
        samplers.append({"input": visibility_accessors[0], "output": visibility_accessors[1], "interpolation": "STEP"})
        animated_paths.append("scale")
    world = {"name": "world", "children": [1]} | ({"rotation": _Y_UP_FROM_Z_UP} if poses.z_up else {})
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "sylpose"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [world, {"name": poses.name, "mesh": 0}],
        "meshes": [{"name": "axes", "primitives": [{"attributes": mesh, "mode": LINES}]}],
        "animations": [
            {
                "name": "trajectory",
                "samplers": samplers,
                "channels": [
                    {"sampler": k, "target": {"node": 1, "path": what}} for k, what in enumerate(animated_paths)
                ],
            }
        ],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    with replace_atomically(path) as part:
        part.write_bytes(
            _encode_binary(content, bytes(buffer.data))
            if path.suffix.lower() == ".glb"
            else _encode_text(content, buffer.data)
        )
    notes = [] if poses.unit == "m" else ["lengths are in the calibration's unknown unit, not m"]
    return notes if poses.z_up else [*notes, UP_UNKNOWN_NOTE]


class _BufferBuilder:
    """Builder of a buffer of consecutive float32 arrays, with their glTF views and accessors."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add_accessor(self, values: NDArray[Any], kind: str, bounds: bool = False) -> int:
        """Append an array and return the index of its accessor."""
        array = np.ascontiguousarray(values, "<f4")
        rows = array.reshape(len(array), -1)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes})
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": FLOAT,
            "count": len(array),
            "type": kind,
        }
        if bounds:
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self.data += array.tobytes()
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def _encode_text(content: dict[str, Any], data: bytearray) -> bytes:
    content["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    return json.dumps(content).encode()


def _encode_binary(content: dict[str, Any], data: bytes) -> bytes:
    """Encode as .glb: a header and two chunks, each padded to four bytes."""
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

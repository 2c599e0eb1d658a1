"""glTF 2.0, .glb or .gltf: a node with the object's axes that moves; it is not to be seen in gaps.

What moves is told at the frames with a pose, between which viewers interpolate; in gaps a step of the scale to 0 hides it.
"""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sylpose.atomic_io import replacing
from sylpose.exports.poses import UP_UNKNOWN, Poses, runs_of

__all__ = ["write_gltf"]

FLOAT, LINES = 5126, 1
_COLORS = np.eye(3)
# glTF's y axis goes up: a world whose z axis does is turned about x by -90 degrees; x y z w.
_Y_UP_FROM_Z_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]


def write_gltf(poses: Poses, path: Path) -> list[str]:
    """Lengths in metres, times since the first frame; the world's axes are as they are, below a node that turns z,
    where that goes up, to where glTF has up."""
    poses = poses.in_unit("m")
    buffer = _Buffer()
    points = np.zeros((6, 3))
    points[1::2] = poses.axis * np.eye(3)
    mesh = {
        "POSITION": buffer.accessor(points, "VEC3", bounds=True),
        "COLOR_0": buffer.accessor(np.repeat(_COLORS, 2, 0), "VEC3"),
    }
    found, times = poses.found, poses.times - poses.times[0]
    at = buffer.accessor(times[found], "SCALAR", bounds=True)
    samplers: list[dict[str, Any]] = [
        {"input": at, "output": buffer.accessor(poses.positions[found], "VEC3"), "interpolation": "LINEAR"},
        {"input": at, "output": buffer.accessor(poses.quaternions[found], "VEC4"), "interpolation": "LINEAR"},
    ]
    moved = ["translation", "rotation"]
    if not found.all():
        changes = sorted({0, *(k for run in runs_of(found) for k in run if k < len(poses))})
        shown = np.where(found[changes], 1.0, 0.0)[:, None] * np.ones(3)
        seen = buffer.accessor(times[changes], "SCALAR", bounds=True), buffer.accessor(shown, "VEC3")
        samplers.append({"input": seen[0], "output": seen[1], "interpolation": "STEP"})
        moved.append("scale")
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
                "channels": [{"sampler": k, "target": {"node": 1, "path": what}} for k, what in enumerate(moved)],
            }
        ],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    with replacing(path) as part:
        part.write_bytes(
            _binary(content, bytes(buffer.data)) if path.suffix.lower() == ".glb" else _text(content, buffer.data)
        )
    notes = [] if poses.unit == "m" else ["lengths are as in the calibration, which does not say its unit, and not m"]
    return notes if poses.z_up else [*notes, UP_UNKNOWN]


class _Buffer:
    """Arrays of 32-bit floats, one behind the other, and what glTF says of them."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def accessor(self, values: NDArray[Any], kind: str, bounds: bool = False) -> int:
        """The number of an accessor to them."""
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


def _text(content: dict[str, Any], data: bytearray) -> bytes:
    content["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    return json.dumps(content).encode()


def _binary(content: dict[str, Any], data: bytes) -> bytes:
    """A header and two chunks, each a multiple of four bytes."""
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

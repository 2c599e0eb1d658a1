"""Agisoft Metashape's cameras as XML (File, Export, Export Cameras): an image of each camera, or several that agree.

A camera's transform takes its points to the chunk (x right, y down, z forward), the chunk's transform those to the world:
X_world = scale R X + t. A pixel is at f x' + cx + width / 2, whose first one's centre is (0.5, 0.5); p1 and p2 are the other
way round than OpenCV's.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.calibration.camera_builder import (
    attribute,
    make_camera,
    make_pose,
    make_rig,
    matrix_of,
    numbers,
    pose_of_matrix,
)
from sylpose.calibration.static_cameras import Shot, path_of, still_cameras
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import LensModel, Rig

__all__ = ["is_metashape", "read"]

HALF = 0.5


def is_metashape(root: Element) -> bool:
    """Whether XML has a chunk of Metashape's."""
    return root.tag == "document" and root.find("chunk/sensors") is not None


def read(root: Element, path: Path) -> Rig:
    """The rig of the images that are aligned, called by their labels.

    Raises:
        ValueError: naming the file, and the camera where there is one.
    """
    chunks = [chunk for chunk in root.findall("chunk") if chunk.find("cameras") is not None]
    if len(chunks) != 1:
        raise ValueError(f"{path}: {len(chunks)} chunks with cameras in this file of Metashape; one is needed")
    sensors = {sensor.get("id"): sensor for sensor in chunks[0].findall("sensors/sensor")}
    cameras = []
    if not (shots := list(_shots(chunks[0], path))):
        raise ValueError(f"{path}: no camera in this file of Metashape is aligned: none has a transform")
    for still in still_cameras(shots, path):
        where = f"{path}: camera {still.name}"
        sensor = sensors.get(still.lens)
        if sensor is None:
            raise ValueError(f"{where}: its sensor {still.lens} is not in this file of Metashape")
        lens = _lens(sensor, where)
        cameras.append(
            make_camera(
                path,
                still.name,
                size=lens.size,
                matrix=lens.matrix,
                distortion=lens.distortion,
                camera_from_world=still.camera_from_world,
                lens=lens.lens,
            )
        )
    return make_rig(path, cameras)


def _shots(chunk: Element, path: Path) -> Iterator[Shot]:
    """The aligned images in the world."""
    turn, shift, scale = np.eye(3), np.zeros(3), 1.0
    if (transform := chunk.find("transform")) is not None:
        where = f"{path}: the chunk's transform"
        if (node := transform.find("rotation")) is not None:
            turn = numbers(node.text or "", 9, f"{where}: rotation").reshape(3, 3)
        if (node := transform.find("translation")) is not None:
            shift = numbers(node.text or "", 3, f"{where}: translation")
        if (node := transform.find("scale")) is not None:
            scale = float(numbers(node.text or "", 1, f"{where}: scale")[0])
        if not scale > 0:
            raise ValueError(f"{where}: scale must be positive, got {scale:g}")
    world_from_chunk = make_pose(path, "of the chunk", turn, shift)
    for camera in chunk.iter("camera"):
        label = camera.get("label") or camera.get("id") or ""
        if camera.get("master_id") is not None:
            raise ValueError(
                f"{path}: camera {label}: multi-camera systems of Metashape are not read; align it by itself"
            )
        if (node := camera.find("transform")) is None:
            continue
        matrix = numbers(node.text or "", 16, f"{path}: camera {label}: transform")
        chunk_from_camera = pose_of_matrix(path, label, "transform", matrix)
        scaled = RigidTransform.from_components(scale * chunk_from_camera.translation, chunk_from_camera.rotation)
        pose = (world_from_chunk * scaled).inv()
        yield Shot(path_of(label), camera.get("sensor_id") or "", pose.rotation.as_quat(), pose.translation)


class _Lens(NamedTuple):
    size: FloatArray
    matrix: FloatArray
    distortion: FloatArray
    lens: LensModel


def _lens(sensor: Element, where: str) -> _Lens:
    found = sensor.findall("calibration")
    calibration = next((c for c in found if c.get("class") == "adjusted"), found[0] if found else None)
    if calibration is None:
        raise ValueError(f"{where}: its sensor {sensor.get('id')} has no calibration in this file of Metashape")
    kind = calibration.get("type") or sensor.get("type") or "frame"
    if kind not in ("frame", "fisheye"):
        raise ValueError(
            f"{where}: Metashape's {kind!r} camera model is none of OpenCV's, which sylpose has; frame and fisheye are"
        )
    if calibration.find("fx") is not None:
        raise ValueError(
            f"{where}: its calibration is in the form of an old PhotoScan (fx, fy); export it from Metashape"
        )
    value = {
        node.tag: numbers(node.text or "", 1, f"{where}: {node.tag}")[0] for node in calibration if node.tag in _TERMS
    }
    if "f" not in value:
        raise ValueError(f"{where}: missing 'f' in Metashape's calibration of its sensor")
    f, cx, cy, b1, b2, k1, k2, k3, k4, p1, p2, p3, p4 = (float(value.get(name, 0.0)) for name in _TERMS)
    fisheye = kind == "fisheye"
    more = {"b2": b2, "p3": p3, "p4": p4} | ({"p1": p1, "p2": p2} if fisheye else {"k4": k4})
    if used := [name for name, term in more.items() if term]:
        raise ValueError(
            f"{where}: {', '.join(used)} of Metashape's {kind} model is not in OpenCV's; calibrate without"
        )
    resolution = calibration.find("resolution")
    size = np.array([attribute(resolution, side, where)[0] for side in ("width", "height")])
    matrix = matrix_of(f + b1, f, size[0] / 2 + cx - HALF, size[1] / 2 + cy - HALF)
    terms = [k1, k2, k3, k4] if fisheye else [k1, k2, p2, p1, k3]
    return _Lens(size, matrix, np.array(terms), "fisheye" if fisheye else "opencv")


_TERMS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")

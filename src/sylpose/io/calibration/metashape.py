"""Agisoft Metashape's cameras as XML (File, Export, Export Cameras): one or more consistent images per camera.

A camera's transform maps its points to the chunk (x right, y down, z forward), the chunk's transform maps those to
the world: X_world = scale R X + t. Pixels are f x' + cx + width / 2, with the first one's center at (0.5, 0.5). p1
and p2 are swapped relative to OpenCV's.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.io.calibration.camera_builder import (
    intrinsic_matrix,
    make_camera,
    make_pose,
    make_rig,
    parse_attribute,
    parse_numbers,
    parse_pose_matrix,
)
from sylpose.io.calibration.static_cameras import PosedImage, find_static_cameras, image_path
from sylpose.rig import LensModel, Rig

__all__ = ["is_metashape", "read"]

PIXEL_CENTER = 0.5


def is_metashape(root: Element) -> bool:
    """Return whether XML has a Metashape chunk."""
    return root.tag == "document" and root.find("chunk/sensors") is not None


def read(root: Element, path: Path) -> Rig:
    """Read the rig of the aligned images, named by their labels.

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    chunks = [chunk for chunk in root.findall("chunk") if chunk.find("cameras") is not None]
    if len(chunks) != 1:
        raise ValueError(
            f"{path}: {len(chunks)} chunks with cameras in this file of Metashape; exactly one is required"
        )
    sensors = {sensor.get("id"): sensor for sensor in chunks[0].findall("sensors/sensor")}
    cameras = []
    if not (images := list(_find_images(chunks[0], path))):
        raise ValueError(f"{path}: no camera in this file of Metashape is aligned: none has a transform")
    for static_camera in find_static_cameras(images, path):
        where = f"{path}: camera {static_camera.name}"
        sensor = sensors.get(static_camera.lens)
        if sensor is None:
            raise ValueError(f"{where}: its sensor {static_camera.lens} is not in this file of Metashape")
        lens = _parse_lens(sensor, where)
        cameras.append(
            make_camera(
                path,
                static_camera.name,
                size=lens.size,
                matrix=lens.matrix,
                distortion=lens.distortion,
                camera_from_world=static_camera.camera_from_world,
                lens=lens.lens,
            )
        )
    return make_rig(path, cameras)


def _find_images(chunk: Element, path: Path) -> Iterator[PosedImage]:
    """Yield the aligned images with their poses in the world."""
    rotation, translation, scale = np.eye(3), np.zeros(3), 1.0
    if (transform := chunk.find("transform")) is not None:
        where = f"{path}: the chunk's transform"
        if (node := transform.find("rotation")) is not None:
            rotation = parse_numbers(node.text or "", 9, f"{where}: rotation").reshape(3, 3)
        if (node := transform.find("translation")) is not None:
            translation = parse_numbers(node.text or "", 3, f"{where}: translation")
        if (node := transform.find("scale")) is not None:
            scale = float(parse_numbers(node.text or "", 1, f"{where}: scale")[0])
        if not scale > 0:
            raise ValueError(f"{where}: scale must be positive, got {scale:g}")
    world_from_chunk = make_pose(path, "of the chunk", rotation, translation)
    for camera in chunk.iter("camera"):
        label = camera.get("label") or camera.get("id") or ""
        if camera.get("master_id") is not None:
            raise ValueError(
                f"{path}: camera {label}: multi-camera systems of Metashape are not supported; align it separately"
            )
        if (node := camera.find("transform")) is None:
            continue
        matrix = parse_numbers(node.text or "", 16, f"{path}: camera {label}: transform")
        chunk_from_camera = parse_pose_matrix(path, label, "transform", matrix)
        scaled = RigidTransform.from_components(scale * chunk_from_camera.translation, chunk_from_camera.rotation)
        pose = (world_from_chunk * scaled).inv()
        yield PosedImage(image_path(label), camera.get("sensor_id") or "", pose.rotation.as_quat(), pose.translation)


class _LensParameters(NamedTuple):
    size: FloatArray
    matrix: FloatArray
    distortion: FloatArray
    lens: LensModel


def _parse_lens(sensor: Element, where: str) -> _LensParameters:
    found = sensor.findall("calibration")
    calibration = next((c for c in found if c.get("class") == "adjusted"), found[0] if found else None)
    if calibration is None:
        raise ValueError(f"{where}: its sensor {sensor.get('id')} has no calibration in this file of Metashape")
    kind = calibration.get("type") or sensor.get("type") or "frame"
    if kind not in ("frame", "fisheye"):
        raise ValueError(f"{where}: Metashape's {kind!r} camera model is not supported; frame and fisheye are")
    if calibration.find("fx") is not None:
        raise ValueError(
            f"{where}: its calibration has the format of an old PhotoScan (fx, fy); export it from Metashape"
        )
    value = {
        node.tag: parse_numbers(node.text or "", 1, f"{where}: {node.tag}")[0]
        for node in calibration
        if node.tag in _TERMS
    }
    if "f" not in value:
        raise ValueError(f"{where}: missing 'f' in Metashape's calibration of its sensor")
    f, cx, cy, b1, b2, k1, k2, k3, k4, p1, p2, p3, p4 = (float(value.get(name, 0.0)) for name in _TERMS)
    fisheye = kind == "fisheye"
    unsupported = {"b2": b2, "p3": p3, "p4": p4} | ({"p1": p1, "p2": p2} if fisheye else {"k4": k4})
    if nonzero := [name for name, term in unsupported.items() if term]:
        raise ValueError(
            f"{where}: {', '.join(nonzero)} of Metashape's {kind} model is not in OpenCV's; calibrate without it"
        )
    resolution = calibration.find("resolution")
    size = np.array([parse_attribute(resolution, side, where)[0] for side in ("width", "height")])
    matrix = intrinsic_matrix(f + b1, f, size[0] / 2 + cx - PIXEL_CENTER, size[1] / 2 + cy - PIXEL_CENTER)
    terms = [k1, k2, k3, k4] if fisheye else [k1, k2, p2, p1, k3]
    return _LensParameters(size, matrix, np.array(terms), "fisheye" if fisheye else "opencv")


_TERMS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")

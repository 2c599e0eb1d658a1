"""Lenses for a recording whose cameras are still to be located: calibration files without poses, or of one camera."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.validation import check_number
from sylpose.input_limits import input_errors
from sylpose.io.calibration import filestorage
from sylpose.io.calibration.camera_builder import SizeLookup
from sylpose.io.calibration.files import load
from sylpose.io.calibration.markup import read_content
from sylpose.rig import Camera, Rig, make_look_at_camera

# Fields of view of lenses without much distortion (choice: telephoto to wide-angle).
MIN_FOV_DEG, MAX_FOV_DEG = 1.0, 130.0
# A file and the name of its camera; None: as in the file, or as the file is called, or all cameras.
LensFile = tuple[str | None, Path]
# Horizontal field of view, degrees; "exif": as the images' EXIF states.
Fov = float | Literal["exif"]
# Looks up focal lengths by camera, pixels.
FocalLookup = Callable[[Sequence[str]], Mapping[str, float]]


def parse_lens_files(texts: Sequence[str]) -> list[LensFile]:
    """Parse `FILE` or `CAM=FILE`; a file whose name contains "=" is found as it is."""
    files = list[LensFile]()
    for text in texts:
        name, equals, file = text.partition("=")
        is_named = bool(name and equals and file) and not Path(text).exists()
        files.append((name, Path(file)) if is_named else (None, Path(text)))
    return files


def load_lenses(files: Sequence[LensFile], names: Sequence[str], sizes: SizeLookup) -> Rig:
    """Load lenses of a recording's cameras; poses in the files are ignored.

    A file is a calibration of any format, with poses or without, of several cameras or of one. That of one camera belongs
    to the camera that is given, to that of its own name or file name, or, if it is the only file, to all.

    Args:
        files: the files.
        names: of the recording's cameras.
        sizes: looks up image sizes that a file does not have.

    Returns:
        the cameras, all with the identity as pose.

    Raises:
        OSError: a file that cannot be read.
        ValueError: naming the file, and the camera: no lens, two lenses of a camera, or a camera without one.
    """
    found, is_complete = dict[str, Camera](), False
    for given, path in files:
        cameras = _read_cameras(path, sizes, names, given or path.stem)
        own = [camera.name for camera in cameras]
        if given is not None:
            if len(cameras) > 1 and given not in own:
                raise ValueError(f"{path}: no camera {given}; it has {', '.join(own)}")
            chosen = cameras[own.index(given)] if given in own else cameras[0]
            found_here = [replace(chosen, name=given)]
        elif len(cameras) > 1 or own[0] in names:
            found_here, is_complete = cameras, is_complete or len(cameras) > 1
        elif path.stem in names:
            found_here = [replace(cameras[0], name=path.stem)]
        elif len(files) == 1:
            found_here = [replace(_read_cameras(path, sizes, names, name)[0], name=name) for name in names]
        else:
            raise ValueError(f"{path}: which camera is it? Give CAM={path}, CAM one of {', '.join(names)}")
        for camera in found_here:
            if camera.name in found:
                raise ValueError(f"{path}: camera {camera.name}: it is also in another file")
            found[camera.name] = camera
    if not is_complete and (missing := [name for name in names if name not in found]):
        raise ValueError(
            f"{', '.join(str(path) for _, path in files)}: no lens of camera {missing[0]}: give {missing[0]}=FILE, or leave "
            "the camera out"
        )
    return Rig([replace(camera, camera_from_world=RigidTransform.identity()) for camera in found.values()])


def parse_fov(text: str | None) -> Fov | None:
    """Parse a field of view in degrees, or `exif`; None for none.

    Raises:
        ValueError: anything else.
    """
    if text is None:
        return None
    if text == "exif":
        return "exif"
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"fov: degrees, or exif for photographs, are expected, got {text!r}") from None


def guess_lenses(fov: Fov, names: Sequence[str], sizes: SizeLookup, focal_lengths: FocalLookup) -> Rig:
    """Return lenses without distortion, with the identity as pose.

    Args:
        fov: horizontal field of view of all cameras, degrees; or "exif": that of each camera's images.
        names: of the recording's cameras.
        sizes: looks up their image sizes.
        focal_lengths: looks up their focal lengths in EXIF, pixels.

    Raises:
        ValueError: a field of view that no such lens has; no EXIF.
    """
    if fov != "exif":
        check_number(fov, 'fov, unless it is "exif",')
    found = sizes(names)
    focal = focal_lengths(names) if fov == "exif" else {}
    cameras = []
    for name in names:
        angle = np.degrees(2.0 * np.arctan(0.5 * found[name][0] / focal[name])) if focal else float(fov)
        if not MIN_FOV_DEG <= angle <= MAX_FOV_DEG:
            where = f" in the EXIF of {name}" if focal else ""
            raise ValueError(f"fov must be {MIN_FOV_DEG:g} to {MAX_FOV_DEG:g} degrees, got {angle:g}{where}")
        length = 0.5 * found[name][0] / np.tan(np.radians(angle) / 2.0)
        cameras.append(make_look_at_camera(name, np.zeros(3), (0, 0, 1), length, found[name]))
    return Rig(cameras)


def _read_cameras(path: Path, sizes: SizeLookup, names: Sequence[str], name: str) -> list[Camera]:
    """Read a file's cameras; one that has no name gets `name`, and the first camera's size if it is not in `names`."""

    def lookup(wanted: Sequence[str]) -> Mapping[str, tuple[int, int]]:
        # The size of a video is found by the names of all cameras.
        if not {*wanted} <= {*names, name}:
            return sizes(wanted)
        found = sizes(names)
        return {its: found[its if its in found else names[0]] for its in wanted if its in found or its == name}

    with input_errors(path):
        try:
            return list(load(path, sizes))
        except ValueError as error:
            if path.is_dir():
                raise
            problem = error
        _, data = read_content(path)
        if not isinstance(data, dict):
            raise problem
        return filestorage.read_lenses(data, path, lookup, name)

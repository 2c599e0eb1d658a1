"""A world of one's own: how it lies in the calibration's, and as a file (docs/formats.md, "Worlds")."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.atomic_io import replacing, toml_string
from sylpose.calibration.camera_builder import convert, rigid
from sylpose.calibration.world_points import standing_at, world_of_points
from sylpose.geometry.validation import finite, kind_of, number
from sylpose.input_limits import parsed_toml, text_of, told
from sylpose.rig import MAX_LENGTH, Rig, single_pose
from sylpose.units import METRES

__all__ = ["FORMAT", "World", "load_world", "save_world", "told_in", "up_in_words", "world_with_up"]

FORMAT = "sylpose-world-1"
# Of an axis that is to show where x is to lie in the plane, the least share that does (choice: 3 degrees from upright).
LEVEL = 0.05
_HEADER = """\
# A world of one's own, for --world of sylpose: X_world = scale (rotation X_calibration + translation).
# unit: of the translation, the calibration's; world_unit: of lengths in this world.
"""
_NUMBER = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_THREE = rf"\s*{_NUMBER}\s*,\s*{_NUMBER}\s*,\s*{_NUMBER}\s*"


@dataclass(frozen=True, eq=False)
class World:
    """A world, by the calibration's.

    Attributes:
        world_from_calibration: in lengths of the calibration.
        said: where it comes from, for people.
        unit: of the calibration's lengths, or "".
        scale: by what lengths are multiplied, after that.
        world_unit: of lengths then, or "".

    Raises:
        TypeError, ValueError: a pose that is none; a scale that is not positive.
    """

    world_from_calibration: RigidTransform
    said: str = ""
    unit: str = ""
    scale: float = 1.0
    world_unit: str = ""

    def __post_init__(self) -> None:
        single_pose(self.world_from_calibration, "world_from_calibration")
        for name in ("said", "unit", "world_unit"):
            kind_of(getattr(self, name), str, name)
        number(self.scale, "scale", above=0.0, least=1e-12, most=1e12)


class _Pose(msgspec.Struct, forbid_unknown_fields=True):
    rotation: list[list[float]] | None = None
    quaternion: list[float] | None = None
    translation: list[float] | None = None
    matrix: list[list[float]] | None = None


class _File(msgspec.Struct, forbid_unknown_fields=True):
    format: str
    world_from_calibration: _Pose
    said: str = ""
    unit: str = ""
    scale: float = 1.0
    world_unit: str | None = None


def told_in(rig: Rig, world: World) -> Rig:
    """A rig in a world; poses `world_from_object` and their covariances then are, too.

    Raises:
        ValueError: the world was found in a unit that the rig's lengths cannot be told in.
    """
    pose, factor = world.world_from_calibration, 1.0
    if rig.unit != world.unit:
        if not {rig.unit, world.unit} <= METRES.keys():
            units = [f"in {unit}" if unit else "in a unit that is not said" for unit in (world.unit, rig.unit)]
            raise ValueError(f"world: it was found {units[0]}, and the calibration is {units[1]}")
        factor = METRES[world.unit] / METRES[rig.unit]
        pose = RigidTransform.from_components(factor * pose.translation, pose.rotation)
    # Without a scale lengths stay in the rig's unit, whatever that is.
    turned = rig.in_world(pose)
    if world.scale == 1.0 and world.world_unit == world.unit:
        return turned
    scale, poses = world.scale / factor, [camera.camera_from_world for camera in turned]
    moved = [RigidTransform.from_components(scale * pose.translation, pose.rotation) for pose in poses]
    return Rig([replace(c, camera_from_world=pose) for c, pose in zip(rig, moved, strict=True)], world.world_unit)


def world_with_up(up: ArrayLike, origin: ArrayLike = (0.0, 0.0, 0.0), *, unit: str = "", said: str = "") -> World:
    """A world whose z axis goes up; its x axis goes where the calibration's goes along the floor, or, if that is upright,
    where its y axis goes.

    Args:
        up: (3,) in the calibration's world, of any length.
        origin: (3,) there.
        unit: of the calibration's lengths, or "" where that says none.
        said: where it comes from, for people.

    Raises:
        ValueError: numbers that are not finite; no direction.
    """
    up, origin = finite(up, (3,), "up"), finite(origin, (3,), "origin", most=MAX_LENGTH)
    length = float(np.linalg.norm(up))
    if not length > 1e-12:
        raise ValueError("up must be a direction, got (0, 0, 0)")
    z = up / length
    along = np.eye(3) - np.outer(z, z)
    x = next(axis for axis in along if np.linalg.norm(axis) > LEVEL)
    return World(standing_at(origin, x, z), said, unit, 1.0, unit)


def up_in_words(text: str, unit: str = "") -> World | None:
    """The world of `up=0,-1,0` or `up=-y`, with or without `origin=0.1,0.2,0` behind; None of anything else.

    Raises:
        ValueError: it begins like that and goes on otherwise.
    """
    if not re.match(r"\s*up\s*=", text):
        return None
    found = re.fullmatch(rf"\s*up\s*=({_THREE}|\s*[+-]?[xyz]\s*)(?:[,;\s]\s*origin\s*=({_THREE}))?", text)
    if found is None:
        raise ValueError(
            f"{text!r}: up=0,-1,0 or up=-y is expected, and origin=0.1,0.2,0 behind it where that is wanted"
        )
    if axis := re.fullmatch(r"([+-]?)([xyz])", found[1].strip()):
        up = (-1.0 if axis[1] == "-" else 1.0) * np.eye(3)["xyz".index(axis[2])]
    else:
        up = np.array([float(part) for part in found[1].split(",")])
    origin = [float(part) for part in found[2].split(",")] if found[2] else [0.0, 0.0, 0.0]
    return world_with_up(up, origin, unit=unit, said=text.strip())


def load_world(path: Path | str, rig: Rig) -> World:
    """A world of a file: as `save_world` writes it, or of three points as `world_points` reads them.

    Args:
        path: of the file.
        rig: the calibration that it is told in.

    Raises:
        OSError: it is not there or cannot be read.
        ValueError: naming the file: neither of the two; a matrix that is no rotation; points that make no world.
    """
    path = Path(path)
    text = text_of(path)
    with told(path):
        try:
            data = parsed_toml(text)
        except tomllib.TOMLDecodeError as error:
            raise ValueError(f"not valid TOML: {error}") from None
        if "format" not in data and "world_from_calibration" not in data:
            pose, scale, unit = world_of_points(data, rig)
            return World(pose, f"points of {path.name}", rig.unit, scale, unit)
        return _read(data, path)


def save_world(world: World, path: Path | str) -> None:
    """Writes a world; loading gives the same one, to rounding.

    Raises:
        OSError: naming the file that cannot be written.
    """
    matrix = world.world_from_calibration.as_matrix()
    rows = "[\n" + "".join(f"    {row},\n" for row in matrix[:3, :3].tolist()) + "]"
    said = f"said = {toml_string(world.said)}\nunit = {toml_string(world.unit)}\n"
    scaled = f"scale = {float(world.scale)!r}\nworld_unit = {toml_string(world.world_unit)}\n"
    pose = f"\n[world_from_calibration]\nrotation = {rows}\ntranslation = {matrix[:3, 3].tolist()}\n"
    with replacing(path) as part:
        part.write_text(f"{_HEADER}\nformat = {toml_string(FORMAT)}\n{said}{scaled}{pose}", encoding="utf-8")


def _read(data: dict[str, Any], path: Path) -> World:
    data = {"format": FORMAT, **data}
    if data["format"] != FORMAT:
        raise ValueError(f"the format is {data['format']!r}; this version of sylpose reads {FORMAT!r}")
    file = convert(data, _File, str(path))
    its = file.world_from_calibration
    given = [name for name in ("matrix", "rotation", "quaternion") if getattr(its, name) is not None]
    if len(given) != 1 or (given == ["matrix"]) == (its.translation is not None):
        raise ValueError(
            "world_from_calibration must have a matrix (3x4 or 4x4), or a translation and a rotation (3x3) or quaternion "
            "(x, y, z, w)"
        )
    where = f"{path}: world_from_calibration"
    if its.quaternion is not None:
        about = finite(its.quaternion, (4,), f"{where}: the quaternion")
        if abs(np.linalg.norm(about) - 1.0) > 1e-3:
            raise ValueError(f"{where}: the quaternion must have length 1")
        pose = rigid(where, Rotation.from_quat(about).as_matrix(), its.translation)
    elif its.matrix is not None:
        try:
            matrix = np.array(its.matrix, dtype=float)
        except ValueError:
            matrix = np.empty(0)
        if matrix.shape not in ((3, 4), (4, 4)) or (matrix.shape == (4, 4) and (matrix[3] != [0, 0, 0, 1]).any()):
            raise ValueError(f"{where}: the matrix must be 3x4, or 4x4 with (0, 0, 0, 1) as last row")
        pose = rigid(where, matrix[:3, :3], matrix[:3, 3])
    else:
        pose = rigid(where, its.rotation, its.translation)
    world_unit = file.unit if file.world_unit is None else file.world_unit
    return World(pose, file.said, file.unit, file.scale, world_unit)

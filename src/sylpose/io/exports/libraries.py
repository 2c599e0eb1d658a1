"""Exports through libraries of others, imported on use: C3D (ezc3d), Parquet (pyarrow), ROS 2 bags (rosbags), USD."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sylpose.atomic_io import make_output_folder, output_errors, partial_path, replace_atomically
from sylpose.io.exports.poses import UP_UNKNOWN_NOTE, Poses, look_along_minus_z
from sylpose.units import METERS

if TYPE_CHECKING:
    from pxr import Sdf, Usd


WORLD_FRAME = "world"
# Bag format version (choice: what ROS 2 reads since Iron, and earlier ones too).
BAG_VERSION = 8


def write_rosbag(poses: Poses, path: Path) -> list[str]:
    """Write a bag folder in meters and return notes on it.

    Topics are /NAME/pose and /tf, from frame "world" to the object's name.

    Raises:
        ValueError: an existing folder, which is never replaced; times before 1970.
    """
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

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
                    translation = kinds["geometry_msgs/msg/Vector3"](tx, ty, tz)
                    transform = kinds["geometry_msgs/msg/Transform"](translation, rotation)
                    stamped = kinds["geometry_msgs/msg/TransformStamped"](header, name, transform)
                    message = kinds["tf2_msgs/msg/TFMessage"]([stamped])
                    bag.write(tf_connection, stamp_ns, store.serialize_cdr(message, tf_connection.msgtype))
            (part / path.name).rename(path)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    return poses.note_unit("m")


def write_c3d(poses: Poses, path: Path) -> list[str]:
    """Write a C3D file in mm and return notes on it.

    In gaps, markers have the residual -1, which marks them as missing. If z is known to be up, the parameters X_SCREEN
    and Y_SCREEN set the initial view accordingly.

    Raises:
        ValueError: frames that are not at a steady rate.
    """
    import ezc3d

    rate, poses = poses.compute_rate("c3d"), poses.in_unit("mm")
    names, positions = poses.compute_markers()
    file = ezc3d.c3d()
    point = file["parameters"]["POINT"]
    point["RATE"]["value"] = [rate]
    point["LABELS"]["value"] = names
    point["UNITS"]["value"] = [poses.unit or "units"]
    if poses.z_up:
        file.add_parameter("POINT", "X_SCREEN", ["+X"])
        file.add_parameter("POINT", "Y_SCREEN", ["+Z"])
    is_present = np.asarray(np.isfinite(positions).all(axis=2))
    data = np.ones((4, len(names), len(poses)))
    data[:3] = np.where(is_present[:, :, None], positions, 0.0).transpose(2, 1, 0)
    file["data"]["points"] = data
    file["data"]["meta_points"]["residuals"] = np.where(is_present, 0.0, -1.0).T[None]
    with replace_atomically(path) as part:
        file.write(str(part))
    return poses.note_unit("mm")


def write_parquet(table: dict[str, list[Any]], path: Path) -> list[str]:
    """Write the columns of `report.files`."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {name: pa.array(column, from_pandas=True) for name, column in table.items()}
    with replace_atomically(path) as part:
        pq.write_table(pa.table(columns), part)
    return []


def write_usd(poses: Poses, path: Path) -> list[str]:
    """Write a USD stage with one time code per frame from the first one on, and return notes on it.

    Poses keep the world's axes; upAxis is z if z is known to be up.
    """
    from pxr import Gf, Usd, UsdGeom

    with replace_atomically(path) as part:
        stage = Usd.Stage.CreateNew(str(part))
        # Time codes are frames: importers such as Blender's ignore fractions of a code.
        rate = poses.typical_rate
        codes = np.round(rate * (poses.times - poses.times[0]), 6)
        stage.SetTimeCodesPerSecond(rate)
        stage.SetFramesPerSecond(rate)
        stage.SetStartTimeCode(0.0)
        stage.SetEndTimeCode(float(codes[-1]))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z if poses.z_up else UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, METERS.get(poses.unit, 1.0))
        world = UsdGeom.Xform.Define(stage, "/world")
        stage.SetDefaultPrim(world.GetPrim())
        node = UsdGeom.Xform.Define(stage, f"/world/{_make_identifier(poses.name)}")
        _add_axes(stage, node.GetPath(), poses.axis_length)
        _add_surroundings(stage, node.GetPath(), poses)
        precision = UsdGeom.XformOp.PrecisionDouble
        translate_op, orient_op = node.AddTranslateOp(precision), node.AddOrientOp(precision)
        visibility = node.CreateVisibilityAttr()
        previous = None
        for time, has_pose, position, (x, y, z, w) in zip(
            codes, poses.has_pose, poses.positions, poses.quaternions, strict=True
        ):
            if has_pose:
                translate_op.Set(Gf.Vec3d(*position.tolist()), float(time))
                orient_op.Set(Gf.Quatd(float(w), float(x), float(y), float(z)), float(time))
            if has_pose != previous:
                visibility.Set(UsdGeom.Tokens.inherited if has_pose else UsdGeom.Tokens.invisible, float(time))
            previous = has_pose
        stage.GetRootLayer().Save()
        del stage
    notes = [] if poses.unit else ["lengths are assumed to be meters: the calibration has no unit"]
    return notes if poses.z_up else [*notes, UP_UNKNOWN_NOTE]


def _add_surroundings(stage: Usd.Stage, parent: Sdf.Path, poses: Poses) -> None:
    """Add points to the object, and cameras to the world; they have no lens distortion."""
    from pxr import Gf, UsdGeom, Vt

    cloud = poses.surroundings
    if len(cloud.points):
        points = UsdGeom.Points.Define(stage, parent.AppendChild("points"))
        points.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(cloud.points.astype(np.float32)))
        points.CreateWidthsAttr([0.02 * poses.axis_length])
        points.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        colors = points.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        colors.Set(Vt.Vec3fArray.FromNumpy(cloud.colors.astype(np.float32)))
    for camera in cloud.cameras:
        prim = UsdGeom.Camera.Define(stage, f"/world/cameras/{_make_identifier(camera.name)}")
        prim.AddTransformOp().Set(Gf.Matrix4d(look_along_minus_z(camera).as_matrix().T.tolist()))
        (width, height), (fx, fy) = camera.size, camera.matrix[[0, 1], [0, 1]].tolist()
        # Lengths of the lens have an own unit, of which only ratios matter: a width of 36 (choice: full frame, mm).
        scale = 36.0 / width
        prim.CreateFocalLengthAttr(fx * scale)
        prim.CreateHorizontalApertureAttr(36.0)
        prim.CreateVerticalApertureAttr(height * scale * fx / fy)
        # Pixel centers are whole numbers, so that the image's middle is half a pixel less than half its size.
        prim.CreateHorizontalApertureOffsetAttr((0.5 * (width - 1) - camera.matrix[0, 2]) * scale)
        prim.CreateVerticalApertureOffsetAttr((camera.matrix[1, 2] - 0.5 * (height - 1)) * scale * fx / fy)
        prim.CreateClippingRangeAttr(Gf.Vec2f(0.1 * poses.axis_length, 1000.0 * poses.axis_length))


def _make_identifier(name: str) -> str:
    """Return the name of a prim: letters, digits and underscores."""
    text = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in name)
    return text if text[0].isalpha() else f"_{text}"


def _add_axes(stage: Usd.Stage, parent: Sdf.Path, length: float) -> None:
    """Draw three lines, red, green and blue."""
    from pxr import Gf, UsdGeom, Vt

    curves = UsdGeom.BasisCurves.Define(stage, parent.AppendChild("axes"))
    points = np.zeros((6, 3))
    points[1::2] = length * np.eye(3)
    curves.CreateTypeAttr(UsdGeom.Tokens.linear)
    curves.CreateCurveVertexCountsAttr([2, 2, 2])
    curves.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    curves.CreateWidthsAttr([0.02 * length])
    curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    curves.CreateDisplayColorPrimvar(UsdGeom.Tokens.uniform).Set([Gf.Vec3f(*row) for row in np.eye(3).tolist()])

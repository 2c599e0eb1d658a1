"""USD export, through usd-core: a moving Xform with the object's axes, invisible in gaps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from sylpose.atomic_io import replace_atomically
from sylpose.io.exports.poses import UP_UNKNOWN_NOTE, Poses
from sylpose.units import METERS

__all__ = ["write_usd"]


def write_usd(poses: Poses, path: Path) -> list[str]:
    """Write a USD stage with times since the first frame, and return notes on it.

    Poses keep the world's axes; upAxis is z if z is known to be up.
    """
    with replace_atomically(path) as part:
        stage = Usd.Stage.CreateNew(str(part))
        stage.SetTimeCodesPerSecond(1.0)
        stage.SetStartTimeCode(0.0)
        stage.SetEndTimeCode(float(poses.times[-1] - poses.times[0]))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z if poses.z_up else UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, METERS.get(poses.unit, 1.0))
        world = UsdGeom.Xform.Define(stage, "/world")
        stage.SetDefaultPrim(world.GetPrim())
        name = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in poses.name)
        node = UsdGeom.Xform.Define(stage, f"/world/{name if name[0].isalpha() else f'_{name}'}")
        _add_axes(stage, node.GetPath(), poses.axis_length)
        translate_op, orient_op = (
            node.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble),
            node.AddOrientOp(UsdGeom.XformOp.PrecisionDouble),
        )
        visibility = node.CreateVisibilityAttr()
        previous = None
        for time, has_pose, position, (x, y, z, w) in zip(
            poses.times - poses.times[0], poses.has_pose, poses.positions, poses.quaternions, strict=True
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


def _add_axes(stage: Usd.Stage, parent: Sdf.Path, length: float) -> None:
    """Draw three lines, red, green and blue."""
    curves = UsdGeom.BasisCurves.Define(stage, parent.AppendChild("axes"))
    points = np.zeros((6, 3))
    points[1::2] = length * np.eye(3)
    curves.CreateTypeAttr(UsdGeom.Tokens.linear)
    curves.CreateCurveVertexCountsAttr([2, 2, 2])
    curves.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    curves.CreateWidthsAttr([0.02 * length])
    curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    curves.CreateDisplayColorPrimvar(UsdGeom.Tokens.uniform).Set([Gf.Vec3f(*row) for row in np.eye(3).tolist()])

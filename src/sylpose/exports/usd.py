"""USD, through usd-core: an Xform with the object's axes that moves; it is invisible in gaps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from sylpose.atomic_io import replacing
from sylpose.exports.poses import UP_UNKNOWN, Poses
from sylpose.units import METRES

__all__ = ["write_usd"]


def write_usd(poses: Poses, path: Path) -> list[str]:
    """Times are seconds since the first frame; the world's axes are as they are, and upAxis says where z goes up."""
    with replacing(path) as part:
        stage = Usd.Stage.CreateNew(str(part))
        stage.SetTimeCodesPerSecond(1.0)
        stage.SetStartTimeCode(0.0)
        stage.SetEndTimeCode(float(poses.times[-1] - poses.times[0]))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z if poses.z_up else UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, METRES.get(poses.unit, 1.0))
        world = UsdGeom.Xform.Define(stage, "/world")
        stage.SetDefaultPrim(world.GetPrim())
        name = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in poses.name)
        node = UsdGeom.Xform.Define(stage, f"/world/{name if name[0].isalpha() else f'_{name}'}")
        _axes(stage, node.GetPath(), poses.axis)
        move, turn = (
            node.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble),
            node.AddOrientOp(UsdGeom.XformOp.PrecisionDouble),
        )
        shown = node.CreateVisibilityAttr()
        before = None
        for time, found, place, (x, y, z, w) in zip(
            poses.times - poses.times[0], poses.found, poses.positions, poses.quaternions, strict=True
        ):
            if found:
                move.Set(Gf.Vec3d(*place.tolist()), float(time))
                turn.Set(Gf.Quatd(float(w), float(x), float(y), float(z)), float(time))
            if found != before:
                shown.Set(UsdGeom.Tokens.inherited if found else UsdGeom.Tokens.invisible, float(time))
            before = found
        stage.GetRootLayer().Save()
        del stage
    notes = [] if poses.unit else ["lengths are taken for metres: the calibration does not say its unit"]
    return notes if poses.z_up else [*notes, UP_UNKNOWN]


def _axes(stage: Usd.Stage, parent: Sdf.Path, length: float) -> None:
    """Three lines, red, green and blue."""
    curves = UsdGeom.BasisCurves.Define(stage, parent.AppendChild("axes"))
    points = np.zeros((6, 3))
    points[1::2] = length * np.eye(3)
    curves.CreateTypeAttr(UsdGeom.Tokens.linear)
    curves.CreateCurveVertexCountsAttr([2, 2, 2])
    curves.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    curves.CreateWidthsAttr([0.02 * length])
    curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    curves.CreateDisplayColorPrimvar(UsdGeom.Tokens.uniform).Set([Gf.Vec3f(*row) for row in np.eye(3).tolist()])

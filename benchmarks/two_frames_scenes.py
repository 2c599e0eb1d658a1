"""Scenes of the two-frame benchmark: parameters of the rows, and seeded scenes.

A row's name is part of the seed of its scenes.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.simulate import Body, OutlierKind, arc, box, cloud, dome, ellipsoid, random_motion, ring, simulate_matches

__all__ = ["ROWS", "Row", "Scene", "make_scene"]


BODIES: dict[str, Body] = {
    "ellipsoid": ellipsoid((0.15, 0.12, 0.1)),
    "box": box((0.25, 0.2, 0.15)),
    # A board with two sides, which no camera matches edge-on.
    "plane": box((0.3, 0.2, 1e-9)),
    "cloud": cloud((0.15, 0.12, 0.1)),
}


@dataclass(frozen=True)
class Row:
    """One row of the benchmark: the base scene with changed parameters.

    Attributes:
        name: name in the table.
        problem: "motion" (two frames, unknown object) or "pose" (one frame, known object).
        cameras, layout: number of cameras on a full ring, an arc (30 degrees apart) or a dome. Two cameras on a "ring" are
            90 degrees apart, since opposite cameras see less than two cameras usually do.
        matches: number per camera, outliers included.
        noise: standard deviation per coordinate, pixels.
        rotation_deg: rotation in degrees about a random axis. The translation is 1 to 5 cm in a random direction.
        focal, distance: pixels and meters; their ratio, and with it the object's image size, is the same for all rows.
        outliers, outlier_kind: outlier ratio of each camera, and kind of outliers (`sylpose.simulate.simulate_matches`).
        has_junk_camera: all matches of the second camera are outliers.
        calibration_error_deg: rotation error of the second camera's calibration, degrees.
    """

    name: str
    problem: Literal["motion", "pose"] = "motion"
    cameras: int = 4
    layout: Literal["ring", "arc", "dome"] = "ring"
    matches: int = 60
    noise: float = 0.5
    rotation_deg: float = 5.0
    focal: float = 1000.0
    distance: float = 1.5
    body: str = "ellipsoid"
    outliers: float = 0.0
    outlier_kind: OutlierKind = "uniform"
    has_junk_camera: bool = False
    calibration_error_deg: float = 0.0

    @property
    def gain(self) -> tuple[float, float]:
        """Required ratio of the better peer's median and 90th percentile to those of sylpose (1: not larger)."""
        if self.problem == "pose":
            return 1.0, 1.0
        if self.rotation_deg <= 2 or self.body == "plane":
            return 1.5, 1.5
        tails = self.cameras == 2 or self.focal > 2000 or self.outliers >= 0.5
        return 1.0, 1.5 if tails else 1.0


@dataclass(frozen=True, eq=False)
class Scene:
    """Input of the solvers, and the truth.

    Attributes:
        rig: the calibration; no lens distortion.
        before: per camera, pixels (n, 2) in frame i, or for the problem "pose" points (n, 3) in the object's frame.
        after: per camera, pixels (n, 2) in frame j.
        points: per camera, true points (n, 3): world at frame i, or the object's frame; NaN for outliers.
        truth: transforms `points` to the world at frame j.
        center: (3,) center of the object, in the frame of `points`.
        noise: standard deviation per coordinate, pixels.
    """

    rig: Rig
    before: tuple[FloatArray, ...]
    after: tuple[FloatArray, ...]
    points: tuple[FloatArray, ...]
    truth: RigidTransform
    center: FloatArray
    noise: float

    @property
    def problem(self) -> str:
        """ "motion" or "pose"."""
        return "pose" if self.before[0].shape[1] == 3 else "motion"

    def compute_error(self, found: RigidTransform) -> tuple[float, float]:
        """Return the rotation error in degrees and the translation error of the object's center in mm."""
        rotation_error = (self.truth.rotation * found.rotation.inv()).magnitude()
        translation_error = np.linalg.norm(self.truth.apply(self.center) - found.apply(self.center))
        return float(np.rad2deg(rotation_error)), float(1e3 * translation_error)


def make_scene(row: Row, index: int) -> Scene:
    """Make scene number `index` of a row, the same in every run and on every machine."""
    rng = np.random.default_rng([zlib.crc32(row.name.encode()), index])
    rig, make = _make_rig(row), _make_pose_scene if row.problem == "pose" else _make_motion_scene
    for _ in range(100):
        start = RigidTransform.from_components(rng.uniform(-0.03, 0.03, 3), Rotation.random(rng=rng))
        scene = make(row, rig, start, rng)
        # A board that most cameras see edge-on does not test the solvers.
        if sum(map(len, scene.after)) >= row.cameras * row.matches / 2:
            return scene
    raise ValueError(f"row {row.name}: its cameras see too little of the object")


def _make_rig(row: Row) -> Rig:
    if row.layout == "dome":
        return dome(row.cameras, row.distance, row.focal)
    if row.layout == "arc" or row.cameras == 2:
        return arc(row.cameras, 30.0 if row.layout == "arc" else 90.0, row.distance, row.focal)
    return ring(row.cameras, row.distance, row.focal)


def _make_motion_scene(row: Row, rig: Rig, start: RigidTransform, rng: np.random.Generator) -> Scene:
    motion = random_motion(row.rotation_deg, rng.uniform(0.01, 0.05), rng, center=start.translation)
    true_rig = rig
    if row.calibration_error_deg:
        axis = rng.standard_normal(3)
        error_rotation = Rotation.from_rotvec(np.deg2rad(row.calibration_error_deg) * axis / np.linalg.norm(axis))
        calibration_error_deg = rig.cameras[1]
        true_camera = replace(
            calibration_error_deg,
            camera_from_world=RigidTransform.from_rotation(error_rotation) * calibration_error_deg.camera_from_world,
        )
        true_rig = Rig([true_camera if camera is calibration_error_deg else camera for camera in rig], rig.unit)
    pair = simulate_matches(
        true_rig,
        BODIES[row.body],
        motion,
        rng=rng,
        per_camera=row.matches,
        noise_px=row.noise,
        outliers=row.outliers,
        outlier_kind=row.outlier_kind,
        junk=rig.names[1:2] if row.has_junk_camera else (),
        start=start,
    )
    before = tuple(camera.denormalize(m.x) for camera, m in zip(rig, pair.matches, strict=True))
    after = tuple(camera.denormalize(m.y) for camera, m in zip(rig, pair.matches, strict=True))
    points = [
        camera.camera_from_world.inv().apply(_scale_rays(m.x, depth))
        for camera, m, depth in zip(true_rig, pair.matches, pair.depths, strict=True)
    ]
    if row.calibration_error_deg:  # with its wrong calibration this camera carries no information
        points[1] = np.full_like(points[1], np.nan)
    return Scene(rig, before, after, tuple(points), motion, pair.center, row.noise)


def _make_pose_scene(row: Row, rig: Rig, start: RigidTransform, rng: np.random.Generator) -> Scene:
    """Make a pose problem: exact 3D points that each camera sees, with noise and outliers in the pixels."""
    seen = simulate_matches(
        rig, BODIES[row.body], RigidTransform.identity(), rng=rng, per_camera=row.matches, noise_px=0.0, start=start
    )
    before, after, points = [], [], []
    for c, (camera, m, depth) in enumerate(zip(rig, seen.matches, seen.depths, strict=True)):
        world_from_camera = camera.camera_from_world.inv()
        known = (start.inv() * world_from_camera).apply(_scale_rays(m.x, depth))
        exact = camera.denormalize(m.x)
        pixels = exact + row.noise * rng.standard_normal(exact.shape)
        n_wrong = len(exact) if row.has_junk_camera and c == 1 else round(row.outliers * len(exact))
        wrong = rng.permutation(len(exact))[:n_wrong]
        if n_wrong:
            pixels[wrong] = rng.uniform(exact.min(axis=0), exact.max(axis=0), (n_wrong, 2))
        true = known.copy()
        true[wrong] = np.nan
        before.append(known)
        after.append(pixels)
        points.append(true)
    return Scene(rig, tuple(before), tuple(after), tuple(points), start, np.zeros(3), row.noise)


def _scale_rays(normalized: FloatArray, depths: FloatArray) -> FloatArray:
    return np.asarray(np.column_stack([normalized, np.ones(len(normalized))]) * depths[:, None])


ROWS: tuple[Row, ...] = (
    Row("base: ring of 4, 60 matches"),
    Row("2 cameras", cameras=2),
    Row("3 cameras", cameras=3),
    Row("8 cameras", cameras=8),
    Row("16 cameras", cameras=16),
    Row("arc of 2", cameras=2, layout="arc"),
    Row("arc of 4", layout="arc"),
    Row("dome of 4", layout="dome"),
    Row("20 matches", matches=20),
    Row("300 matches", matches=300),
    Row("16 cameras x 3 matches", cameras=16, matches=3),
    Row("noise 0.25 px", noise=0.25),
    Row("noise 1 px", noise=1.0),
    Row("turn 0.5", rotation_deg=0.5),
    Row("turn 1", rotation_deg=1.0),
    Row("turn 2", rotation_deg=2.0),
    Row("turn 15", rotation_deg=15.0),
    Row("turn 30", rotation_deg=30.0),
    Row("long lens", focal=4000.0, distance=6.0),
    Row("box", body="box"),
    Row("plane", body="plane"),
    Row("cloud", body="cloud"),
    Row("outliers 10 %", outliers=0.1),
    Row("outliers 30 %", outliers=0.3),
    Row("outliers 50 %", outliers=0.5),
    Row("static background 30 %", outliers=0.3, outlier_kind="static"),
    Row("static background 50 %", outliers=0.5, outlier_kind="static"),
    Row("second motion 30 %", outliers=0.3, outlier_kind="second_motion"),
    Row("one camera all junk", has_junk_camera=True),
    Row("one camera turned by 2", calibration_error_deg=2.0),
    Row("plane, turn 0.5", body="plane", rotation_deg=0.5),
    Row("plane, turn 1", body="plane", rotation_deg=1.0),
    Row("plane, turn 2", body="plane", rotation_deg=2.0),
    Row("box, turn 0.5", body="box", rotation_deg=0.5),
    Row("box, turn 1", body="box", rotation_deg=1.0),
    Row("box, turn 2", body="box", rotation_deg=2.0),
    Row("turn 0.5, outliers 30 %", rotation_deg=0.5, outliers=0.3),
    Row("turn 1, outliers 30 %", rotation_deg=1.0, outliers=0.3),
    Row("turn 2, outliers 30 %", rotation_deg=2.0, outliers=0.3),
    Row("2 cameras, outliers 30 %", cameras=2, outliers=0.3),
    Row("2 cameras, outliers 50 %", cameras=2, outliers=0.5),
    Row("long lens, outliers 30 %", focal=4000.0, distance=6.0, outliers=0.3),
    Row("long lens, 2 cameras", focal=4000.0, distance=6.0, cameras=2),
    Row("4 x 800", matches=800),
    Row("4 x 800, outliers 30 %", matches=800, outliers=0.3),
    Row("16 x 60, outliers 30 %", cameras=16, outliers=0.3),
    Row("64 x 60", cameras=64),
    Row("64 x 60, outliers 30 %", cameras=64, outliers=0.3),
    Row("pose: ring of 4, 60 points", "pose"),
    Row("pose: 1 camera", "pose", cameras=1),
    Row("pose: 2 cameras", "pose", cameras=2),
    Row("pose: 16 cameras", "pose", cameras=16),
    Row("pose: 16 cameras x 1 point", "pose", cameras=16, matches=1),
    Row("pose: 16 cameras x 2 points", "pose", cameras=16, matches=2),
    Row("pose: noise 1 px", "pose", noise=1.0),
    Row("pose: plane", "pose", body="plane"),
    Row("pose: outliers 10 %", "pose", outliers=0.1),
    Row("pose: outliers 30 %", "pose", outliers=0.3),
    Row("pose: outliers 50 %", "pose", outliers=0.5),
    Row("pose: one camera all junk", "pose", has_junk_camera=True),
    Row("pose: 4 x 800", "pose", matches=800),
    Row("pose: 4 x 800, outliers 30 %", "pose", matches=800, outliers=0.3),
)

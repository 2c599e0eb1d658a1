"""The scenes of the two-frame benchmark: what varies from row to row, and one seeded scene of a row."""

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
    # A board with a front and a back, so that nobody matches it edge-on.
    "plane": box((0.3, 0.2, 1e-9)),
    "cloud": cloud((0.15, 0.12, 0.1)),
}


@dataclass(frozen=True)
class Row:
    """One row of the benchmark: the base scene with something changed.

    Attributes:
        name: as in the table.
        problem: "motion" (two frames, unknown object) or "pose" (one frame, known object).
        cameras, layout: how many, and on a full ring, an arc (30 degrees apart) or a dome. Two cameras on a "ring" stand
            90 degrees apart: opposite each other, they would see less than two cameras usually do.
        matches: per camera, wrong ones included.
        noise: standard deviation per coordinate, pixels.
        turn: degrees, about any axis. The translation is 1 to 5 cm in any direction.
        focal, distance: pixels and metres; their ratio, so the object's size in the image, is the same for all rows.
        outliers, kind: share of each camera's matches that are wrong, and how (`sylpose.simulate.simulate_matches`).
        junk: all matches of the second camera are wrong.
        miscalibrated: degrees by which the second camera is turned against its calibration.
    """

    name: str
    problem: Literal["motion", "pose"] = "motion"
    cameras: int = 4
    layout: Literal["ring", "arc", "dome"] = "ring"
    matches: int = 60
    noise: float = 0.5
    turn: float = 5.0
    focal: float = 1000.0
    distance: float = 1.5
    body: str = "ellipsoid"
    outliers: float = 0.0
    kind: OutlierKind = "uniform"
    junk: bool = False
    miscalibrated: float = 0.0

    @property
    def gain(self) -> tuple[float, float]:
        """How many times smaller than the better peer's the median and the 90th percentile shall be (1: not larger)."""
        if self.problem == "pose":
            return 1.0, 1.0
        if self.turn <= 2 or self.body == "plane":
            return 1.5, 1.5
        tails = self.cameras == 2 or self.focal > 2000 or self.outliers >= 0.5
        return 1.0, 1.5 if tails else 1.0


@dataclass(frozen=True, eq=False)
class Scene:
    """What the solvers are given, and the truth.

    Attributes:
        rig: the calibration; no lens distortion.
        before: per camera, pixels (n, 2) in frame i, or for the problem "pose" points (n, 3) in the object's frame.
        after: per camera, pixels (n, 2) in frame j.
        points: per camera, where the points truly are (n, 3): world at frame i, or the object's frame; NaN for outliers.
        truth: takes `points` to the world at frame j.
        center: (3,) of the object, in the frame of `points`.
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

    def error(self, found: RigidTransform) -> tuple[float, float]:
        """The error in degrees, and that of the displacement of the object's centre in mm."""
        turn = (self.truth.rotation * found.rotation.inv()).magnitude()
        shift = np.linalg.norm(self.truth.apply(self.center) - found.apply(self.center))
        return float(np.rad2deg(turn)), float(1e3 * shift)


def make_scene(row: Row, index: int) -> Scene:
    """Scene number `index` of a row: the same in every run, on every machine."""
    rng = np.random.default_rng([zlib.crc32(row.name.encode()), index])
    rig, make = _rig(row), _pose_scene if row.problem == "pose" else _motion_scene
    for _ in range(100):
        start = RigidTransform.from_components(rng.uniform(-0.03, 0.03, 3), Rotation.random(rng=rng))
        scene = make(row, rig, start, rng)
        # A board that hardly any camera sees other than edge-on says nothing about solvers.
        if sum(map(len, scene.after)) >= row.cameras * row.matches / 2:
            return scene
    raise ValueError(f"row {row.name}: its cameras hardly see the object")


def _rig(row: Row) -> Rig:
    if row.layout == "dome":
        return dome(row.cameras, row.distance, row.focal)
    if row.layout == "arc" or row.cameras == 2:
        return arc(row.cameras, 30.0 if row.layout == "arc" else 90.0, row.distance, row.focal)
    return ring(row.cameras, row.distance, row.focal)


def _motion_scene(row: Row, rig: Rig, start: RigidTransform, rng: np.random.Generator) -> Scene:
    motion = random_motion(row.turn, rng.uniform(0.01, 0.05), rng, center=start.translation)
    seen_by = rig
    if row.miscalibrated:
        axis = rng.standard_normal(3)
        turn = Rotation.from_rotvec(np.deg2rad(row.miscalibrated) * axis / np.linalg.norm(axis))
        wrong = rig.cameras[1]
        turned = replace(wrong, camera_from_world=RigidTransform.from_rotation(turn) * wrong.camera_from_world)
        seen_by = Rig([turned if camera is wrong else camera for camera in rig], rig.unit)
    pair = simulate_matches(
        seen_by,
        BODIES[row.body],
        motion,
        rng=rng,
        per_camera=row.matches,
        noise_px=row.noise,
        outliers=row.outliers,
        outlier_kind=row.kind,
        junk=rig.names[1:2] if row.junk else (),
        start=start,
    )
    before = tuple(camera.denormalize(m.x) for camera, m in zip(rig, pair.matches, strict=True))
    after = tuple(camera.denormalize(m.y) for camera, m in zip(rig, pair.matches, strict=True))
    points = [
        camera.camera_from_world.inv().apply(_at_depth(m.x, depth))
        for camera, m, depth in zip(seen_by, pair.matches, pair.depths, strict=True)
    ]
    if row.miscalibrated:  # with the calibration that it has, this camera tells nothing
        points[1] = np.full_like(points[1], np.nan)
    return Scene(rig, before, after, tuple(points), motion, pair.center, row.noise)


def _pose_scene(row: Row, rig: Rig, start: RigidTransform, rng: np.random.Generator) -> Scene:
    """Points of the body that each camera sees, without noise in 3D; noise and wrong matches are in the pixels."""
    seen = simulate_matches(
        rig, BODIES[row.body], RigidTransform.identity(), rng=rng, per_camera=row.matches, noise_px=0.0, start=start
    )
    before, after, points = [], [], []
    for c, (camera, m, depth) in enumerate(zip(rig, seen.matches, seen.depths, strict=True)):
        world_from_camera = camera.camera_from_world.inv()
        known = (start.inv() * world_from_camera).apply(_at_depth(m.x, depth))
        exact = camera.denormalize(m.x)
        pixels = exact + row.noise * rng.standard_normal(exact.shape)
        n_wrong = len(exact) if row.junk and c == 1 else round(row.outliers * len(exact))
        wrong = rng.permutation(len(exact))[:n_wrong]
        if n_wrong:
            pixels[wrong] = rng.uniform(exact.min(axis=0), exact.max(axis=0), (n_wrong, 2))
        true = known.copy()
        true[wrong] = np.nan
        before.append(known)
        after.append(pixels)
        points.append(true)
    return Scene(rig, tuple(before), tuple(after), tuple(points), start, np.zeros(3), row.noise)


def _at_depth(normalized: FloatArray, depths: FloatArray) -> FloatArray:
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
    Row("turn 0.5", turn=0.5),
    Row("turn 1", turn=1.0),
    Row("turn 2", turn=2.0),
    Row("turn 15", turn=15.0),
    Row("turn 30", turn=30.0),
    Row("long lens", focal=4000.0, distance=6.0),
    Row("box", body="box"),
    Row("plane", body="plane"),
    Row("cloud", body="cloud"),
    Row("outliers 10 %", outliers=0.1),
    Row("outliers 30 %", outliers=0.3),
    Row("outliers 50 %", outliers=0.5),
    Row("static background 30 %", outliers=0.3, kind="static"),
    Row("static background 50 %", outliers=0.5, kind="static"),
    Row("second motion 30 %", outliers=0.3, kind="second_motion"),
    Row("one camera all junk", junk=True),
    Row("one camera turned by 2", miscalibrated=2.0),
    Row("plane, turn 0.5", body="plane", turn=0.5),
    Row("plane, turn 1", body="plane", turn=1.0),
    Row("plane, turn 2", body="plane", turn=2.0),
    Row("box, turn 0.5", body="box", turn=0.5),
    Row("box, turn 1", body="box", turn=1.0),
    Row("box, turn 2", body="box", turn=2.0),
    Row("turn 0.5, outliers 30 %", turn=0.5, outliers=0.3),
    Row("turn 1, outliers 30 %", turn=1.0, outliers=0.3),
    Row("turn 2, outliers 30 %", turn=2.0, outliers=0.3),
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
    Row("pose: one camera all junk", "pose", junk=True),
    Row("pose: 4 x 800", "pose", matches=800),
    Row("pose: 4 x 800, outliers 30 %", "pose", matches=800, outliers=0.3),
)

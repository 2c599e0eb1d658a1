"""Consistency of the covariances of `estimate_motion` and `estimate_pose`: NEES over many seeded scenes.

    python benchmarks/nees.py [--scenes 500] [--settings "out*"]

NEES (normalized estimation error squared) is the squared error in units of its covariance. With six degrees of freedom it
follows a chi-squared distribution: mean 6, median 5.3, 99th percentile 16.8. Scenes whose status is not OK are counted
separately, since an unobservable motion has no finite covariance.
"""

from __future__ import annotations

import argparse
import fnmatch
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import Motion, Rig, Status, estimate_motion, estimate_pose
from sylpose.simulate import Body, arc, box, cloud, dome, ellipsoid, plane, random_motion, ring, simulate_matches


class Setting(NamedTuple):
    """Parameters of the scenes of one table row."""

    rig: Rig
    body: Body = ellipsoid((0.15, 0.12, 0.10))
    rotation_deg: float = 5.0
    translation_m: float = 0.03
    n_matches: int = 60
    noise_px: float = 0.5
    outlier_ratio: float = 0.0
    outlier_kind: str = "uniform"
    has_known_points: bool = False


SETTINGS = {
    "ring of 4": Setting(ring(4)),
    "dome of 8": Setting(dome(8)),
    "arc of 3": Setting(arc(3, 30.0)),
    "rotation 1°": Setting(ring(4), rotation_deg=1.0),
    "rotation 0.5°": Setting(ring(4), rotation_deg=0.5),
    "rotation 15°": Setting(dome(4), rotation_deg=15.0),
    "noise 1 px": Setting(dome(4), noise_px=1.0),
    "noise 0.25 px": Setting(dome(4), noise_px=0.25),
    "20 matches": Setting(dome(4), n_matches=20),
    "300 matches": Setting(dome(4), n_matches=300),
    "box": Setting(dome(4), box()),
    "plane": Setting(dome(4), plane()),
    "point cloud": Setting(dome(4), cloud()),
    "telephoto, f = 4000 px at 6 m": Setting(dome(4, 6.0, 4000.0)),
    "outliers 30 %": Setting(ring(4), outlier_ratio=0.3),
    "outliers 50 %": Setting(dome(4), outlier_ratio=0.5),
    "static background 30 %": Setting(dome(4), outlier_ratio=0.3, outlier_kind="static"),
    "pose: ring of 4": Setting(ring(4), has_known_points=True),
    "pose: 1 camera": Setting(ring(1), has_known_points=True),
    "pose: outliers 30 %": Setting(ring(4), outlier_ratio=0.3, has_known_points=True),
    "pose: 20 matches, outliers 50 %": Setting(dome(4), n_matches=20, outlier_ratio=0.5, has_known_points=True),
    "pose: plane": Setting(dome(4), plane(), has_known_points=True),
}


def solve(setting: Setting, seed: int) -> tuple[Motion, RigidTransform]:
    """Simulate and solve one scene; return the result and the true motion or pose."""
    rng = np.random.default_rng(seed)
    motion = random_motion(setting.rotation_deg, setting.translation_m, rng)
    start = RigidTransform.from_rotation(Rotation.random(rng=rng))
    pair = simulate_matches(
        setting.rig,
        setting.body,
        motion,
        rng=rng,
        per_camera=setting.n_matches,
        noise_px=setting.noise_px,
        outliers=setting.outlier_ratio,
        outlier_kind=setting.outlier_kind,
        start=start,
    )
    if not setting.has_known_points:
        return estimate_motion(setting.rig, pair.matches), motion
    points, pixels = [], []
    for camera in setting.rig:
        world = motion.apply(start.apply(np.array(setting.body.points)))
        facing = np.einsum(
            "ni,ni->n", camera.center - world, (motion * start).rotation.apply(np.array(setting.body.normals))
        )
        visible = np.flatnonzero((facing > 0) | ~setting.body.normals.any(axis=1))
        index = rng.permutation(visible)[: setting.n_matches]
        image = camera.project(world[index])
        outlier_indices = rng.permutation(len(index))[: round(setting.outlier_ratio * len(index))]
        if len(outlier_indices):
            image[outlier_indices] = rng.uniform(image.min(axis=0), image.max(axis=0), (len(outlier_indices), 2))
        points.append(setting.body.points[index])
        pixels.append(image + setting.noise_px * rng.standard_normal(image.shape))
    return estimate_pose(setting.rig, points, pixels), motion * start


def compute_nees(found: Motion, truth: RigidTransform) -> float:
    """Return the squared error in units of the covariance."""
    assert found.motion is not None
    rotation_error = (truth.rotation * found.motion.rotation.inv()).as_rotvec()
    # `center` is the object's center before the motion; for a known model it is in the model's frame.
    error = np.concatenate([rotation_error, truth.apply(found.center) - found.motion.apply(found.center)])
    return float(error @ found.information @ error)


def evaluate_setting(
    setting: Setting, scenes: int, solver: Callable[[Setting, int], tuple[Motion, RigidTransform]]
) -> str:
    """Solve all scenes of a setting and format its table row."""
    values, n_not_ok = [], 0
    for seed in range(scenes):
        found, truth = solver(setting, seed)
        if found.status is Status.OK:
            values.append(compute_nees(found, truth))
        else:
            n_not_ok += 1
    mean, median, percentile_99 = np.mean(values), np.median(values), np.quantile(values, 0.99)
    # Wrong minima make the mean heavy-tailed. The mean without the largest 1 % is 5.8 for a chi-squared distribution.
    trimmed = np.sort(values)[: int(0.99 * len(values))].mean()
    return f"{mean:.1f} | {trimmed:.1f} | {median:.1f} | {percentile_99:.0f} | {n_not_ok}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=500)
    parser.add_argument("--settings", default="*")
    options = parser.parse_args()
    print(
        "| setting | mean NEES | mean without the largest 1 % | median | 99th percentile | scenes not OK |\n"
        "|---|---|---|---|---|---|"
    )
    for name, setting in SETTINGS.items():
        if fnmatch.fnmatch(name, options.settings):
            print(f"| {name} | {evaluate_setting(setting, options.scenes, solve)} |", flush=True)


if __name__ == "__main__":
    main()
